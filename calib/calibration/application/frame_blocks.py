"""Frames of a session in blocks, corrected, with the pressures at their times, and the forces in them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ...fitting.curves.play_operators import remembered
from ...presses.corrections import AbstractCorrection, correct
from ...presses.streams import finite_mean, resample
from ...presses.table import Processing
from ...session import Session, SessionError, Stream
from ..calibration import Calibration
from .force_maps import ForceEstimate, first_rows, force_map, force_model, is_loaded

Progress = Callable[[Iterable[Any]], Iterable[Any]]

BLOCK = 512  # frames held in memory at once
LEVELS = 64  # times at which the level without contact is averaged
MARGIN = 0.5  # s read beyond a block on both sides, so that filters start and end outside it


class FrameBlock(NamedTuple):
    """Frames of a session: times (n,) ns, frames and their change (n, readings) V, change of pressures (n, pads) Pa."""

    time: np.ndarray
    frames: np.ndarray
    change: np.ndarray
    pressed: np.ndarray

    def loaded(self, calibration: Calibration) -> np.ndarray:
        """Which frames are touched, (n,)."""
        return np.array(is_loaded(force_model(calibration), jnp.asarray(self.pressed)).any(1))


class FrameBlocks:
    """Corrected frames of a session with the pressures at their times, in blocks; each pass reads them anew."""

    def __init__(self, session: Session, processing: Processing, levels: Mapping[str, Any]):
        self._eit, self._pressure = session.stream("eit"), session.stream("pressure")
        self._filters = {s.name: processing.of(s) for s in (self._eit, self._pressure)}
        self._levels = levels

    def __len__(self) -> int:
        return len(range(0, len(self._eit), BLOCK))

    def untouched(self) -> np.ndarray:
        """Mean frame without contact, (readings,) V."""
        time = self._eit.time
        return np.asarray(finite_mean(self._levels["eit"](np.linspace(time[0], time[-1], LEVELS))))

    def __iter__(self) -> Iterator[FrameBlock]:
        for first in range(0, len(self._eit), BLOCK):
            span = slice(first, min(first + BLOCK, len(self._eit)))
            eit = _read(self._eit, span)
            pressure = _read(self._pressure, _around(self._pressure, eit.time[eit.kept]))
            time, frames = eit.corrected(self._filters["eit"])
            pressure_time, values = pressure.corrected(self._filters["pressure"])
            pressed = resample(pressure_time, values, time) - self._levels["pressure"](time)
            yield FrameBlock(time, frames, frames - self._levels["eit"](time), pressed)


class _WithMargin(NamedTuple):
    """A block of samples with a margin for the filters: times (m,) ns, values (m, channels), and the block in them."""

    name: str
    time: np.ndarray
    values: np.ndarray
    kept: slice

    def corrected(self, corrections: Sequence[AbstractCorrection]) -> tuple[np.ndarray, np.ndarray]:
        """Times and corrected values of the block."""
        return self.time[self.kept], correct(corrections, self.time, self.values, self.name)[self.kept]


def _read(stream: Stream, span: slice) -> _WithMargin:
    """A block of samples, read with a margin for the filters."""
    time = stream.time
    margin = round(MARGIN * 1e9)
    first = int(np.searchsorted(time, time[span.start] - margin))
    last = int(np.searchsorted(time, time[span.stop - 1] + margin, side="right"))
    kept = slice(span.start - first, span.stop - first)
    return _WithMargin(stream.name, time[first:last], stream.read(first, last), kept)


def _around(stream: Stream, time: np.ndarray) -> slice:
    """Samples of a stream that surround the given times."""
    first = max(int(np.searchsorted(stream.time, time[0])) - 1, 0)
    last = min(int(np.searchsorted(stream.time, time[-1])) + 1, len(stream))
    if last <= first:
        raise SessionError(
            f"/streams/{stream.name}: no sample at the time of the EIT frames; the streams do not "
            "overlap: check their clocks"
        )
    return slice(first, last)


def estimated(calibration: Calibration, blocks: Iterable[FrameBlock]) -> Iterable[tuple[FrameBlock, ForceEstimate]]:
    """Each block with the forces in its frames."""
    before = np.zeros((1, len(calibration.skin.pads)))
    for block in blocks:
        yield block, _forces(calibration, block, before)
        if calibration.curves.curve.path:
            before = remembered(np.concatenate([before, calibration.own_pressures(block.pressed)]))


def _forces(calibration: Calibration, block: FrameBlock, before: np.ndarray) -> ForceEstimate:
    """Forces of a block; the last frame of a shorter one repeats, because each length compiles the program again."""
    count = len(block.time)
    rows = np.minimum(np.arange(BLOCK), count - 1)
    found = force_map(calibration, block.change[rows], block.pressed[rows], before=before)
    return first_rows(found, count)
