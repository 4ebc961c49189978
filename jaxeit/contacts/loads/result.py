"""Loads as they are handed out, and as they are proposed."""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class LoadKind(IntEnum):
    """What touches the sheet."""

    NONE = 0  # nothing
    ONE = 1  # one load
    TWO = 2  # two loads
    EDGE = 3  # one load along a line
    MORE = 4  # three loads explain the frame better than all else


class LoadShape(eqx.Module):
    """Loads of one kind, as they explain a frame best.

    | meaning                                                                         | shape  | unit  |
    |---------------------------------------------------------------------------------|--------|-------|
    | position in the sheet's flat coordinates; of an edge, its middle                | (n, 2) | m     |
    | width: standard deviation of the load, across an edge                           | (n,)   | m     |
    | force                                                                           | (n,)   | N     |
    | half: from the middle of an edge to its end; zero for others                    | (n, 2) | m     |
    | covariance of all parameters: x, y, log width, log force of each load, half of an edge | (m, m) | mixed |
    | misfit: chi-square over the number of readings, with the covariance of the model's error | ()     | 1     |
    """

    position: Float[Array, "n 2"]
    width: Float[Array, " n"]
    force: Float[Array, " n"]
    half: Float[Array, "n 2"]
    covariance: Float[Array, "m m"]
    misfit: Float[Array, ""]

    @property
    def position_covariance(self) -> Float[Array, "n 2 2"]:
        """Covariance of each of n positions, (n, 2, 2) m^2."""
        size = len(self.covariance) // len(self.force)
        return jnp.stack([self.covariance[k : k + 2, k : k + 2] for k in range(0, len(self.covariance), size)])

    @property
    def ends(self) -> Float[Array, "2 2"]:
        """Both ends of an edge, (2, 2) m; of another shape, the first place twice."""
        return self.position[0] + jnp.stack([-self.half[0], self.half[0]])

    @property
    def ends_covariance(self) -> Float[Array, "4 4"]:
        """Covariance of x, y of the first end and of the second end of an edge, (4, 4) m^2."""
        place = jnp.eye(2, len(self.covariance))
        half = jnp.eye(2, len(self.covariance), k=4) if len(self.covariance) == 6 else jnp.zeros_like(place)
        both = jnp.concatenate([place - half, place + half])
        return both @ self.covariance @ both.T


class Loads(eqx.Module):
    """What a `LoadFitter` finds in a frame.

    | meaning                                                    | shape |
    |------------------------------------------------------------|-------|
    | probability of each kind, in the order of `LoadKind`       | (5,)  |
    | one, two, edge, more: the best loads of each kind; more: three. None: a kind |   |
    |   that was not fitted, as its proposal was all but impossible |       |
    """

    probability: Float[Array, "5"]
    one: LoadShape
    two: LoadShape | None = None
    edge: LoadShape | None = None
    more: LoadShape | None = None

    @property
    def kind(self) -> LoadKind:
        """The most probable kind."""
        return LoadKind(int(np.argmax(np.asarray(self.probability))))

    @property
    def best(self) -> LoadShape | None:
        """The loads of the most probable kind; None: nothing touches the sheet."""
        return self.of(self.kind)

    def of(self, kind: LoadKind) -> LoadShape | None:
        """The best loads of a kind."""
        return None if kind is LoadKind.NONE else getattr(self, kind.name.lower())


class Proposed(NamedTuple):
    """What a `Proposal` says of a frame, or of some along leading axes.

    | meaning                                                                        | shape       | unit   |
    |--------------------------------------------------------------------------------|-------------|--------|
    | probability of each kind, in the order of `LoadKind`                           | (..., 5)    | 1      |
    | one, two, more: x, y, log width and log force of each load                     | (..., n, 4) | m, N   |
    | edge: those of its middle, and from there to its end                           | (..., 1, 6) | m, N   |
    | distance from the training scenes; beyond 1 lies one in 500 of their own frames | (...)       | 1      |

    The distance is infinite, and all kinds are equally probable, for a frame with fewer readings than three loads have
    parameters and for one whose signal is larger than any of a real skin.
    """

    probability: Float[np.ndarray, "*n 5"]
    one: Float[np.ndarray, "*n 1 4"]
    two: Float[np.ndarray, "*n 2 4"]
    edge: Float[np.ndarray, "*n 1 6"]
    more: Float[np.ndarray, "*n 3 4"]
    distance: Float[np.ndarray, "*n"]

    @property
    def kind(self) -> LoadKind:
        """The most probable kind of one frame."""
        return LoadKind(int(np.argmax(self.probability)))

    @property
    def outside(self) -> bool:
        """Whether a frame is unlike those of the training, so that nothing of the proposal can be relied on."""
        return bool(np.any(self.distance > 1))

    def of(self, kind: LoadKind) -> np.ndarray:
        """Loads of a kind, as a fit begins with them."""
        found: np.ndarray = getattr(self, kind.name.lower())
        return found
