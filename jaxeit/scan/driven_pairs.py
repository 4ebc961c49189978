"""Which pairs of electrodes drive the readings of a scan, and the order of the readings."""

import numpy as np
from jaxtyping import Bool, Float, Int, Integer


def codes_of_pairs(pattern: Integer[np.ndarray, "k 4"]) -> tuple[Int[np.ndarray, "k 2"], int]:
    """A number for each pair of a reading, whatever its direction; ``divmod`` of it by the second value is the pair."""
    size = int(pattern.max()) + 1
    return np.sort(pattern.reshape(-1, 2, 2), 2) @ [size, 1], size


def cover(
    pattern: np.ndarray, weights: Float[np.ndarray, " k"] | Bool[np.ndarray, " k"], most: int | None = None
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "drives 2"]]:
    """For each reading the number of the driven pair that takes it, as drive or by reciprocity as sense; and the pairs.

    Pairs are taken one by one, each time the one of the largest weight of readings not yet covered, until all readings
    with a weight are covered or ``most`` pairs are taken. A reading that is not covered has the number -1.
    """
    ends, size = codes_of_pairs(pattern)
    found, left = np.full(len(pattern), -1), np.asarray(weights, float).copy()
    taken: list[tuple[int, int]] = []
    while left.any() and len(taken) < (len(pattern) if most is None else most):
        best = int(np.argmax(sum(np.bincount(ends[:, end], left, minlength=size**2) for end in (0, 1))))
        new = (ends == best).any(1) & (found < 0)
        found[new], left[new] = len(taken), 0
        taken.append(divmod(best, size))
    return found, np.array(taken, int).reshape(-1, 2)


def in_order(
    pattern: Integer[np.ndarray, "readings 4"],
    voltages: Float[np.ndarray, " readings"],
    drives: tuple[Integer[np.ndarray, " readings"], Integer[np.ndarray, "pairs 2"]] | None = None,
) -> Int[np.ndarray, "readings 4"]:
    """Readings sorted by driven pair, with untouched voltages above zero.

    Args:
        drives: number of the driven pair of each reading, and the pairs; default: as few pairs as possible.
    """
    group, pairs = cover(pattern, np.ones(len(pattern))) if drives is None else drives
    drive, out = pairs[group], pattern.copy()
    swap = (np.sort(out[:, :2], 1) != drive).any(1)
    out[swap] = out[swap][:, [2, 3, 0, 1]]
    turned = (out[:, :2] != drive).any(1)
    out[turned] = out[turned][:, [1, 0, 3, 2]]
    negative = voltages < 0
    out[negative] = out[negative][:, [0, 1, 3, 2]]
    order = np.lexsort((*out.T[::-1], group))
    return out[order].astype(np.int32)
