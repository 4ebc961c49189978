"""What the bench does to the skin at any time: loads, places, and the air around."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .plan import Bench


class Motion(NamedTuple):
    """The plan of a bench as its stage follows it; a contact is a tip.

    | meaning                                              | shape                  | unit |
    |------------------------------------------------------|------------------------|------|
    | bench                                                |                        |      |
    | places of the tips at the start of each press        | (presses, contacts, 2) | m    |
    | start of each press, rest included                   | (presses,)             | s    |
    | pace of the ramps over the planned                   | (presses,)             | 1    |
    | forces that the tips go to                           | (presses, contacts)    | N    |
    """

    bench: Bench
    places: Float[np.ndarray, "presses contacts 2"]
    start: Float[np.ndarray, " presses"]
    pace: Float[np.ndarray, " presses"]
    forces: Float[np.ndarray, "presses contacts"]


class Moment(NamedTuple):
    """What acts at given times.

    | meaning                                                | shape            | unit |
    |--------------------------------------------------------|------------------|------|
    | press under way; the first in the blank before it      | (time,)          |      |
    | phase of that press, between changes of any tip's work | (time,)          |      |
    | load of each tip                                       | (time, contacts) | N    |
    | progress of its slide, 0 to 1; 0 if it has none        | (time, contacts) | 1    |
    """

    press: Int[np.ndarray, " time"]
    phase: Int[np.ndarray, " time"]
    load: Float[np.ndarray, "time contacts"]
    progress: Float[np.ndarray, "time contacts"]


def planned(bench: Bench) -> Motion:
    """The motion of a stage that does as it is told."""
    also = bench.companions
    offsets = np.array([(0.0, 0.0), *(c.offset for c in also)])
    forces = np.stack([bench.press_forces, *(np.full(len(bench.sites), c.force) for c in also)], 1)
    start = bench.blank + np.arange(len(bench.sites)) * bench.period
    return Motion(bench, bench.sites[:, None] + offsets, start, np.ones(len(start)), forces)


def moments(motion: Motion, times: Float[np.ndarray, " time"]) -> Moment:
    """Loads and slides at these times, s."""
    timing = motion.bench.timing
    press = np.clip(np.searchsorted(motion.start, times, side="right") - 1, 0, None)
    delay = np.array([0.0, *(c.delay for c in motion.bench.companions)])
    since = (times - motion.start[press] - timing.rest)[:, None] - delay
    pace = motion.pace[press, None]
    up = np.clip(since * pace / timing.ramp, 0, 1)
    slid = np.clip((since - timing.ramp) / timing.hold, 0, 1)
    down = np.clip((since - timing.ramp - timing.hold) * pace / timing.release, 0, 1)
    load = 0.5 * (np.cos(np.pi * down) - np.cos(np.pi * up)) * motion.forces[press]
    ends = np.cumsum([0, timing.ramp, timing.hold, timing.release])
    changes = np.sort((delay[:, None] + ends).ravel())
    phase = np.searchsorted(changes, since[:, 0], side="right")
    progress = 0.5 * (1 - np.cos(np.pi * slid)) * any(motion.bench.slide)
    return Moment(press, phase, load, progress)


def phases(bench: Bench) -> int:
    """How many phases a press has."""
    return 4 * (1 + len(bench.companions)) + 1


def temperature(bench: Bench, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Above that at the start, K."""
    return bench.temperature_rate * times


def barometer(bench: Bench, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """Air pressure above that at the start, Pa."""
    return bench.barometer_rate * times
