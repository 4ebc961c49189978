"""The stage's work: where and how strongly it presses, and the force over time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BLANK, REST, RAMP, HOLD, RELEASE, RECOVERY = 20.0, 0.6, 1.0, 2.0, 0.6, 0.8
PERIOD = REST + RAMP + HOLD + RELEASE + RECOVERY
STIFFNESS = 8e3
"""Of tip and foam together, N/m; it sets only how deep the stage says that it went."""
CLEARANCE = 5e-3


@dataclass(frozen=True, eq=False)
class Presses:
    """Presses in the order of time: places (n, 2), m; forces (n,), N."""

    places: np.ndarray
    forces: np.ndarray


class Moment(NamedTuple):
    """For each time: the press whose turn it is (-1 before the first), its force, N, and seconds since it touched."""

    press: np.ndarray
    force: np.ndarray
    since: np.ndarray


def plan(size: np.ndarray, count: int, levels: list[float], rng: np.random.Generator, margin: float = 0.012) -> Presses:
    """``count`` places spread over the sheet, at most one in each cell of a grid, each pressed at every level."""
    columns = int(np.ceil(np.sqrt(count)))
    rows = int(np.ceil(count / columns))
    cells = rng.permutation(columns * rows)[:count]
    unit = (np.stack([cells % columns, cells // columns], 1) + rng.uniform(0.1, 0.9, (count, 2))) / [columns, rows]
    places = margin + unit * (size - 2 * margin)
    forces = np.stack([rng.permutation(levels) for _ in range(count)])
    return Presses(np.repeat(places, len(levels), 0), forces.ravel())


def duration(presses: Presses) -> float:
    return BLANK + PERIOD * len(presses.forces) + REST


def moments(presses: Presses, times: np.ndarray) -> Moment:
    """The state at each time, s; the force rises and falls as a cosine."""
    turn = np.clip(np.floor((times - BLANK) / PERIOD).astype(int), -1, len(presses.forces) - 1)
    since = times - BLANK - turn * PERIOD - REST
    up = _smooth(since / RAMP)
    down = _smooth((since - RAMP - HOLD) / RELEASE)
    force = np.where(turn >= 0, presses.forces[turn] * (up - down), 0.0)
    return Moment(turn, force, since)


def _smooth(x: np.ndarray) -> np.ndarray:
    return (1 - np.cos(np.pi * np.clip(x, 0, 1))) / 2


def stage(presses: Presses, moment: Moment) -> np.ndarray:
    """Tip in the skin's frame, (times, 3), m: above the skin between presses, moving during the rests."""
    there = presses.places[np.maximum(moment.press, 0)]
    before = presses.places[np.maximum(moment.press - 1, 0)]
    moved = np.clip(1 + moment.since / REST, 0, 1)[:, None]
    clear = np.clip(np.maximum(-moment.since, moment.since - RAMP - HOLD - RELEASE) / 0.3, 0, 1)
    height = CLEARANCE * clear - moment.force / STIFFNESS
    return np.column_stack([before + (there - before) * moved, height])
