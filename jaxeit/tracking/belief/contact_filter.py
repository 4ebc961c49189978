"""The filter of contacts: its measurement model, its noise, what a frame and its pads inform of, and prediction.

The gain ``exp(level + field)`` is the same in all frames, so its modes are part of the belief: the uncertainty of a
place that the gain causes does not shrink while a contact rests, and the gain is learned where contacts move. The level
alone may wander during a press, since a layer that follows another law looks like another gain under another force.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._compile import usually, verb
from ...contacts.search import ContactFinder, WhitenedFrame
from .response import LoadedSheet, Neighbourhood
from .state import CONTACT_SIZE, LOAD_SIZE, Belief, Pads

# Smallest share of a load on pads of known force with which the pads inform on the force of the contact.
MIN_PAD_SHARE = 0.25
# Width of the load whose tails pads may feel, over that of the contact.
TAIL_WIDTH_RATIO = 2.0
# Load on a pad that counts as zero, N.
NEGLIGIBLE_LOAD = 1e-6


class ContactFilter(eqx.Module):
    """Measurement model, motion model and noise of an extended Kalman filter of contacts; made by `prepare_tracker`.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | finder: whitens frames; its atoms are where contacts may begin           |                  |      |
    | compress: whitened readings of a frame that lacks none                   | (r, readings)    | 1/V  |
    | sheet: measurement model                                                 |                  |      |
    | places: where the modes of the gain lie; the first is the level          | (g, 2)           | m    |
    | model_error: part of the signal by which mesh and contact layer err      | ()               | 1    |
    | coat_error: part of the signal by which an unknown coat makes it err     | ()               | 1    |
    | persistence of these errors                                              | ()               | s    |
    | tail: part of what wider loads would change pads, by which pads may err  | ()               | 1    |
    | shape: standard deviation of each moment of a load's shape               | ()               | 1    |
    | spread: prior deviation of position (2), log width, log force            | (4,)             | m, 1 |
    | rates: random walk of each state variable of a contact                   | (8,)             | per sqrt(s) |
    | gain_rate: random walk of the level, in its prior standard deviations    | ()               | per sqrt(s) |
    """

    finder: ContactFinder
    compress: Float[Array, "r readings"]
    sheet: LoadedSheet
    places: Float[Array, "g 2"]
    model_error: Float[Array, ""]
    coat_error: Float[Array, ""]
    persistence: Float[Array, ""]
    rates: Float[Array, "8"]
    gain_rate: Float[Array, ""]
    tail: Float[Array, ""]
    shape: Float[Array, ""]
    spread: Float[Array, "4"]
    active_modes: int = eqx.field(static=True)

    @property
    def error_share(self) -> Float[Array, ""]:
        """Share of the square of a signal that is an error of the model or caused by an unknown coat."""
        return self.model_error**2 + self.coat_error**2


@verb
def predict(contact_filter: ContactFilter, belief: Belief, seconds: Float[Array, ""]) -> Belief:
    """Predict the belief so many seconds later: contacts move at their velocities, and walk at random.

    The level follows an Ornstein-Uhlenbeck process about what was known of it before the present contacts.
    """
    count, size = len(belief.contacts), belief.contacts.size
    if not count:
        return belief
    transition = jnp.eye(CONTACT_SIZE).at[:2, 6:].set(seconds * jnp.eye(2))
    # A velocity that walks at random: the integrated Wiener process, exactly.
    walk = jnp.diag(contact_filter.rates**2 * seconds)
    drift = contact_filter.rates[6:] ** 2
    walk = walk.at[:2, :2].add(jnp.diag(drift * seconds**3 / 3))
    walk = walk.at[:2, 6:].add(jnp.diag(drift * seconds**2 / 2)).at[6:, :2].add(jnp.diag(drift * seconds**2 / 2))
    transitions = jnp.kron(jnp.eye(count), transition)
    rows = belief.covariance.at[:size].set(transitions @ belief.covariance[:size])
    both = rows.at[:, :size].set(rows[:, :size] @ transitions.T)
    covariance = both.at[:size, :size].add(jnp.kron(jnp.eye(count), walk))
    # The decay with which the level walks by `gain_rate` over short times, and keeps its variance over long ones.
    mean, variance = belief.level
    decay = jnp.exp(-0.5 * contact_filter.gain_rate**2 * seconds / variance)
    decayed = (
        covariance.at[size].multiply(decay).at[:, size].multiply(decay).at[size, size].add((1 - decay**2) * variance)
    )
    gain = belief.gain.at[0].set(mean + decay * (belief.gain[0] - mean))
    return belief._replace(contacts=belief.contacts @ transition.T, gain=gain, covariance=decayed)


def active_indices(contact_filter: ContactFilter, contacts: Float[Array, "K 8"]) -> Int[Array, " a"]:
    """Indices of the parameters that a frame informs: loads of contacts, the level, and the modes around contacts."""
    count = len(contacts)
    own = (CONTACT_SIZE * np.arange(count)[:, None] + np.arange(LOAD_SIZE)).ravel()
    known = jnp.asarray([*own, CONTACT_SIZE * count], jnp.int32)
    square = jnp.min(jnp.sum((contact_filter.places[1:, None] - contacts[None, :, :2]) ** 2, -1), 1)
    around = 1 + jax.lax.top_k(-square, min(contact_filter.active_modes * count, square.size))[1]
    return jnp.concatenate([known, CONTACT_SIZE * count + around.astype(jnp.int32)])


def whitened_frame(
    contact_filter: ContactFilter, dv: Float[Array, " readings"]
) -> tuple[WhitenedFrame, Bool[Array, ""], Float[Array, ""]]:
    """A whitened frame, whether it has all readings, and the variance of a whitened reading by errors of the model."""
    dv = jnp.asarray(dv, contact_filter.compress.dtype)
    y = contact_filter.compress @ dv  # of channels that are not used the matrix is zero, but not its product with NaN
    complete = jnp.all(jnp.isfinite(y))
    frame = usually(
        complete, _complete_frame, lambda finder, _, dv: finder.compressed(dv)[0], contact_filter.finder, y, dv
    )
    complete = complete | jnp.all(jnp.isfinite(dv) | ~contact_filter.finder.whitening.channels)
    return frame, complete, contact_filter.error_share * (frame.y @ frame.y) / len(frame.y)


def _complete_frame(finder: ContactFinder, y: Float[Array, " r"], dv: Float[Array, " readings"]) -> WhitenedFrame:
    zero = jnp.zeros((), y.dtype)
    return WhitenedFrame(y, zero, zero, finder.root)


def informative_pads(
    contact_filter: ContactFilter, contacts: Float[Array, "K 8"], near: Neighbourhood, pads: Pads
) -> Pads:
    """Pads with the errors of their forces as measurements of contacts; infinite for pads that hardly inform on any.

    How much of a load lies on the pads beside it depends on its shape, which is not known: foam spreads a load farther
    than it makes the layer conduct. So pads may err by a part of what a load `TAIL_WIDTH_RATIO` times as wide would
    change them.

    A pad that mostly bears contacts with less than `MIN_PAD_SHARE` of their load on pads of known force bears their
    tails, as where the pad under a contact is dead, and those beside it work. The whole force would err tenfold. While
    there is such a contact, pads without any load count as bearing it.
    """
    own = contacts[:, :LOAD_SIZE]
    loads = contact_filter.sheet.pad_loads(own, near)
    spread = contact_filter.sheet.pad_loads(own.at[:, 2].add(math.log(TAIL_WIDTH_RATIO)), near) - loads
    error = jnp.sqrt(pads.error**2 + contact_filter.tail**2 * jnp.sum(spread**2, 0))
    supported = jnp.sum(jnp.where(jnp.isfinite(pads.error), loads, 0), 1) >= MIN_PAD_SHARE * jnp.exp(contacts[:, 3])
    supported_load = jnp.sum(jnp.where(supported[:, None], loads, 0), 0)
    other_load = jnp.sum(jnp.where(supported[:, None], 0, loads + NEGLIGIBLE_LOAD), 0)
    return pads._replace(error=jnp.where(supported_load >= other_load, error, jnp.inf))


def noise_scales(
    contact_filter: ContactFilter, model_variance: Float[Array, ""], seconds: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Standard deviations of a whitened reading in a frame so long after the last one, and in a single frame.

    Errors of the model that stay for n frames are measured n times, and count once.
    """
    repeats = jnp.maximum(contact_filter.persistence / seconds, 1)
    return jnp.sqrt(1 + repeats * model_variance), jnp.sqrt(1 + model_variance)
