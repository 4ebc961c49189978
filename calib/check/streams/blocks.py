"""Find time stamps that come in blocks: many samples with nearly one stamp, then a long step, again and again."""

import numpy as np

MIN_BLOCK = 3  # samples with nearly one stamp
CLOSE = 0.1  # of the mean interval: steps within a block
REGULAR = 0.8  # share of the blocks that have the usual size
MIN_BLOCKS = 4


def block_size(time: np.ndarray) -> int:
    """Number of samples in each block of time stamps (samples,) ns; 0 if they do not come in blocks."""
    steps = np.diff(time)
    if len(steps) < MIN_BLOCK * MIN_BLOCKS:
        return 0
    starts = np.flatnonzero(np.append(True, steps > CLOSE * steps.mean()))
    sizes = np.diff(starts)
    if len(sizes) < MIN_BLOCKS:
        return 0
    usual = int(np.median(sizes))
    return usual if usual >= MIN_BLOCK and (sizes == usual).mean() >= REGULAR else 0


def spread_blocks(time: np.ndarray, size: int) -> np.ndarray:
    """The time stamps (samples,), those of each block spread evenly up to the next block."""
    starts = np.arange(0, len(time), size)
    first = time[starts].astype(float)
    last = first[-1] + np.median(np.diff(first))
    return np.asarray(np.interp(np.arange(len(time)), np.append(starts, starts[-1] + size), np.append(first, last)))
