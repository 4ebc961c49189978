"""Starts of fits of contacts: the atoms that explain most of a frame, alone or in pairs, and halves of a contact.

Atoms are the unit responses of a dictionary of bumps, and are chosen as in matching pursuit (Mallat and Zhang 1993).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .fit import FrameResponse

# Least fraction of an atom's square that is orthogonal to the other atom of a pair. Two atoms below it are one place
# twice, and their strengths would be differences of large numbers.
MIN_INDEPENDENT_FRACTION = 0.05
# Number of atoms, those that explain most alone, of which one is assumed to be in the pair that explains most.
PAIR_CANDIDATES = 64
# Largest correlation, the cosine of the angle between responses, of an atom with that from which a poor fit started.
MAX_CORRELATION = 0.95
# Least response of an atom in a frame with missing readings, over the largest one. Weaker atoms are left out.
MIN_RESPONSE_RATIO = 1e-3
# Number of directions along which a contact is split.
SPLIT_DIRECTIONS = 4
# Width of each half of a contact that is split, over that of the contact.
SPLIT_WIDTH_RATIO = 0.75


class Atoms(eqx.Module):
    """Dictionary of unit responses of bumps all over the sheet, from which fits of contacts start.

    Where readings are missing, a frame has only part of each response, of length ``lengths``.

    | meaning                                                              | shape  |
    |----------------------------------------------------------------------|--------|
    | atoms: responses, each of length one                                 | (b, r) |
    | starts: their x, y and log width                                     | (b, 3) |
    | norms: lengths of the responses                                      | (b,)   |
    | gram: Gram matrix of the atoms                                       | (b, b) |
    | lengths: of the atoms in the frame; infinite: left out               | (b,)   |
    """

    atoms: Float[Array, "b r"]
    starts: Float[Array, "b 3"]
    norms: Float[Array, " b"]
    gram: Float[Array, "b b"]
    lengths: Float[Array, " b"]

    def projections(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, " b"]:
        """Projections of y on the atoms, whose squares are what each explains alone; of the sign of its strength."""
        return self.atoms @ bumps.whiten(y) / self.lengths

    def correlations(self, bumps: FrameResponse, index: Int[Array, "..."]) -> Float[Array, "... b"]:
        """Correlations of the atoms of these indices with all atoms, in the frame."""

        def of_observed() -> Float[Array, "... b"]:
            products = self.atoms[index] @ bumps.root.T @ bumps.root
            return products @ self.atoms.T / (self.lengths[index][..., None] * self.lengths)

        found: Array = jax.lax.cond(bumps.whole, lambda: self.gram[index], of_observed)
        return found

    def add_best(self, bumps: FrameResponse, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
        """Add the atom that explains most of the residual to n contacts."""
        projections = self.projections(bumps, y - bumps.response(theta)[0] if len(theta) else y)
        return jnp.concatenate([theta, self._contact(projections, jnp.argmax(projections))[None]])

    def alternative(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, "1 4"]:
        """The atom that explains most among those not correlated with the best one, for a second fit of one contact.

        Beside an electrode the narrowest contact is a local minimum, to which the best atom may lead.
        """
        projections = self.projections(bumps, y)
        distinct = self.correlations(bumps, jnp.argmax(projections)) < MAX_CORRELATION
        return self._contact(projections, jnp.argmax(jnp.where(distinct, projections, -jnp.inf)))[None]

    def _contact(self, projections: Float[Array, " b"], atom: Int[Array, ""]) -> Float[Array, "4"]:
        strength = jnp.maximum(projections[atom], 0) / (self.norms[atom] * self.lengths[atom])
        return jnp.append(self.starts[atom], strength)

    def pair(self, bumps: FrameResponse, y: Float[Array, " r"]) -> Float[Array, "2 4"]:
        """The two atoms that explain most together.

        A single atom between two contacts of equal strength may explain most alone, and leads to neither of them.
        """
        projections = self.projections(bumps, y)

        def explained_square(correlation: Float[Array, " b"], one: Float[Array, ""]) -> Float[Array, " b"]:
            """By an atom of projection ``one`` together with each atom, where both strengths are above zero."""
            first, second = one - correlation * projections, projections - correlation * one
            independent = 1 - correlation**2
            valid = (independent > MIN_INDEPENDENT_FRACTION) & (first > 0) & (second > 0)
            square = jnp.where(valid, one * first + projections * second, 0)
            return square / jnp.maximum(independent, MIN_INDEPENDENT_FRACTION)

        best = jax.lax.top_k(projections, min(PAIR_CANDIDATES, len(projections)))[1]
        squares = jax.vmap(explained_square)(self.correlations(bumps, best), projections[best])
        j = jnp.argmax(jnp.max(squares, 0))
        with_j = self.correlations(bumps, j)
        pair = jnp.stack([jnp.argmax(explained_square(with_j, projections[j])), j])
        correlation = with_j[pair[0]]
        independent = jnp.maximum(1 - correlation**2, MIN_INDEPENDENT_FRACTION)
        orthogonal = projections[pair] - correlation * projections[pair[::-1]]
        strength = orthogonal / independent / (self.norms[pair] * self.lengths[pair])
        return jnp.concatenate([self.starts[pair], jnp.maximum(strength, 0)[:, None]], 1)


def observed_lengths(
    atoms: Float[Array, "b r"], norms: Float[Array, " b"], root: Float[Array, "r r"], whole: Bool[Array, ""]
) -> Float[Array, " b"]:
    """`Atoms.lengths` of a frame; ``root`` and ``whole`` as in `FrameResponse`."""

    def of_observed() -> Float[Array, " b"]:
        lengths = jnp.sqrt(jnp.sum((atoms @ root.T) ** 2, 1))
        responses = norms * lengths
        return jnp.where(responses > MIN_RESPONSE_RATIO * jnp.max(responses), lengths, jnp.inf)

    found: Array = jax.lax.cond(whole, lambda: jnp.ones_like(norms), of_observed)
    return found


def split_strongest(bumps: FrameResponse, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> Float[Array, "m 4"]:
    """Split the strongest of n contacts in two halves, along the best of a few directions."""
    strongest = jnp.argmax(theta[:, 3])
    angle = jnp.arange(SPLIT_DIRECTIONS, dtype=y.dtype) * (jnp.pi / SPLIT_DIRECTIONS)
    shift = jnp.exp(theta[strongest, 2]) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1)

    def halves(along: Float[Array, "2"]) -> Float[Array, "m 4"]:
        narrower = jnp.array([0, 0, np.log(SPLIT_WIDTH_RATIO), 0], y.dtype)
        half = theta[strongest] * jnp.array([1, 1, 1, 0.5], y.dtype) + narrower
        step = jnp.append(along, jnp.zeros(2, y.dtype))
        halved = jnp.concatenate([theta.at[strongest].set(half + step), (half - step)[None]])
        return jnp.clip(halved, bumps.low, bumps.high)

    starts: Array = jax.vmap(halves)(shift)
    squares = jax.vmap(lambda t: jnp.sum((y - bumps.response(t)[0]) ** 2))(starts)
    return starts[jnp.argmin(squares)]
