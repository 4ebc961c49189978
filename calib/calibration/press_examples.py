"""Some presses of a calibration, kept as they were read: for the report, and for what the model of the skin errs by."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import jaxeit as je

from ..presses.pooled import PooledPresses
from .localisation.farthest_points import farthest_first

COUNT = 4
PROBES = 24  # presses all over the sheet
FULL_FORCE = 0.9  # fraction of the largest force: presses above it may be examples


@dataclass(frozen=True, eq=False)
class PressExamples:
    """Presses at different places, with what the skin read over their holds.

    | field    | meaning                             | shape         | unit |
    |----------|-------------------------------------|---------------|------|
    | dv       | change of the readings              | (n, readings) | V    |
    | pressure | change of the readings of the pads  | (n, pads)     | Pa   |
    | position | true position of the tip            | (n, 2)        | m    |
    | force    | of the load cell                    | (n,)          | N    |
    """

    dv: np.ndarray
    pressure: np.ndarray
    position: np.ndarray
    force: np.ndarray

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Arrays of the file: name to values, unit and meaning."""
        return {
            "dv": (self.dv, "V", "change of the readings over the holds of some presses"),
            "pressure": (self.pressure, "Pa", "change of the readings of the pads, likewise"),
            "position": (self.position, "m", "true position of the tip"),
            "force": (self.force, "N", "load cell"),
        }

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], prefix: str) -> "PressExamples | None":
        """The examples that `arrays` described, found under this prefix; None for a file of an early version."""
        names = ("dv", "pressure", "position", "force")
        return cls(**{n: arrays[prefix + n] for n in names}) if prefix + "dv" in arrays else None


def press_examples(presses: PooledPresses, skin: je.Skin) -> PressExamples:
    """Presses of nearly the largest force: one that pads share, and those nearest to the middles of some pads."""
    force, position = presses.data.force, presses.position
    rows = np.flatnonzero(force >= FULL_FORCE * force.max())
    shared = rows[presses.data.share[rows].max(1).argmin()]
    pads = [skin.pads[k] for k in np.unique(np.linspace(0, len(skin.pads) - 1, COUNT - 1).round().astype(int))]
    middles = [rows[np.linalg.norm(position[rows] - np.mean(pad.outline, 0), axis=1).argmin()] for pad in pads]
    chosen = list(dict.fromkeys([int(shared), *map(int, middles)]))
    return _rows(presses, np.array(chosen))


def press_probes(presses: PooledPresses) -> PressExamples:
    """Presses all over the sheet and of all forces: each is the one farthest from those before it."""
    span = np.ptp(presses.position, axis=0).max() or 1.0
    every = np.column_stack([presses.position / span, presses.data.force / presses.data.force.max()])
    return _rows(presses, farthest_first(every, PROBES)[0])


def _rows(presses: PooledPresses, chosen: np.ndarray) -> PressExamples:
    readings = np.concatenate([recording.pressure for recording in presses.recordings])
    return PressExamples(presses.dv[chosen], readings[chosen], presses.position[chosen], presses.data.force[chosen])
