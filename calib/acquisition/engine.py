"""The engine of a live show: one frame after the other becomes forces, by programs compiled for one frame.

A frame's force map waits for nothing but itself. Contacts take several times as long to fit: they are fitted to the
newest frame when there is time before the next is due (`Engine.spare`), and serve the frames until the next fit.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.calibration import Calibration
from calib.hybrid import nowhere
from calib.location import Places
from calib.locators import ContactLocator
from calib.maps import ForceLaw, filled, fused, is_loaded, law_of, remembered

from .results import NO_TOUCHES, Result, Touches

_TOUCHED = 3.0  # times its standard error: a force that is there
_STALE = 0.1  # s, after which contacts are fitted even if a frame is lost to it
_FORGOTTEN = 0.3  # s, after which they say nothing about the present frame
_GATE = 0.6
_IMAGED = "float32"  # what images are made in, of matrices built in float64: half the memory to go through


class Arrival(NamedTuple):
    """The newest frame: its voltages (readings,), the mean pressure since the last (pads,), when it came (ns)."""

    voltage: np.ndarray
    pressure: np.ndarray
    host: int


class Resting:
    """Levels without contact: means over `seconds` of frames; missing readings do not count."""

    def __init__(self, seconds: float):
        self._seconds = seconds
        self._since: int | None = None
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []
        self.levels: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, arrival: Arrival) -> None:
        """One more frame without contact."""
        self._since = arrival.host if self._since is None else self._since
        self._rows.append((arrival.voltage, arrival.pressure))
        if arrival.host - self._since >= self._seconds * 1e9:
            self.levels = _mean([v for v, _ in self._rows]), _mean([p for _, p in self._rows])
            self._rows = []


def _mean(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Over rows, of what is finite; NaN where nothing is."""
    block = np.stack(rows)
    good = np.isfinite(block)
    count = good.sum(0)
    return np.where(good, block, 0.0).sum(0) / np.where(count > 0, count, np.nan)


class Mapped(NamedTuple):
    """Of one frame, on the host: force map (pixels,) N; of each pad force, standard error, validity, if loaded; and
    the image (pixels,) S that the map comes from."""

    map: np.ndarray
    force: np.ndarray
    standard_error: np.ndarray
    valid: np.ndarray
    loaded: np.ndarray
    image: np.ndarray


class Programs:
    """What a frame goes through, for one frame at a time: its image in NumPy, whose product takes less time than a
    call of JAX; forces, and contacts, as one compiled program each. All are run once before the first frame comes."""

    def __init__(self, law: ForceLaw):
        self._law = law
        self._image = law.recon.on_host(_IMAGED)
        self._dtypes = law.recon.factor.dtype, law.curves.parameters.dtype
        self._map = _compiled(lambda *a: _mapped(law, *a))  # its numbers built in: a call has a third of the overhead
        leaves, tree = jax.tree.flatten(law)
        search = _compiled(lambda leaves, *a: _searched(jax.tree.unflatten(tree, leaves), *a))
        self._search = partial(search, leaves)  # of these, a table of megabytes is not
        contacts = law.locator.finder.most if isinstance(law.locator, ContactLocator) else 1
        self.nowhere = nowhere(jnp.zeros((1, law.masks.weights.shape[0]), self._dtypes[0]), contacts)

    @property
    def searches(self) -> bool:
        """Whether places are found, on which forces depend."""
        return self._law.locator is not None

    def warm_up(self) -> None:
        """Run everything once, for frames that lack most readings too."""
        readings, pads = self._law.recon.readings, self._law.masks.weights.shape[0]
        frame = np.zeros(readings)
        self.map(frame, np.zeros(pads), self.nowhere, np.zeros((1, pads)))
        self._image(np.full(readings, np.nan))
        if self.searches:
            self.search(frame)

    def map(self, frame: np.ndarray, pressure: np.ndarray, places: Places, before: np.ndarray) -> Mapped:
        """Forces of a difference frame (readings,) V and pressures (pads,) Pa, after those ``before`` (m, pads)."""
        image = self._image(frame)
        row = self._map(image[None], self._row(pressure, 1), places, filled(self._law, before))
        return _unpacked(np.asarray(row), pressure.size, image)

    def search(self, frame: np.ndarray) -> tuple[Places, Touches]:
        """Where a difference frame is touched."""
        places, found = self._search(self._row(frame, 0))
        return jax.block_until_ready(places), NO_TOUCHES if found is None else _touches(jax.device_get(found))

    def _row(self, values: np.ndarray, which: int) -> np.ndarray:
        return np.asarray(values[None], self._dtypes[which])


def _compiled(function: Callable) -> Callable:
    return jax.jit(function, compiler_options=je.compiler_options())


def _mapped(law: ForceLaw, image, pressure, places, before):
    """`Mapped` in one row: one transfer."""
    image = image.astype(law.recon.factor.dtype)
    found = fused(law, image, pressure, places if law.field is not None else None, before, _GATE)
    parts = found.map.force, found.force, found.standard_error, found.valid, is_loaded(law, pressure)
    return jnp.concatenate([part[0].astype(found.force.dtype) for part in parts])


def _unpacked(row: np.ndarray, pads: int, image: np.ndarray) -> Mapped:
    force, error, valid, loaded = row[-4 * pads :].reshape(4, pads)
    return Mapped(row[: -4 * pads], force, error, valid > 0, loaded > 0, image)


def _searched(law: ForceLaw, frame):
    """Places, and the contacts they come from: None of a locator that fits none."""
    if isinstance(law.locator, ContactLocator):
        found = law.locator.finder(frame)
        return law.locator.placed(found, law.recon, law.masks), found
    assert law.locator is not None
    return law.locator(frame, law.recon(frame), law.recon, law.masks), None


def _touches(found: je.Contacts) -> Touches:
    present, position, covariance, result = (
        np.asarray(part[0]) for part in (found.present, found.position, found.covariance, found.result)
    )
    return Touches(position[present], covariance[present, :2, :2], result[present] == je.ContactResult.CONVERGED, 0)


def placing_error(calibration: Calibration) -> np.ndarray:
    """Mean square error of the fitted places of the presses it rests on, (2, 2) m^2: what noise alone does not tell."""
    found = calibration.evaluation
    if calibration.locator is None or "fitted" not in found.estimated:
        return np.zeros((2, 2))
    error = np.asarray(found.estimated["fitted"] - found.position, float)
    error = error[np.isfinite(error).all(1)]
    return error.T @ error / max(len(error), 1)


class Engine:
    """Frames to results, by one calibration; only the thread that made it may use it."""

    def __init__(
        self, calibration: Calibration, rest: float = 2.0, programs: Callable[[ForceLaw], Programs] = Programs
    ):
        self._rest = rest
        self._resting = Resting(rest)
        self._number = 0
        recon = calibration.recon
        self._used, self._centres = np.asarray(recon.channels), np.asarray(recon.centres)
        self._owner = np.asarray(calibration.masks.weights)
        self._law = law_of(calibration)
        self._programs = programs(self._law)
        self._programs.warm_up()
        self._before = np.zeros((1, len(self._owner)))
        self._newest: np.ndarray | None = None  # touched, and its contacts not fitted
        self._places, self._touches, self._found = self._programs.nowhere, NO_TOUCHES, 0.0
        self._placing = placing_error(calibration)
        self._took = 0.0
        self.unsearched = 0

    @property
    def resting(self) -> bool:
        """Whether levels without contact are still being taken."""
        return self._resting.levels is None

    def tare(self) -> None:
        """Take the levels without contact anew."""
        self._resting = Resting(self._rest)

    def pressed(self, arrival: Arrival) -> np.ndarray:
        """Change of pressure on each pad, (pads,) Pa; only after levels are taken."""
        assert self._resting.levels is not None
        return arrival.pressure - self._resting.levels[1]

    def step(self, arrival: Arrival, dropped: int = 0) -> Result | None:
        """What a frame says; None while levels are taken."""
        if self._resting.levels is None:
            self._resting.add(arrival)
            return None
        frame, pressure = arrival.voltage - self._resting.levels[0], self.pressed(arrival)
        lost, silent = ~np.isfinite(frame), ~np.isfinite(pressure)
        pressed = np.where(silent, 0.0, pressure)
        found = self._programs.map(frame, pressed, self._present_places(), self._before)
        if self._law.remembers:
            self._before = remembered(np.concatenate([self._before, pressure[None]]))
        self._note(frame, bool(found.loaded.any()))
        force = np.where(silent, np.nan, found.force)
        error = np.where(silent, np.nan, found.standard_error)
        self._number += 1
        return Result(
            number=self._number,
            host=arrival.host,
            latency=(time.monotonic_ns() - arrival.host) / 1e9,
            force=force,
            standard_error=error,
            valid=found.valid & ~silent,
            centre=self._centre(found.map, force > _TOUCHED * error),
            map=found.map,
            image=found.image,
            missing=int((lost & self._used).sum()),
            dropped=dropped,
            touches=self._touches,
            unsearched=self.unsearched,
        )

    def _present_places(self) -> Places:
        return self._places if time.monotonic() - self._found < _FORGOTTEN else self._programs.nowhere

    def _note(self, frame: np.ndarray, touched: bool) -> None:
        """What is to be done when there is time."""
        if self._touches.age is not None:
            self._touches = replace(self._touches, age=self._touches.age + 1)
        if not self._programs.searches:
            return
        self.unsearched += self._newest is not None
        self._newest = frame if touched else None
        if not touched:
            self._places, self._touches = self._programs.nowhere, replace(NO_TOUCHES, age=0)

    def spare(self, seconds: float) -> None:
        """Use the time until the next frame is due for contacts of the newest frame."""
        if self._newest is not None and (seconds > self._took or time.monotonic() - self._found > _STALE):
            begin = time.monotonic()
            self._places, touches = self._programs.search(self._newest)
            self._touches = replace(touches, covariance=touches.covariance + self._placing)
            self._found, self._newest = time.monotonic(), None
            self._took = max(self._found - begin, 0.95 * self._took)

    def _centre(self, image: np.ndarray, touched: np.ndarray) -> np.ndarray:
        """Mean position of the force on each pad."""
        each = self._owner * np.maximum(image, 0.0)
        total = each.sum(1)
        ok = touched & (total > 0)
        middle = each @ self._centres / np.where(ok, total, 1.0)[:, None]
        return np.where(ok[:, None], middle, np.nan)
