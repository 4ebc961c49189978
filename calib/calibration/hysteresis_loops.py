"""One complete press of each pad, loading and unloading, which shows the pad's hysteresis beside its fitted curve."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..presses.pooled import PooledPresses, PressSeries, block_means

POINTS = 96  # means per press: a smooth line in the report at a negligible size in the file
FULL_FORCE = 0.9  # fraction of a pad's largest force: presses above it cover nearly the whole range


@dataclass(frozen=True, eq=False)
class Loops:
    """The most typical full press of each pad; a row is NaN if no press belongs to that pad alone.

    | field    | meaning                                                     | shape     | unit |
    |----------|-------------------------------------------------------------|-----------|------|
    | pressure | change of the pad's pressure along the press; padded by NaN | (pads, n) | Pa   |
    | force    | force of the load cell at the same times                    | (pads, n) | N    |
    | gain     | factor of the correction by location at that press          | (pads,)   | 1    |
    """

    pressure: np.ndarray
    force: np.ndarray
    gain: np.ndarray

    def of(self, pad: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Pressure (m,) Pa and force (m,) N along a pad's press, and the index of the largest pressure."""
        known = np.isfinite(self.pressure[pad]) & np.isfinite(self.force[pad])
        pressure, force = self.pressure[pad][known], self.force[pad][known]
        return pressure, force, int(np.argmax(pressure)) if len(pressure) else 0

    def unloads(self, pad: int) -> bool:
        """Whether the recording of the press includes unloading to below half of its largest pressure."""
        pressure, _, top = self.of(pad)
        return len(pressure) > 0 and top > 0 and bool((pressure[top:] < 0.5 * pressure[top]).any())

    def width(self, pad: int) -> float:
        """Mean of force on loading minus force on unloading at equal pressure, N; NaN without a common range."""
        if not self.unloads(pad):
            return float("nan")
        pressure, force, top = self.of(pad)
        up, down = _rising(pressure[: top + 1], force[: top + 1]), _rising(pressure[top:][::-1], force[top:][::-1])
        low, high = max(up[0][0], down[0][0]), min(up[0][-1], down[0][-1])
        at = np.linspace(low, high, 65)
        return float(np.mean(np.interp(at, *up) - np.interp(at, *down))) if high > low else float("nan")

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Arrays of the file: name to values, unit and meaning."""
        return {
            "pressure": (self.pressure, "Pa", "along each pad's most typical full press"),
            "force": (self.force, "N", "load cell, at the same times"),
            "gain": (self.gain, "1", "of the correction by location at that press"),
        }

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], prefix: str) -> "Loops | None":
        """The loops that `arrays` described, found under this prefix; None for a file of an early version."""
        names = ("pressure", "force", "gain")
        return cls(**{n: arrays[prefix + n] for n in names}) if prefix + "pressure" in arrays else None


def _rising(pressure: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The samples at which the pressure exceeds all earlier ones, because `np.interp` needs increasing pressures."""
    new = np.r_[True, pressure[1:] > np.maximum.accumulate(pressure)[:-1]]
    return pressure[new], force[new]


def typical_loops(presses: PooledPresses, gain: np.ndarray | None = None) -> Loops:
    """The most typical press of each pad: of the presses near the pad's largest force, the one of median stiffness.

    Args:
        gain: factor of the correction by location at each press, (presses, pads); default: 1.
    """
    data, series = presses.data, presses.series
    pads = data.pressure.shape[1]
    chosen = [_typical(np.flatnonzero(presses.owner == pad), data.force, data.pressure[:, pad]) for pad in range(pads)]
    out = np.full((2, pads, POINTS), np.nan)
    for pad, one in enumerate(chosen):
        mine = block_means(PressSeries(*(column[series.press == one] for column in series)), POINTS)
        count = len(mine.force)
        out[:, pad, :count] = (mine.pressure[:, pad], mine.force) if count else np.nan
    known = [np.nan if one < 0 else 1.0 if gain is None else gain[one, pad] for pad, one in enumerate(chosen)]
    return Loops(pressure=out[0], force=out[1], gain=np.array(known, float))


def _typical(rows: np.ndarray, force: np.ndarray, pressure: np.ndarray) -> int:
    """Index of the full press of median stiffness among the presses `rows`; -1 if there are none."""
    if not len(rows):
        return -1
    full = rows[force[rows] >= FULL_FORCE * force[rows].max()]
    stiffness = force[full] / np.where(pressure[full] > 0, pressure[full], np.inf)
    return int(full[np.argsort(stiffness, kind="stable")[len(full) // 2]])
