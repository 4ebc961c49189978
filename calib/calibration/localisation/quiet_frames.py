"""Mean and noise of the frames without contact: the untouched skin as it is on that day."""

import numpy as np
from jaxtyping import Bool, Float

MIN_QUIET = 8  # frames without contact, fewer do not tell the noise
ENOUGH_FRAMES = 2048  # frames, more tell no more


class QuietFrames:
    """Collects mean and variance of frames without contact, block by block; missing readings are left out."""

    def __init__(self, readings: int):
        self._count, self._level, self._square = np.zeros((3, readings))

    def add(
        self,
        frames: Float[np.ndarray, "n readings"],
        change: Float[np.ndarray, "n readings"],
        loaded: Bool[np.ndarray, " n"],
    ) -> None:
        """Frames V, their change against the resting level V, and which of them are touched."""
        rest, change = frames[~loaded], change[~loaded]
        known = np.isfinite(rest) & np.isfinite(change)
        self._count += known.sum(0)
        self._level += np.where(known, rest, 0).sum(0)
        self._square += (np.where(known, change, 0) ** 2).sum(0)

    @property
    def count(self) -> int:
        """Frames without contact so far, by the reading that is missing least."""
        return int(self._count.max())

    @property
    def untouched(self) -> Float[np.ndarray, " readings"]:
        """Mean frame without contact, V; zero for a reading that is always missing."""
        return np.asarray(self._level / np.maximum(self._count, 1))

    @property
    def noise(self) -> Float[np.ndarray, " readings"] | None:
        """Standard deviation of a reading without contact, V, zero where too few tell it; None for too few frames."""
        if self.count < MIN_QUIET:
            return None
        return np.where(self._count >= MIN_QUIET, np.sqrt(self._square / np.maximum(self._count, 1)), 0.0)
