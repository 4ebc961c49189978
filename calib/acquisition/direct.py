"""The event-driven scan of a live show: what pressure and contacts say is to be read next, told to the device."""

import time
from collections.abc import Callable

import jax
import numpy as np

import jaxeit as je
from calib.calibration import Calibration

from .wire import encode_read

_AGAIN = 0.3  # s, after which the device is told again, so that it goes on
_ONSET = 0.01  # of the largest pressure calibrated: what is less is no contact


def prepare_director(calibration: Calibration, number: int, send: Callable[[bytes], object]) -> "Director":
    """The director of a calibrated skin whose EIT stream has this number on the wire.

    Takes some seconds: the readings are chosen for each place of the skin.
    """
    model = je.discretise(je.Scene(calibration.skin), je.Fidelity.draft())
    onset = _ONSET * np.asarray(calibration.curves.pressure_range)[:, 1]
    scan = je.prepare_event_scan(model, calibration.skin, onset=onset)
    return Director(scan, number, send)


class Director:
    """Tells a device which readings to take, from what the frame before said."""

    def __init__(self, scan: je.EventScan, number: int, send: Callable[[bytes], object]):
        self._number, self._send = number, send
        self._step = jax.jit(lambda *a: scan.step(*a))
        self._start = self._state = scan.start()
        self._asked, self._told = np.ones(len(scan.idle), bool), 0.0
        nowhere = np.full((len(scan.by_pad), 2), np.nan)
        self._step(self._state, np.zeros(len(scan.by_pad)), nowhere)  # compiled before the first frame

    @property
    def asked(self) -> np.ndarray:
        """Readings that the device was last asked for, (readings,)."""
        return self._asked

    def direct(self, pressure: np.ndarray, places: np.ndarray) -> None:
        """Choose the next readings by the change of pressures (pads,) Pa and contacts (pads, 2) m, NaN: none."""
        self._state, readings = self._step(self._state, pressure, places)
        self._ask(np.asarray(readings))

    def whole(self) -> None:
        """Begin again with whole scans, as levels without contact need them."""
        self._state = self._start
        self._ask(np.ones_like(self._asked))

    def _ask(self, readings: np.ndarray) -> None:
        now = time.monotonic()
        if now - self._told > _AGAIN or not np.array_equal(readings, self._asked):
            self._send(encode_read(self._number, readings))
            self._asked, self._told = readings, now
