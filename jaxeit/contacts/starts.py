"""Where fits of contacts start: bumps that alone, in pairs or in halves explain most of a frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .fit import FrameResponse

# Part of an atom's square that the other atom of a pair must leave unexplained. Two atoms more alike than that are one
# place twice, and their strengths would be differences of large numbers.
MIN_INDEPENDENT_FRACTION = 0.05
# Number of atoms, those that explain most alone, of which one is assumed to be in the pair that explains most.
PAIR_CANDIDATES = 64
# Largest likeness, by the cosine of the angle between responses, of an atom to that from which a bad fit started.
MAX_LIKENESS = 0.95
# Least response of an atom in a frame with missing readings, over the largest one. A weaker atom is not seen.
MIN_SEEN = 1e-3
# Number of directions along which a contact is split.
SPLIT_DIRECTIONS = 4
# Width of each half of a contact that is split, as a fraction of the contact's own.
HALF_WIDTH = 0.75


class Atoms(eqx.Module):
    """Unit responses of bumps all over the sheet, from which contacts are started.

    Where readings are missing, a frame shows only part of each response; ``lengths`` makes the parts comparable.

    | meaning                                                              | shape  |
    |----------------------------------------------------------------------|--------|
    | atoms: responses, each of length one                                 | (b, r) |
    | starts: their x, y and log width                                     | (b, 3) |
    | norms: lengths of the responses                                      | (b,)   |
    | alike: products of the atoms                                         | (b, b) |
    | lengths: of the atoms as the frame shows them; infinite: not seen    | (b,)   |
    """

    atoms: Float[Array, "b r"]
    starts: Float[Array, "b 3"]
    norms: Float[Array, " b"]
    alike: Float[Array, "b b"]
    lengths: Float[Array, " b"]

    def gain(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, " b"]:
        """Root of the square of y that each atom explains alone; negative where its strength would be."""
        return self.atoms @ bumps.mixed(y) / self.lengths

    def likeness(self, bumps: FrameResponse, few: Int[Array, "..."]) -> Float[Array, "... b"]:
        """Products of a few atoms, by number, with all, each of length one as the frame shows it."""

        def mixed() -> Float[Array, "... b"]:
            seen = self.atoms[few] @ bumps.root.T @ bumps.root
            return seen @ self.atoms.T / (self.lengths[few][..., None] * self.lengths)

        found: Array = jax.lax.cond(bumps.whole, lambda: self.alike[few], mixed)
        return found

    def one_more(self, bumps: FrameResponse, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
        """One contact more: the atom that explains most of what is left."""
        gain = self.gain(bumps, y - bumps.response(theta)[0] if len(theta) else y)
        return jnp.concatenate([theta, self._contact(gain, jnp.argmax(gain))[None]])

    def other(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, "1 4"]:
        """Another start of a single contact: the atom that explains most of those unlike the best one.

        Beside an electrode the narrowest contact is a minimum of its own, to which the best atom may lead.
        """
        gain = self.gain(bumps, y)
        unlike = self.likeness(bumps, jnp.argmax(gain)) < MAX_LIKENESS
        return self._contact(gain, jnp.argmax(jnp.where(unlike, gain, -jnp.inf)))[None]

    def _contact(self, gain: Float[Array, " b"], atom: Int[Array, ""]) -> Float[Array, "4"]:
        strength = jnp.maximum(gain[atom], 0) / (self.norms[atom] * self.lengths[atom])
        return jnp.append(self.starts[atom], strength)

    def pair(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, "2 4"]:
        """Two contacts: the atoms that explain most together.

        Two contacts of one strength may look most like a single one between them, from which neither is found.
        """
        gain = self.gain(bumps, y)

        def explained(alike: Float[Array, " b"], one: Float[Array, ""]) -> Float[Array, " b"]:
            """By an atom of gain ``one`` together with each of all, where both have a strength above zero."""
            first, second, rest = one - alike * gain, gain - alike * one, 1 - alike**2
            fine = (rest > MIN_INDEPENDENT_FRACTION) & (first > 0) & (second > 0)
            return jnp.where(fine, one * first + gain * second, 0) / jnp.maximum(rest, MIN_INDEPENDENT_FRACTION)

        few = jax.lax.top_k(gain, min(PAIR_CANDIDATES, len(gain)))[1]
        j = jnp.argmax(jnp.max(jax.vmap(explained)(self.likeness(bumps, few), gain[few]), 0))
        like_j = self.likeness(bumps, j)
        pair = jnp.stack([jnp.argmax(explained(like_j, gain[j])), j])
        alike = like_j[pair[0]]
        rest = jnp.maximum(1 - alike**2, MIN_INDEPENDENT_FRACTION)
        strength = (gain[pair] - alike * gain[pair[::-1]]) / rest / (self.norms[pair] * self.lengths[pair])
        return jnp.concatenate([self.starts[pair], jnp.maximum(strength, 0)[:, None]], 1)


def lengths_of(
    atoms: Float[Array, "b r"], norms: Float[Array, " b"], root: Float[Array, "r r"], whole: Bool[Array, ""]
) -> Float[Array, " b"]:
    """`Atoms.lengths` of a frame; ``root`` and ``whole`` as in `FrameResponse`."""

    def mixed() -> Float[Array, " b"]:
        lengths = jnp.sqrt(jnp.sum((atoms @ root.T) ** 2, 1))
        seen = norms * lengths
        return jnp.where(seen > MIN_SEEN * jnp.max(seen), lengths, jnp.inf)

    found: Array = jax.lax.cond(whole, lambda: jnp.ones_like(norms), mixed)
    return found


def split(bumps: FrameResponse, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
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
