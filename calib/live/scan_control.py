"""Event-driven scan of a live view: request from the device the readings that pressures and contacts call for."""

import time
from collections.abc import Callable

import jax
import numpy as np

import jaxeit as je

from ..calibration.calibration import Calibration
from ..record.wire.encoding import encode_read

REPEAT_INTERVAL = 0.3  # s between equal requests; a device forgets a request after a second
ONSET_FRACTION = 0.01  # of the largest calibrated pressure; less is no contact


def prepare_director(calibration: Calibration, number: int, send: Callable[[bytes], object]) -> "ScanDirector":
    """Create the director for a calibrated skin; `number` is the number of its EIT stream on the wire.

    This takes some seconds, because readings are chosen for each place of the skin.
    """
    model = je.discretise(je.Scene(calibration.skin), je.Fidelity.draft())
    onset = ONSET_FRACTION * np.asarray(calibration.curves.pressure_range)[:, 1]
    scan = je.scan.prepare_event_scan(
        model,
        calibration.skin,
        je.scan.EventScanSettings(onset=onset),
        noise=_reading_noise(calibration.recon),
        channels=np.asarray(calibration.recon.channels),
    )
    return ScanDirector(scan, number, send)


def _reading_noise(recon: je.imaging.AbstractReconstructor) -> np.ndarray:
    """Standard deviation of each reading, (readings,) V; 1 for channels that the calibration does not use."""
    rows, weight = np.flatnonzero(recon.channels), np.asarray(recon.whitening.weight, float)
    variance = np.ones(len(weight))
    known = weight[rows][:, rows] if weight.ndim == 2 else np.diag(weight[rows])
    variance[rows] = np.diag(np.linalg.solve(known, np.eye(len(rows))))
    return np.sqrt(variance)


class ScanDirector:
    """Requests readings from a device, frame by frame, according to the previous result."""

    def __init__(self, scan: je.scan.EventScan, number: int, send: Callable[[bytes], object]):
        self._number, self._send = number, send
        self._step = jax.jit(lambda *a: scan.step(*a))
        self._start = self._state = scan.start()
        self._requested, self._request_time = np.ones(len(scan.idle), bool), 0.0
        nowhere = np.full((len(scan.by_pad), 2), np.nan)
        self._step(self._state, np.zeros(len(scan.by_pad)), nowhere)  # compiled before the first frame

    @property
    def requested(self) -> np.ndarray:
        """Readings that were requested last, (readings,) bool."""
        return self._requested

    def update(self, pressure: np.ndarray, places: np.ndarray) -> None:
        """Choose the next readings from the change of pressure (pads,) Pa and the contacts (pads, 2) m, NaN without."""
        self._state, readings = self._step(self._state, pressure, places)
        self._request(np.asarray(readings))

    def request_all(self) -> None:
        """Start again with whole scans, which the rest levels need."""
        self._state = self._start
        self._request(np.ones_like(self._requested))

    def _request(self, readings: np.ndarray) -> None:
        now = time.monotonic()
        if now - self._request_time > REPEAT_INTERVAL or not np.array_equal(readings, self._requested):
            self._send(encode_read(self._number, readings))
            self._requested, self._request_time = readings, now
