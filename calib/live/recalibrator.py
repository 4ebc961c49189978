"""Recalibration while live: the zero of the pads follows their drift at rest, their gains the image in contacts.

Both are frozen while a pad is loaded, and bounded. What needs JAX (the image and the forces of a block of a contact) is
computed by the thread that owns it, one block at a time, when it has time; the update itself is linear algebra on the
host, in a thread of its own, and its result is taken over when nothing is loaded.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxeit.tracking import LearnedLayer

from ..calibration.application.force_maps import ForceModel
from ..calibration.calibration import Calibration
from ..calibration.recalibration.changes import Evidence, Recalibration
from ..calibration.recalibration.evidence import gain_prior, image_reference, update_from_use
from ..calibration.recalibration.loads import ObservedContacts, contact_loads, seen_contacts
from ..calibration.recalibration.ordinary_use import loaded_pressures
from ..calibration.recalibration.press_noise import press_noise
from ..calibration.recalibration.records import recorded, rest_levels
from ..fitting.gain_update import GainDrift, GainUpdate
from ..fitting.pad_gains import PadGains

BLOCK = 500_000_000  # ns of a contact that make one observation
SKIPPED = 200_000_000  # ns after the beginning of a contact
MAX_BLOCKS = 4  # of one contact
MAX_WAITING = 8  # blocks whose image is not computed yet
MAX_CONTACTS = 200  # that an update uses, counted at each place; older ones are forgotten
MIN_CONTACTS = 8  # before the first update
MAX_MOVE = 0.3  # of a log gain, away from that of the calibration
ZERO_SECONDS = 10.0  # in which the zero follows
QUIET_FRACTION = 0.1  # of the pressure of a loaded pad: the zero follows no faster than this in `ZERO_SECONDS`
MAX_OFFSET = 1.0  # of that pressure, away from the rest levels that were measured
SAVE_INTERVAL = 60.0  # s


@dataclass
class _Block:
    """Sums over the frames of a part of a contact."""

    contact: int  # its number
    start: int
    voltage: np.ndarray
    pressure: np.ndarray
    frames: int = 0

    def mean(self) -> tuple[np.ndarray, np.ndarray]:
        return self.voltage / self.frames, self.pressure / self.frames


class _NewestBlocks:
    """What an update takes: the newest blocks, of each contact one a place.

    Args:
        distance: m within which two blocks of a contact are at one place, so that the stronger one counts.
    """

    def __init__(self, distance: float):
        self._distance = distance
        self._rows: deque[tuple[int, ObservedContacts]] = deque()  # number of the contact, one block of it

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, contact: int, block: ObservedContacts) -> None:
        same = [row for row in self._rows if row[0] == contact and self._near(row[1], block)]
        if any(row[1].force.sum() >= block.force.sum() for row in same):
            return
        kept = [row for row in self._rows if all(row is not one for one in same)]
        self._rows = deque([*kept, (contact, block)], maxlen=MAX_CONTACTS)

    def _near(self, one: ObservedContacts, other: ObservedContacts) -> bool:
        return bool(np.linalg.norm(one.place - other.place) <= self._distance)

    def seen(self) -> ObservedContacts:
        """All blocks, at the log gains of the first."""
        blocks = [block for _, block in self._rows]
        observed, place, force, slopes = (np.concatenate(part) for part in list(zip(*blocks, strict=True))[:4])
        return ObservedContacts(observed, place, force, slopes, blocks[0].gain)


class LiveRecalibrator:
    """Follows zero and gains of one calibration. Only the thread that owns JAX may use it.

    Args:
        calibration: the calibration with which live began.
        path: calibration file to which the moved calibration is written, every minute and at the end; None: none.
        drift: how far gains may have moved since the calibration.
        tell: called with the health of the calibration when the advice changes, or an update fails.
        layer: tells the gain of the contact layer that followed contacts have told, which is written too; None: none.
    """

    def __init__(
        self,
        calibration: Calibration,
        path: str | Path | None = None,
        drift: GainDrift | None = None,
        tell: Callable[[str], object] = lambda line: None,
        layer: Callable[[], LearnedLayer | None] | None = None,
    ):
        self._calibration, self._path, self._tell, self._layer = calibration, path, tell, layer
        self._prior = gain_prior(calibration, drift or GainDrift(), together=True)
        self._reference, self._noise = image_reference(calibration), press_noise(calibration.evaluation)
        self._threshold = loaded_pressures(calibration)
        self._contacts = _NewestBlocks(self._noise.length)
        self._block: _Block | None = None
        self._touched: int | None = None  # since when a pad is loaded, ns
        self._blocks, self._last = 0, 0
        self._waiting: deque[_Block] = deque(maxlen=MAX_WAITING)
        self._worker: threading.Thread | None = None
        self._found: GainUpdate | Exception | None = None  # what the newest update gave
        self._failure = ""  # of the newest update, in words
        self._fresh, self._saved = 0, 0
        self.record: Recalibration | None = None
        self.offset = np.zeros(len(self._threshold))
        self.gains = PadGains(jnp.asarray(self._prior.mean), jnp.asarray(self._prior.covariance))
        self._warm_up()

    @property
    def health(self) -> str:
        """How far off the calibration is, or why the newest update failed, in one line."""
        if self._failure:
            return self._failure
        if self.record is None:
            return "calibration health: not known before a few contacts on each pad"
        return self.record.health

    def moved(self, model: ForceModel) -> ForceModel:
        """A force model with the present gains."""
        return model.moved(self.gains)

    def add(self, voltage: np.ndarray, pressure: np.ndarray, loaded: bool, now: int) -> None:
        """Add a frame: changes of readings and pressures, already without `offset`, at `now` ns."""
        step, self._last = (min((now - self._last) / 1e9, 1.0) if self._last else 0.0), now
        if not loaded:
            self._end_contact()
            self._follow_zero(pressure, step)
            self._take_over()
            return
        self._touched = now if self._touched is None else self._touched
        if now - self._touched < SKIPPED or self._blocks >= MAX_BLOCKS:
            return
        if self._block is None:
            self._block = _Block(self._touched, now, np.zeros_like(voltage), np.zeros_like(pressure))
        self._block.voltage += voltage
        self._block.pressure += pressure
        self._block.frames += 1
        if now - self._block.start >= BLOCK:
            self._waiting.append(self._block)
            self._block, self._blocks = None, self._blocks + 1

    def tared(self) -> None:
        """Begin again from new rest levels; gains stay."""
        self.offset, self._block, self._touched = np.zeros_like(self.offset), None, None

    def _end_contact(self) -> None:
        """The last block of a contact holds its release, and is left out."""
        self._block, self._touched, self._blocks = None, None, 0

    def _follow_zero(self, pressure: np.ndarray, seconds: float) -> None:
        quiet = QUIET_FRACTION * self._threshold
        over = np.clip(np.nan_to_num(pressure), -quiet, quiet)
        bound = MAX_OFFSET * self._threshold
        self.offset = np.clip(self.offset + over * min(seconds / ZERO_SECONDS, 1.0), -bound, bound)

    def use_spare_time(self) -> None:
        """Between contacts, compute image and forces of one block, or begin an update if all blocks are computed."""
        if self._touched is not None:
            return
        if self._waiting:
            self._see(self._waiting.popleft())
        elif self._fresh and self._worker is None:
            self._begin_update()

    def _see(self, block: _Block) -> None:
        voltage, pressure = block.mean()
        if not np.isfinite(pressure).all():
            return
        loads = contact_loads(self._calibration, voltage[None], pressure[None])
        if len(loads.observed):
            seen = seen_contacts(self._calibration, loads, self._prior.mean)
            if seen.force.sum() > self._noise.least_force:
                self._contacts.add(block.contact, seen)
                self._fresh += 1

    def _warm_up(self) -> None:
        """Compile what a block needs."""
        readings, pads = self._calibration.recon.readings, len(self._threshold)
        loads = contact_loads(self._calibration, np.zeros((1, readings)), np.zeros((1, pads)))
        places = self._calibration.locate(np.zeros((1, readings)), single=True)
        one = loads._replace(pressure=np.ones((1, pads)), observed=np.zeros(1), place=np.zeros((1, 2)), places=places)
        seen_contacts(self._calibration, one, self._prior.mean)

    def _begin_update(self) -> None:
        self._fresh = 0
        if len(self._contacts) < MIN_CONTACTS:
            return
        self._found = None
        self._worker = threading.Thread(
            target=self._update, args=(self._contacts.seen(),), daemon=True, name="recalibration"
        )
        self._worker.start()

    def _update(self, seen: ObservedContacts) -> None:
        try:
            self._found = update_from_use(self._prior, self._reference, self._noise, seen)
        except Exception as error:  # of any type: the thread that takes the update over says it
            self._found = error

    def _take_over(self) -> None:
        """Use the result of an update, within bounds."""
        if self._worker is None or self._worker.is_alive():
            return
        self._worker, update = None, self._found
        if isinstance(update, Exception):
            self._tell_failure(update)
            return
        if update is None or not np.isfinite(update.mean).all():
            return
        start = np.zeros_like(update.mean)
        mean = np.clip(update.mean, start - MAX_MOVE, start + MAX_MOVE)
        known = None if self.record is None or self._failure else self.record.advice
        self._failure = ""
        self.record = self._recorded(update._replace(mean=mean))
        self.gains = PadGains(jnp.asarray(mean), jnp.asarray(update.covariance))
        if self.record.advice is not known:
            self._tell(self.health)
        if self._saved + SAVE_INTERVAL * 1e9 < self._last:
            self._saved = self._last
            moved = self._moved()  # here, because the other thread must not ask JAX for numbers
            threading.Thread(target=self._write, args=(moved,), daemon=True, name="saving the calibration").start()

    def _tell_failure(self, error: Exception) -> None:
        known, why = self._failure, repr(error)  # of one line
        self._failure = f"calibration health: an update failed, and gains stay as they are: {why}"
        if self._failure != known:
            self._tell(self.health)

    def _recorded(self, update: GainUpdate) -> Recalibration:
        force = np.maximum(self._contacts.seen().force, 0)
        count = (force / force.sum(1, keepdims=True)).sum(0)
        level = np.zeros_like(self.offset) if self._calibration.rest is None else self._calibration.rest
        levels = rest_levels((level + self.offset)[None], np.zeros(1))
        now = datetime.now(UTC).isoformat(timespec="seconds")
        bounded = (np.abs(update.mean) >= MAX_MOVE).any()
        notes = [f"a gain reached the bound of {MAX_MOVE:g}: recalibrate with a load cell"] if bounded else []
        return recorded(self._calibration, Evidence.ORDINARY_USE, update, count, levels, (now, "live"), notes)

    def save(self) -> None:
        """Write the moved calibration to its file; nothing before anything is learned."""
        self._write(self._moved())

    def _moved(self) -> Calibration:
        """The calibration with all that is known now."""
        layer = None if self._layer is None else self._layer()
        taught = layer is not None and layer.contacts
        found = replace(self._calibration, layer=layer) if taught else self._calibration
        if self.record is None:
            return found
        return replace(found, recalibration=self.record, notes=(*self._calibration.notes, self.record.health))

    def _write(self, moved: Calibration) -> None:
        if self._path is not None and moved is not self._calibration:
            moved.save(self._path)
