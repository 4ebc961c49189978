"""Places of contacts, as the images of frames tell them."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Integer

import jaxeit as je


class Places(eqx.Module):
    """Contacts of frames, as their images tell them.

    | field     | meaning                                                              | shape        | unit |
    |-----------|----------------------------------------------------------------------|--------------|------|
    | position  | of each contact, in the flat coordinates of the sheet; NaN: none     | (n, K, 2)    | m    |
    | weight    | share of each contact in what a pad carries; a row of zeros: unknown | (n, K, pads) | 1    |
    | width     | of its bump, as in `jaxeit.contacts.Contacts`; NaN: not known                 | (n, K)       | m    |
    | amplitude | of its bump; 0: not known, or none                                   | (n, K)       | S    |
    """

    position: Float[Array, "n K 2"]
    weight: Float[Array, "n K pads"]
    width: Float[Array, "n K"]
    amplitude: Float[Array, "n K"]

    @property
    def known(self) -> Bool[Array, "n pads"]:
        """Whether the place of a contact on each pad is known, (n, pads)."""
        return jnp.sum(self.weight, 1) > 0

    def __getitem__(self, rows: Integer[ArrayLike, " m"]) -> "Places":
        """The places of the frames of these numbers."""
        found: Places = _of_rows(self, rows)
        return found


@je.verb
def _of_rows(places: Places, rows: Integer[ArrayLike, " m"]) -> Places:
    found: Places = jax.tree.map(lambda leaf: leaf[rows], places)
    return found


def single_places(
    position: Float[ArrayLike, "n 2"] | Sequence[Sequence[float]],
    pads: int,
    width: Float[ArrayLike, "..."] = np.nan,
    amplitude: Float[ArrayLike, "..."] = 0.0,
) -> Places:
    """Places with one contact per frame at (n, 2) m, NaN: unknown, that counts for all pads.

    Args:
        width: of the contact's bump, (n,) m; NaN: not known.
        amplitude: of the contact's bump, (n,) S; 0: not known.
    """
    position = jnp.asarray(position)
    bump = (jnp.asarray(value, position.dtype) for value in (width, amplitude))
    found: Places = _single_places(position, pads, *bump)
    return found


@je.verb
def _single_places(
    position: Float[Array, "n 2"], pads: int, width: Float[Array, "..."], amplitude: Float[Array, "..."]
) -> Places:
    known = jnp.all(jnp.isfinite(position), -1)
    weight = jnp.broadcast_to(known[:, None, None], (len(position), 1, pads))
    bump = (jnp.broadcast_to(value, known.shape)[:, None] for value in (width, amplitude))
    return Places(position[:, None], weight.astype(position.dtype), *bump)


def nowhere(pressures: Float[Array, "n pads"], contacts: int = 1) -> Places:
    """Places of n frames in which no contact is known."""
    n, pads = pressures.shape
    position = jnp.full((n, contacts, 2), jnp.nan, pressures.dtype)
    weight, none = (jnp.zeros((n, contacts, *more), pressures.dtype) for more in ((pads,), ()))
    return Places(position, weight, none + jnp.nan, none)
