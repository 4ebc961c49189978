"""Weights of the readings: equal, or by the noise of a recording without contact."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from ...registry import Registry
from ..inputs import InverseError, known_flags, require_real
from .noise import noise_covariance

LEAST_DEVIATION = 0.1  # of the median deviation: a reading that hardly changes is not trusted more than tenfold


class AbstractNoise(eqx.Module):
    """A choice of the readings' noise.

    ``needs_frames``: whether it must be measured. ``has_size``: whether it is known in V, so that images have standard
    deviations and a hyperparameter can be chosen by it.
    """

    needs_frames: ClassVar[bool] = True
    has_size: ClassVar[bool] = True

    @abstractmethod
    def measured(
        self, quiet: Float[ArrayLike, "frames readings"] | None, channels: Bool[ArrayLike, " readings"] | None = None
    ) -> np.ndarray | None:
        """The noise, as `prepare` takes it: (readings,) V, (readings, readings) V^2, or None: alike, of unknown size.

        Args:
            quiet: frames without contact less their mean, V.
            channels: readings that are used; the others may hold anything. Default: all.

        Raises:
            InverseError: if the noise must be measured and there are too few frames.
        """


class EqualNoise(AbstractNoise):
    """All readings alike, of unknown size. Images then have no standard deviations.

    Example:
        # equal, measured, correlated: names for recipes and the command line
        print(list(je.imaging.NOISES))
        plain = je.Imaging(je.Pixels(10), noise=je.imaging.EqualNoise())
    """

    name: ClassVar[str] = "equal"
    needs_frames: ClassVar[bool] = False
    has_size: ClassVar[bool] = False

    def measured(
        self, quiet: Float[ArrayLike, "frames readings"] | None, channels: Bool[ArrayLike, " readings"] | None = None
    ) -> None:
        return None


class MeasuredNoise(AbstractNoise):
    """Each reading by its standard deviation without contact, at least a tenth of the median of all.

    Readings are taken as independent.
    """

    name: ClassVar[str] = "measured"

    def measured(
        self, quiet: Float[ArrayLike, "frames readings"] | None, channels: Bool[ArrayLike, " readings"] | None = None
    ) -> np.ndarray:
        used, frames = _used(self, quiet, channels)
        out = np.ones(len(used))
        out[used] = _deviations(frames)
        return out


class CorrelatedNoise(AbstractNoise):
    """The readings by their covariance without contact, see `noise_covariance`: for an instrument with crosstalk.

    Standard deviations are at least a tenth of their median, as those of `MeasuredNoise`.

    Example:
        crosstalk = je.Imaging(je.Pixels(10), noise=je.imaging.CorrelatedNoise()).prepare(
            model, quiet=quiet
        )
    """

    name: ClassVar[str] = "correlated"

    def measured(
        self, quiet: Float[ArrayLike, "frames readings"] | None, channels: Bool[ArrayLike, " readings"] | None = None
    ) -> np.ndarray:
        used, frames = _used(self, quiet, channels)
        deviation, changing = np.ones(len(used)), np.zeros(len(used), bool)
        deviation[used] = _deviations(frames)
        moves = frames.std(0) > 0
        changing[used] = moves
        out = np.diag(deviation**2)  # a reading that does not change at all is taken as independent
        covariance = noise_covariance(frames[:, moves])
        # The floor widens a reading and leaves its correlations.
        wider = np.maximum(_least_deviation(frames) / np.sqrt(np.diagonal(covariance)), 1)
        out[np.ix_(changing, changing)] = covariance * np.outer(wider, wider)
        return out


NOISES = Registry(AbstractNoise, "noise", "jaxeit.noises")
"""Choices of noise by the names that the command line and recipes use."""


def _used(
    noise: AbstractNoise,
    quiet: Float[ArrayLike, "frames readings"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Readings that are used, (readings,), and the frames that have all of them."""
    if quiet is None:
        raise InverseError(f"{type(noise).__name__} is measured; give frames without contact (quiet=), or EqualNoise()")
    require_real(quiet=quiet)
    frames = np.asarray(quiet, float)
    used = np.ones(frames.shape[1], bool) if channels is None else known_flags(channels, frames.shape[1])
    frames = frames[:, used]
    frames = frames[np.isfinite(frames).all(1)]
    if len(frames) < 4:
        raise InverseError(
            f"{type(noise).__name__} is measured from frames without contact, and {len(frames)} are complete; "
            "record four or more before the first press, or choose EqualNoise"
        )
    return used, frames


def _deviations(frames: np.ndarray) -> np.ndarray:
    """Standard deviation of each reading about zero, not below `LEAST_DEVIATION` of the median."""
    floored: np.ndarray = np.maximum(_root_mean_square(frames), _least_deviation(frames))
    return floored


def _least_deviation(frames: np.ndarray) -> float:
    """The smallest standard deviation that is believed, V; raises InverseError if most readings do not change."""
    least = LEAST_DEVIATION * float(np.median(_root_mean_square(frames)))
    if not least > 0:
        raise InverseError("most readings do not change at all without contact; choose EqualNoise")
    return least


def _root_mean_square(frames: np.ndarray) -> np.ndarray:
    found: np.ndarray = np.sqrt(np.mean(frames**2, axis=0))
    return found
