"""Contacts in a recording without presses: found by the pressures of the pads, each between two rests."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from ...presses.means import press_means
from ...presses.streams import MAD_TO_SIGMA, finite_mean, true_runs
from ...presses.timing.windows import PressWindows
from ...session import Session, Stream
from ...session.units import SECOND
from ..application.force_maps import force_model, is_loaded
from ..calibration import Calibration

BIN = SECOND // 10  # over which pressures are averaged
REST = 5 * BIN  # averaged before and after a contact
RECOVERY = 3 * BIN  # after a release, before the rest counts
BLOCK = 5 * BIN  # of a contact that makes one observation
MAX_CONTACT = 60 * SECOND  # the zero is not known well enough in a longer one
MAX_BLOCKS = 8  # of a contact
MAX_OBSERVATIONS = 400  # of a session, because the cost grows with the cube
NOISE_MULTIPLE = 5.0  # of the noise of a bin: a pad that differs more from its zero is being pressed or released
SMALL_FRACTION = 0.01  # of the pressure of a loaded pad: less is no load, however small the noise
MAX_RAMP = 100  # bins before and after a load that may belong to it
ZERO_BINS = 10.0  # over which the zero follows the pressure while nothing is loaded


class UseContacts(NamedTuple):
    """Observations of contacts, and the levels at rest between them.

    | field    | meaning                                        | shape         | unit |
    |----------|------------------------------------------------|---------------|------|
    | dv       | change of the readings                         | (n, readings) | V    |
    | pressure | change of the pressures                        | (n, pads)     | Pa   |
    | contact  | number of the contact                          | (n,)          |      |
    | rest     | gage pressure around the contacts              | (n, pads)     | Pa   |
    | time     | of each observation                            | (n,)          | ns   |
    """

    dv: np.ndarray
    pressure: np.ndarray
    contact: np.ndarray
    rest: np.ndarray
    time: np.ndarray


def loaded_pressures(calibration: Calibration) -> Float[np.ndarray, " pads"]:
    """Pressure (pads,) Pa from which each pad counts as loaded, as in `is_loaded`."""
    model = force_model(calibration)
    # each pad for itself, though all rise together here
    model = replace(model, pads=replace(model.pads, crosstalk=None))
    high = float(np.max(np.asarray(model.pads.curves.pressure_range)))
    rising = jnp.linspace(0, high, 2000, dtype=model.pads.dtype)
    pads = len(calibration.skin.pads)
    loaded = np.asarray(is_loaded(model, jnp.broadcast_to(rising[:, None], (2000, pads))))
    return np.asarray(rising)[np.where(loaded.any(0), loaded.argmax(0), 1999)]


def use_contacts(session: Session, calibration: Calibration) -> UseContacts:
    """Cut the contacts out of a session's eit and pressure streams, and average them in blocks of half a second."""
    eit, pressure = session.stream("eit"), session.stream("pressure")
    time, mean = binned(pressure)
    threshold = loaded_pressures(calibration)
    small = quiet_range(mean, threshold)
    loaded, zero = zero_and_loads(mean, threshold, small)
    touched = _widened(np.abs(mean - zero) > small, loaded)
    blocks = list(_blocks(time, touched, int(eit.time[0]), int(eit.time[-1])))
    blocks = [blocks[i] for i in np.linspace(0, len(blocks) - 1, min(len(blocks), MAX_OBSERVATIONS)).astype(int)]
    if not blocks:
        none = np.empty((0, pressure.channels))
        free = zero[~touched] if not touched.all() else zero[:1]
        return UseContacts(np.empty((0, eit.channels)), none, np.empty(0, int), free, time[: len(free)])
    windows = _windows(np.array(blocks))
    corrections = {s.name: calibration.processing.of(s) for s in (eit, pressure)}
    held = {s.name: press_means(s, windows, corrections=corrections[s.name]) for s in (eit, pressure)}
    pads, number = held["pressure"], windows.rest_before[:, 1]  # blocks of one contact follow the same rest
    return UseContacts(held["eit"].change.mean, pads.change.mean, number, pads.baseline, windows.hold.mean(1))


def distinct(
    contact: Int[np.ndarray, " n"], place: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], distance: float
) -> Bool[np.ndarray, " n"]:
    """Which observations are kept: of each contact the strongest, and others farther than `distance` (m) from it.

    Observations of one contact at one place have the same error, which their number does not make smaller.
    """
    near = (contact[:, None] == contact) & (cdist(place, place) <= distance)
    kept = np.zeros(len(load), bool)
    for i in np.argsort(-load, kind="stable"):
        kept[i] = not (near[i] & kept).any()
    return kept


def binned(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Starts (bins,) ns of the bins that hold samples, and the means of these, (bins, channels)."""
    bins, means = [], []
    for first, last, values in stream.blocks():
        number = stream.time[first:last] // BIN
        starts = np.flatnonzero(np.r_[True, number[1:] != number[:-1]])
        good = np.isfinite(values)
        count = np.add.reduceat(good, starts, axis=0)
        total = np.add.reduceat(np.where(good, values, 0.0), starts, axis=0)
        bins.append(number[starts] * BIN)
        means.append(total / np.where(count > 0, count, np.nan))
    return np.concatenate(bins), np.concatenate(means)


def quiet_range(
    mean: Float[np.ndarray, "bins pads"], threshold: Float[np.ndarray, " pads"]
) -> Float[np.ndarray, " pads"]:
    """Deviation (pads,) Pa from the zero that noise explains, by the median of the steps between bins."""
    step = np.abs(np.diff(mean, axis=0))
    noise = MAD_TO_SIGMA * np.nanmedian(step, axis=0) / np.sqrt(2) if len(step) else np.zeros_like(threshold)
    return np.asarray(np.clip(NOISE_MULTIPLE * np.nan_to_num(noise), SMALL_FRACTION * threshold, threshold))


def zero_and_loads(
    mean: Float[np.ndarray, "bins pads"], threshold: Float[np.ndarray, " pads"], quiet: Float[np.ndarray, " pads"]
) -> tuple[np.ndarray, np.ndarray]:
    """Whether a pad is loaded in each bin (bins,), and the zero (bins, pads) Pa, which is frozen meanwhile.

    The first second is at rest. The zero follows by steps of at most a part of `quiet`, so that it follows drift, but
    not the beginning of a press. A pad that reads below zero is not loaded: its zero was wrong.
    """
    zero, loaded, zeros = finite_mean(mean[:10]), np.zeros(len(mean), bool), np.empty_like(mean)
    zero = np.where(np.isfinite(zero), zero, 0.0)
    for i, row in enumerate(mean):
        over = np.nan_to_num(row - zero)
        loaded[i] = bool((over > threshold).any())
        if not loaded[i]:
            zero = zero + np.clip(over, -quiet, quiet) / ZERO_BINS
        zeros[i] = zero
    return loaded, zeros


def _widened(differs: np.ndarray, loaded: np.ndarray) -> np.ndarray:
    """Loads (bins,) with their beginnings and ends, in which a pad differs (bins, pads) from its zero."""
    wide = loaded.copy()
    for a, b in true_runs(loaded | differs.any(1)):
        wide[a:b] |= loaded[a:b].any() and b - a - int(loaded[a:b].sum()) < MAX_RAMP
    return wide


def _blocks(time: np.ndarray, loaded: np.ndarray, begin: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """End of the rest before, start and end of a block, and start of the rest after, ns, for all blocks."""
    for a, b in true_runs(loaded):
        start, stop = int(time[a]), int(time[b - 1]) + BIN
        clear = a == 0 or b == len(time) or loaded[max(a - 8, 0) : a].any() or loaded[b : b + 8].any()
        if clear or start - REST - BIN < begin or stop + RECOVERY + REST > end or stop - start > MAX_CONTACT:
            continue
        first, last = start + 2 * BIN, stop - 2 * BIN  # without touch-down and release
        many = min(max((last - first) // BLOCK, 1), MAX_BLOCKS)
        edges = np.linspace(first, last, many + 1).astype(np.int64)
        for t0, t1 in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if t1 - t0 >= BIN:
                yield start - BIN, t0, min(t1, t0 + BLOCK), stop + RECOVERY


def _windows(blocks: np.ndarray) -> PressWindows:
    before, start, stop, after = blocks.T
    hold = np.stack([start, stop], 1)
    return PressWindows(
        rest_before=np.stack([before - REST, before], 1),
        ramp=np.stack([start, start], 1),
        hold=hold,
        release=np.stack([stop, stop], 1),
        rest_after=np.stack([after, after + REST], 1),
    )
