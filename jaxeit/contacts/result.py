"""Contacts as they are handed out."""

from enum import IntEnum

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class ContactResult(IntEnum):
    """Outcome of the fit of one slot of `Contacts`."""

    CONVERGED = 0  # the contact and its covariance hold
    AT_BOUND = 1  # the width or the position ended on its bound: the covariance is a guess
    OBLONG = 2  # longer than wide: the centre is good, the width a mean over directions, the covariance a guess
    NOT_CONVERGED = 3  # do not trust it
    ABSENT = 4  # nothing more than noise and model error was left to explain
    UNREADABLE = 5  # no reading of the frame is finite


class Contacts(eqx.Module):
    """What a `ContactFinder` finds in a frame; the strongest contact first, absent slots hold zeros.

    | meaning                                                             | shape          | unit  |
    |---------------------------------------------------------------------|----------------|-------|
    | present: whether there is a contact in the slot                     | (..., K)       |       |
    | position in the sheet's flat coordinates                            | (..., K, 2)    | m     |
    | width: standard deviation of the bump                               | (..., K)       | m     |
    | amplitude: largest change, as on a sheet of mean conductivity       | (..., K)       | S     |
    | covariance of x, y, log width, amplitude; times misfit if above one | (..., K, 4, 4) | mixed |
    | misfit: chi-square of the frame over its degrees of freedom         | (...)          |       |
    | result: a `ContactResult`                                           | (..., K)       |       |

    Example:
        print(found.strength)  # S m^2: what grows with the force
        sure = jnp.sqrt(jnp.diagonal(found.covariance, axis1=-2, axis2=-1))  # of x, y, log width, amplitude
        print(1e3 * sure[found.present, :2], "mm")
    """

    present: Bool[Array, "... K"]
    position: Float[Array, "... K 2"]
    width: Float[Array, "... K"]
    amplitude: Float[Array, "... K"]
    covariance: Float[Array, "... K 4 4"]
    misfit: Float[Array, "..."]
    result: Int[Array, "... K"]

    @property
    def strength(self) -> Float[Array, "... K"]:
        """Integral of each bump over the plane, ``2 pi a s^2``, (..., K) S m^2: what grows with the force."""
        return 2 * jnp.pi * self.amplitude * self.width**2


def strongest(contacts: Contacts) -> Float[Array, "... 2"]:
    """Position of the strongest contact, (..., 2) m; NaN where there is none (as other estimators of `metrics`)."""
    return jnp.where(contacts.present[..., :1], contacts.position[..., 0, :], jnp.nan)
