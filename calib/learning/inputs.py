"""From frames to the inputs of a network: directions of the readings, dead electrodes, and forces on the pads."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxeit.contacts.loads.learned import components, standardised

from ..bench import TrainingFrames

DIRECTIONS = 96  # of the readings at most
MIN_VARIANCE = 1.5  # of a direction, over that of the noise
Change = Callable[[np.ndarray], np.ndarray]


class Compression(NamedTuple):
    """As the fields of `jaxeit.contacts.loads.learned.proposal.Proposal` of the same names.

    | meaning                                                  | shape                | unit |
    |----------------------------------------------------------|----------------------|------|
    | noise of a reading                                       | ()                   | V    |
    | basis, spread                                            | (readings, r), (r,)  | 1    |
    | mean, deviation                                          | (r + 1,)             | 1    |
    """

    noise: np.ndarray
    basis: np.ndarray
    spread: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray


def fit_compression(frames: TrainingFrames, noise: float) -> Compression:
    """Directions in which frames of the training differ, shard by shard in memory."""
    size = frames["untouched"].shape[1]
    moment, count = np.zeros((size, size)), 0
    for skin in frames.skins():
        d = skin["frames"].astype(float) / noise
        moment, count = moment + d.T @ d, count + len(d)
    values, vectors = np.linalg.eigh(moment / count)
    kept = np.flatnonzero(values > MIN_VARIANCE)[-DIRECTIONS:][::-1]
    # In the precision of the file, so that the network learns from what it will be given.
    basis, spread = vectors[:, kept].astype(np.float16), np.sqrt(values[kept])
    sums, squares = np.zeros(len(kept) + 1), np.zeros(len(kept) + 1)
    for skin in frames.skins():
        seen, _ = standardised(skin["frames"].astype(float) / noise @ basis, np.zeros(len(sums)), np.ones(len(sums)))
        sums, squares = sums + seen.sum(0), squares + (seen**2).sum(0)
    mean = sums / count
    return Compression(np.array(noise), basis, spread, mean, np.sqrt(squares / count - mean**2))


class Inputs(NamedTuple):
    """What a network sees of frames, and what tells whether they are like others.

    | meaning                                                          | shape           |
    |------------------------------------------------------------------|-----------------|
    | seen: direction and log size of their components, standardised   | (frames, r + 1) |
    | size of the components                                           | (frames,)       |
    | left: square of what no component explains                       | (frames,)       |
    | readings that are there: their number                            | (frames,)       |
    """

    seen: Float[np.ndarray, "frames i"]
    size: Float[np.ndarray, " frames"]
    left: Float[np.ndarray, " frames"]
    readings: Int[np.ndarray, " frames"]


def inputs_of(frames: TrainingFrames, compression: Compression, change: Change = lambda dv: dv) -> Inputs:
    """Inputs from frames, which are changed first; readings that are then not finite are missing."""
    parts = []
    for skin in frames.skins():
        z, left, count = components(change(skin["frames"].astype(float)) / compression.noise, *compression[1:3])
        seen, size = standardised(z, compression.mean, compression.deviation)
        parts.append((seen.astype(np.float32), size, left, count))
    return Inputs(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def without_an_electrode(
    dv: Float[np.ndarray, "frames readings"], pattern: Int[np.ndarray, "readings 4"], rng: np.random.Generator
) -> Float[np.ndarray, "frames readings"]:
    """Frames without the readings of an electrode that is drawn for each."""
    dead = rng.integers(pattern.max() + 1, size=len(dv))
    lost = (pattern[None] == dead[:, None, None]).any(-1)
    return np.where(lost, np.nan, dv)


def calibrated_forces(frames: TrainingFrames) -> Float[np.ndarray, "frames pads"]:
    """Forces on the pads as a calibration of each skin would tell them from the pressures: a straight line each."""
    if "pressures" not in frames.card["arrays"]:
        return np.zeros((len(frames), 0))
    found = []
    for skin in frames.skins():
        felt, true = skin["pressures"].astype(float), skin["pad_forces"].astype(float)
        found.append(felt * (felt * true).sum(0) / np.maximum((felt**2).sum(0), np.finfo(float).tiny))
    return np.concatenate(found)
