"""Which pairs of electrodes drive the readings of a scan, and the order of the readings."""

import numpy as np
from jaxtyping import Bool, Float, Int, Integer


def pair_codes(pattern: Integer[np.ndarray, "k 4"]) -> tuple[Int[np.ndarray, "k 2"], int]:
    """A number for each pair of a reading, whatever its direction; ``divmod`` of it by the second value is the pair."""
    size = int(pattern.max()) + 1
    return np.sort(pattern.reshape(-1, 2, 2), 2) @ [size, 1], size


def cover_by_pairs(
    pattern: np.ndarray, weights: Float[np.ndarray, " k"] | Bool[np.ndarray, " k"], most: int | None = None
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "drives 2"]]:
    """For each reading the index of the pair that drives it, as given or by reciprocity; and the driven pairs.

    Pairs are taken one by one, each time the one of the largest weight of readings not yet covered, until all readings
    with a weight are covered or ``most`` pairs are taken. A reading that is not covered has the number -1.
    """
    ends, size = pair_codes(pattern)
    group, uncovered = np.full(len(pattern), -1), np.asarray(weights, float).copy()
    pairs: list[tuple[int, int]] = []
    while uncovered.any() and len(pairs) < (len(pattern) if most is None else most):
        best = int(np.argmax(sum(np.bincount(ends[:, end], uncovered, minlength=size**2) for end in (0, 1))))
        new = (ends == best).any(1) & (group < 0)
        group[new], uncovered[new] = len(pairs), 0
        pairs.append(divmod(best, size))
    return group, np.array(pairs, int).reshape(-1, 2)


def order_readings(
    pattern: Integer[np.ndarray, "readings 4"],
    voltages: Float[np.ndarray, " readings"],
    drives: tuple[Integer[np.ndarray, " readings"], Integer[np.ndarray, "pairs 2"]] | None = None,
) -> Int[np.ndarray, "readings 4"]:
    """Readings sorted by driven pair, with untouched voltages above zero.

    Args:
        drives: number of the driven pair of each reading, and the pairs; default: as few pairs as possible.
    """
    group, pairs = cover_by_pairs(pattern, np.ones(len(pattern))) if drives is None else drives
    drive, out = pairs[group], pattern.copy()
    swap = (np.sort(out[:, :2], 1) != drive).any(1)
    out[swap] = out[swap][:, [2, 3, 0, 1]]
    reverse = (out[:, :2] != drive).any(1)
    out[reverse] = out[reverse][:, [1, 0, 3, 2]]
    negative = voltages < 0
    out[negative] = out[negative][:, [0, 1, 3, 2]]
    order = np.lexsort((*out.T[::-1], group))
    return out[order].astype(np.int32)
