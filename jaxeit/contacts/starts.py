"""Where fits of contacts start: bumps that alone, in pairs or in halves explain most of a frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .fit import Bumps

# Part of an atom's square that the other atom of a pair must leave unexplained. Two atoms more alike than that are one
# place twice, and their strengths would be differences of large numbers.
MIN_INDEPENDENT_FRACTION = 0.05
# Number of atoms, those that explain most alone, of which one is assumed to be in the pair that explains most.
PAIR_CANDIDATES = 64
# Number of directions along which a contact is split.
SPLIT_DIRECTIONS = 4
# Width of each half of a contact that is split, as a fraction of the contact's own.
HALF_WIDTH = 0.75


class Atoms(eqx.Module):
    """Unit responses of bumps all over the sheet, from which contacts are started.

    | meaning                                 | shape  |
    |-----------------------------------------|--------|
    | atoms: responses, each of length one    | (b, r) |
    | starts: their x, y and log width        | (b, 3) |
    | norms: lengths of the responses         | (b,)   |
    | alike: products of the atoms            | (b, b) |
    """

    atoms: Float[Array, "b r"]
    starts: Float[Array, "b 3"]
    norms: Float[Array, " b"]
    alike: Float[Array, "b b"]

    def one_more(self, bumps: Bumps, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
        """One contact more: the atom that explains most of what is left."""
        gain = self.atoms @ bumps.mixed(y - bumps.response(theta)[0] if len(theta) else y)
        best = jnp.argmax(gain)
        strength = jnp.maximum(gain[best], 0) / self.norms[best]
        return jnp.concatenate([theta, jnp.append(self.starts[best], strength)[None]])

    def pair(self, bumps: Bumps, y: Float[Array, " r"]) -> Float[Array, "2 4"]:
        """Two contacts: the atoms that explain most together.

        Two contacts of one strength may look most like a single one between them, from which neither is found.
        """
        gain = self.atoms @ bumps.mixed(y)

        def explained(alike: Float[Array, " b"], one: Float[Array, ""]) -> Float[Array, " b"]:
            """By an atom of gain ``one`` together with each of all, where both have a strength above zero."""
            first, second, rest = one - alike * gain, gain - alike * one, 1 - alike**2
            fine = (rest > MIN_INDEPENDENT_FRACTION) & (first > 0) & (second > 0)
            return jnp.where(fine, one * first + gain * second, 0) / jnp.maximum(rest, MIN_INDEPENDENT_FRACTION)

        few = jax.lax.top_k(gain, min(PAIR_CANDIDATES, len(gain)))[1]
        j = jnp.argmax(jnp.max(jax.vmap(explained)(self.alike[few], gain[few]), 0))
        pair = jnp.stack([jnp.argmax(explained(self.alike[j], gain[j])), j])
        alike = self.alike[pair[0], j]
        rest = jnp.maximum(1 - alike**2, MIN_INDEPENDENT_FRACTION)
        strength = (gain[pair] - alike * gain[pair[::-1]]) / rest / self.norms[pair]
        return jnp.concatenate([self.starts[pair], jnp.maximum(strength, 0)[:, None]], 1)


def split(bumps: Bumps, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
    """One contact more: the strongest contact in two halves, along the best of a few directions."""
    first = jnp.argmax(theta[:, 3])
    angle = jnp.arange(SPLIT_DIRECTIONS, dtype=y.dtype) * (jnp.pi / SPLIT_DIRECTIONS)
    shift = jnp.exp(theta[first, 2]) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1)

    def halves(along: Float[Array, "2"]) -> Float[Array, "m 4"]:
        half = theta[first] * jnp.array([1, 1, 1, 0.5], y.dtype) + jnp.array([0, 0, np.log(HALF_WIDTH), 0], y.dtype)
        step = jnp.append(along, jnp.zeros(2, y.dtype))
        both = jnp.concatenate([theta.at[first].set(half + step), (half - step)[None]])
        return jnp.clip(both, bumps.low, bumps.high)

    tried: Array = jax.vmap(halves)(shift)
    squares = jax.vmap(lambda t: jnp.sum((y - bumps.response(t)[0]) ** 2))(tried)
    return tried[jnp.argmin(squares)]
