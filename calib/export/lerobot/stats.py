"""Statistics of the features of a LeRobot dataset, by which policies normalise: of an episode, and of all."""

from collections.abc import Mapping, Sequence

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MAX_SAMPLES = 4096  # frames of an episode from which its quantiles are computed

Stats = dict[str, np.ndarray]


class FeatureStats:
    """Statistics of one feature over the frames of an episode, of its finite values.

    Quantiles are those of frames at even distances, at most `MAX_SAMPLES`. A component without a finite value counts
    as zero.

    Args:
        frames: number of frames of the episode.
        channels: whether the feature is an image, whose statistics are those of a channel, of values from 0 to 1.
    """

    def __init__(self, frames: int, channels: bool = False):
        self._stride, self._channels, self._seen = -(-frames // MAX_SAMPLES), channels, 0
        self._count = self._sum = self._square = np.zeros(1)
        self._low, self._high = np.array([np.inf]), np.array([-np.inf])
        self._samples: list[np.ndarray] = []

    def add(self, values: np.ndarray) -> None:
        """Add frames (n, *shape); of an image (n, rows, columns) of any channel, 0 to 1."""
        first = -self._seen % self._stride
        self._seen += len(values)
        self._samples.append(self._components(values[first :: self._stride]))
        values = self._components(values)
        known = np.isfinite(values)
        counted = np.where(known, values, 0)
        self._count = self._count + known.sum(0)
        self._sum = self._sum + counted.sum(0)
        self._square = self._square + (counted**2).sum(0)
        self._low = np.minimum(self._low, np.where(known, values, np.inf).min(0, initial=np.inf))
        self._high = np.maximum(self._high, np.where(known, values, -np.inf).max(0, initial=-np.inf))

    def _components(self, values: np.ndarray) -> np.ndarray:
        """A row for each frame, of the components whose statistics are apart; for each pixel of an image."""
        values = np.asarray(values, float)
        apart = values.ndim == 1 or self._channels
        return values.reshape(-1, 1) if apart else values

    def result(self) -> Stats:
        """The statistics, by the names of LeRobot."""
        some = self._count > 0
        count = np.where(some, self._count, 1)
        mean = self._sum / count
        found = {
            "min": np.where(some, self._low, 0),
            "max": np.where(some, self._high, 0),
            "mean": mean,
            "std": np.sqrt(np.maximum(self._square / count - mean**2, 0)),
            **self._quantiles(some),
        }
        shape = (3, 1, 1) if self._channels else mean.shape
        named = {name: np.broadcast_to(value, shape).copy() for name, value in found.items()}
        return named | {"count": np.array([self._seen])}

    def _quantiles(self, some: np.ndarray) -> Stats:
        values = np.where(some, np.concatenate(self._samples), 0)  # where nothing is finite, NumPy would warn
        return dict(zip(QUANTILES, np.nanquantile(values, list(QUANTILES.values()), axis=0), strict=True))


def aggregated(parts: Sequence[Stats]) -> Stats:
    """Statistics of all episodes, as LeRobot aggregates them: quantiles become bounds."""
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    count = stacked["count"].reshape(-1, *[1] * (stacked["mean"].ndim - 1))
    mean = (stacked["mean"] * count).sum(0) / count.sum()
    variance = ((stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2) * count).sum(0) / count.sum()
    outer = {name: np.min if part <= 0.5 else np.max for name, part in QUANTILES.items()}
    return {
        "min": stacked["min"].min(0),
        "max": stacked["max"].max(0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": stacked["count"].sum(0),
        **{name: bound(stacked[name], axis=0) for name, bound in outer.items()},
    }


def flat(stats: Mapping[str, Stats], prefix: str = "") -> dict[str, list[object]]:
    """Statistics of all features by ``feature/name``, as lists."""
    return {f"{prefix}{feature}/{name}": v.tolist() for feature, part in stats.items() for name, v in part.items()}
