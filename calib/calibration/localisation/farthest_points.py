"""Points spread over all of a set."""

import numpy as np


def farthest_first(points: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """At most so many rows of points (n, d), and the distance of each to the nearest row before it.

    The first row is the one nearest to the mean, at an infinite distance; each other one is the farthest from all
    before it.
    """
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    away, gaps = np.full(len(points), np.inf), [np.inf]
    while len(chosen) < min(most, len(points)):
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(away.argmax()))
        gaps.append(float(away.max()))
    return np.array(chosen), np.array(gaps)
