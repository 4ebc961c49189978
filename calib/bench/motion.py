"""Motion of the simulated bench: loads, slides, temperature and air pressure at any time."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .bench import Bench


class BenchMotion(NamedTuple):
    """The plan of a bench as its stage follows it; a contact is a tip.

    | field  | meaning                                                  | shape                  | unit |
    |--------|----------------------------------------------------------|------------------------|------|
    | bench  |                                                          |                        |      |
    | places | of the tips at the start of each press                   | (presses, contacts, 2) | m    |
    | start  | of each press, including the rest before it              | (presses,)             | s    |
    | pace   | speed of the ramps over the planned speed                | (presses,)             | 1    |
    | forces | target forces of the tips                                | (presses, contacts)    | N    |
    """

    bench: Bench
    places: Float[np.ndarray, "presses contacts 2"]
    start: Float[np.ndarray, " presses"]
    pace: Float[np.ndarray, " presses"]
    forces: Float[np.ndarray, "presses contacts"]


class LoadState(NamedTuple):
    """Loads at given times.

    | field    | meaning                                                           | shape            | unit |
    |----------|-------------------------------------------------------------------|------------------|------|
    | press    | index of the press; that of the first during the blank before it  | (time,)          |      |
    | phase    | phase of that press; a phase ends when any tip starts or stops    | (time,)          |      |
    | load     | of each tip                                                       | (time, contacts) | N    |
    | progress | along the slide, 0 to 1; 0 without a slide                        | (time, contacts) | 1    |
    """

    press: Int[np.ndarray, " time"]
    phase: Int[np.ndarray, " time"]
    load: Float[np.ndarray, "time contacts"]
    progress: Float[np.ndarray, "time contacts"]


def planned_motion(bench: Bench) -> BenchMotion:
    """The motion of an ideal stage, exactly as planned."""
    also = bench.companions
    offsets = np.array([(0.0, 0.0), *(c.offset for c in also)])
    forces = np.stack([bench.press_forces, *(np.full(len(bench.sites), c.force) for c in also)], 1)
    start = bench.blank + np.arange(len(bench.sites)) * bench.period
    return BenchMotion(bench, bench.sites[:, None] + offsets, start, np.ones(len(start)), forces)


def loads_at(motion: BenchMotion, times: Float[np.ndarray, " time"]) -> LoadState:
    """Loads and slides at the given times (s)."""
    timing = motion.bench.timing
    press = np.clip(np.searchsorted(motion.start, times, side="right") - 1, 0, None)
    delay = np.array([0.0, *(c.delay for c in motion.bench.companions)])
    since = (times - motion.start[press] - timing.rest)[:, None] - delay
    pace = motion.pace[press, None]
    up = np.clip(since * pace / timing.ramp, 0, 1)
    down = np.clip((since - timing.ramp - timing.hold) * pace / timing.release, 0, 1)
    load = 0.5 * (1 - np.cos(np.pi * (up - down))) * motion.forces[press]
    ends = np.cumsum([0, timing.ramp, timing.hold, timing.release])
    changes = np.sort((delay[:, None] + ends).ravel())
    phase = np.searchsorted(changes, since[:, 0], side="right")
    progress = np.zeros_like(load)
    if any(motion.bench.slide):
        progress = 0.5 * (1 - np.cos(np.pi * np.clip((since - timing.ramp) / timing.hold, 0, 1)))
    return LoadState(press, phase, load, progress)


def phase_count(bench: Bench) -> int:
    """Number of phases of a press."""
    return 4 * (1 + len(bench.companions)) + 1


def temperature_rise(bench: Bench, times: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Temperature above that at the start, K."""
    return bench.temperature_rate * times


def barometer_rise(bench: Bench, times: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Air pressure above that at the start, Pa."""
    return bench.barometer_rate * times
