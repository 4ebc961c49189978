"""Time windows of presses: rest before, ramp, hold, release, rest after. All windows are half open."""

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np

from jaxeit.registry import limited, require_limits

from ...session.units import SECOND
from ..corrections import AbstractBaseline, TwoSided
from ..streams import ReadableStream, index_ranges
from .times import P, PressColumns, reject


@dataclass(frozen=True, eq=False)
class PressWindows:
    """Half-open time windows (presses, 2) in ns, one row per press. `hold` is the last part of the hold only."""

    rest_before: np.ndarray
    ramp: np.ndarray
    hold: np.ndarray
    release: np.ndarray
    rest_after: np.ndarray

    def centre(self, name: str) -> np.ndarray:
        """Middle of a window, (presses,) ns as float."""
        return np.asarray(getattr(self, name).astype(float).mean(axis=1))

    def rows(self, index: np.ndarray | slice) -> "PressWindows":
        """Windows of some of the presses."""
        return PressWindows(*(getattr(self, field.name)[index] for field in fields(self)))

    def shifted(self, step: int) -> "PressWindows":
        """All windows later by ``step``, ns."""
        return PressWindows(*(getattr(self, field.name) + step for field in fields(self)))


@dataclass(frozen=True)
class WindowLengths:
    """Lengths of windows in seconds.

    | field    | meaning                                                                            |
    |----------|------------------------------------------------------------------------------------|
    | hold     | part at the end of the hold that is averaged, when the pad has relaxed             |
    | rest     | part without contact that is averaged, before and after the press                  |
    | recovery | time from release to the end of the rest window, unless the next press comes first |
    | guard    | margin that is left out before a contact and at the end of the hold                |
    """

    hold: float = limited(1.0, above=0)
    rest: float = limited(0.5, above=0)
    recovery: float = limited(1.5, least=0)
    guard: float = limited(0.05, least=0)

    def __post_init__(self) -> None:
        require_limits(self)


def _ns(seconds: float) -> int:
    return round(seconds * SECOND)


def press_windows(presses: PressColumns, lengths: WindowLengths | None = None, end: int | None = None) -> PressWindows:
    """Windows of every press, accepted or not.

    A rest window never reaches into a neighbouring press, nor beyond `end` (ns), where the recording stops.
    """
    lengths = WindowLengths() if lengths is None else lengths
    guard = _ns(lengths.guard)
    press, hold0, hold1, release = (
        np.asarray(t, np.int64) for t in (presses.t_press, presses.t_hold0, presses.t_hold1, presses.t_release)
    )
    previous = np.concatenate([[np.iinfo(np.int64).min // 2], release[:-1]])
    last = np.iinfo(np.int64).max // 2 if end is None else end + guard
    following = np.concatenate([press[1:], [last]])
    before = press - guard
    after = np.minimum(release + _ns(lengths.recovery), following - guard)
    hold_end = np.maximum(hold1 - guard, hold0)
    return PressWindows(
        rest_before=np.stack([np.clip(before - _ns(lengths.rest), previous, before), before], 1),
        ramp=np.stack([press, hold0], 1),
        hold=np.stack([np.maximum(hold_end - _ns(lengths.hold), hold0), hold_end], 1),
        release=np.stack([hold1, release], 1),
        rest_after=np.stack([np.clip(after - _ns(lengths.rest), np.minimum(release, after), after), after], 1),
    )


def _interval_text(window: np.ndarray) -> str:
    return f"between {window[0] / SECOND:.3f} s and {window[1] / SECOND:.3f} s"


SAMPLE_NOUNS = {"eit": "EIT frame"}


def reject_without_samples(
    presses: P, windows: PressWindows, streams: Iterable[ReadableStream], baseline: AbstractBaseline | None = None
) -> P:
    """Reject presses for which a stream has no sample in the hold, or in a rest window that the baseline uses."""
    needed = ["rest_before", "hold"]
    rule = TwoSided() if baseline is None else baseline
    if np.any(rule.weights(np.array([0.5]), np.array([0.0]), np.array([1.0]))[1] != 0):
        needed.append("rest_after")
    for stream in streams:
        noun = SAMPLE_NOUNS.get(stream.name, f"{stream.name} sample")
        for name in needed:
            times = getattr(windows, name)
            empty = np.diff(index_ranges(stream.time, times), axis=1)[:, 0] == 0
            reasons = [f"no {noun} {_interval_text(w)}" if e else "" for w, e in zip(times, empty, strict=True)]
            presses = reject(presses, reasons)
    return presses
