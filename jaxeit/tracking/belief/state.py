"""The belief of contacts and of the contact layer's gain, the pads of a frame, and the belief after it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...least_squares import LeastSquaresState

# State of a contact: x, y, log width, log force, half an edge along x and y, velocity along x and y. The first six are
# those of its load, on which readings and pad forces depend.
CONTACT_SIZE, LOAD_SIZE = 8, 6
# Prior standard deviation of the position of a new contact, m.
POSITION_STD = 0.012
# Prior standard deviation of the half length of a round contact, m: above zero, so that the covariance stays definite.
ROUND_HALF_LENGTH = 1e-4


class Pads(NamedTuple):
    """Forces on the pads in a frame, and their standard errors, (pads,) N; infinite where a force is not known."""

    force: Float[Array | np.ndarray, " pads"]
    error: Float[Array | np.ndarray, " pads"]


class Belief(NamedTuple):
    """Normal distribution of contacts and gain.

    | meaning                                                                  | shape    | unit  |
    |--------------------------------------------------------------------------|----------|-------|
    | contacts: x, y, log width, log force, half an edge (2), velocity (2)     | (K, 8)   | mixed |
    | gain: level, then modes of the field, in units of their prior deviations | (g,)     | 1     |
    | covariance of contacts and gain                                          | (n, n)   | mixed |
    | level: mean and variance of the level before the contacts of now         | (2,)     | 1     |
    """

    contacts: Float[Array, "K 8"]
    gain: Float[Array, " g"]
    covariance: Float[Array, "n n"]
    level: Float[Array, "2"]


class Update(NamedTuple):
    """A belief after a frame.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | belief                                                                    |       |
    | evidence: log of the frame's probability before it came, up to a constant | ()    |
    | misfit: chi-square of the frame and the pads                              | ()    |
    | correction_square: squared Mahalanobis length of the belief's correction  | ()    |
    | signal_to_noise: signal of each contact over its standard deviation       | (K,)  |
    | evaluations: number of evaluations of the measurement model               | ()    |
    | converged: further evaluations would not change it                        | ()    |
    """

    belief: Belief
    evidence: Float[Array, ""]
    misfit: Float[Array, ""]
    correction_square: Float[Array, ""]
    signal_to_noise: Float[Array, " K"]
    evaluations: Int[Array, ""]
    converged: Bool[Array, ""]


class Attempt(NamedTuple):
    """The iterate of an update that starts far from its minimum; `advance` continues it.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | z: change of the active parameters; state: of the solver                  | (a,)  |
    | evidence, signal_to_noise: as of an `Update`                              |       |
    | ended: converged, or at the largest number of evaluations                 | ()    |
    """

    z: Float[Array, " a"]
    state: LeastSquaresState | None
    evidence: Float[Array, ""]
    signal_to_noise: Float[Array, " K"]
    ended: Bool[Array, ""]


def contact_slice(k: int) -> slice:
    """Rows of contact k in the covariance of a belief."""
    return slice(CONTACT_SIZE * k, CONTACT_SIZE * (k + 1))
