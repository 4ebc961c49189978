"""The interface of a field of log-gain over the place of a contact on a pad.

The force on pad i is F_i = exp(g_i(x)) h_i(P_i), with h_i the curve of the pad and g_i a *field* over the place x of
the contact. The place is the one that the image tells; a field may be fitted to the places where images show presses on
average (`steady`). Log-gain keeps the gain positive, and the field is linear in its coefficients: g_i(x) = (phi_i(x) -
c_i) @ beta, with c_i the mean of the features over the presses of the pad. The mean log-gain over the presses of a pad
is therefore zero, and the level of the pad belongs to its curve alone.
"""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxeit.registry import AbstractChoice

from .geometry import Geometry, OnPads

Features = Float[Array, "... pads k"]

# Width (m) of a contact at which the feature of the width is zero. The mean over the presses is subtracted from every
# feature, so that the value has no effect on a fit.
REFERENCE_WIDTH = 0.01


class AbstractField(AbstractChoice):
    """Features of a place on a pad, and the priors of their coefficients.

    `shared`: all pads have one field, in coordinates relative to the pad; otherwise each pad has its own coefficients.
    ``early`` holds settings that files of early versions lack, with the values that these versions had; ``former``
    those that this version lacks, with the values at which its fields are the same.
    ``steady``: the field is fitted to the places where images show presses on average, by the stage
    (`calib.fitting.fields.steady_places`), where they are known; otherwise to the place of each image.
    """

    early: ClassVar[Mapping[str, Any]] = {}
    former: ClassVar[Mapping[str, Any]] = {}
    steady: ClassVar[bool] = False
    shared: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        """Features (..., pads, k) at places (..., pads, 2) m on the pads."""

    @abc.abstractmethod
    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        """Relative prior variances of the coefficients of one pad, (shapes, k): one row for each shape of the prior."""

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """The box in which presses determine the field, from the box of the presses (corners -1 to 1 over the pad)."""
        return low, high

    def features(
        self, geometry: Geometry, place: OnPads, width: Float[ArrayLike, "..."] = REFERENCE_WIDTH
    ) -> Float[Array, "... pads m"]:
        """Features for the coefficients of all pads, of contacts at places (..., pads, 2) m with widths (...,) m.

        The features of one pad are zero for the coefficients of the others. A feature that depends on a width that is
        not known is NaN.
        """
        own = self.basis(geometry, place)
        if self.shared:
            return own
        apart = own[..., None, :] * jnp.eye(geometry.pads, dtype=own.dtype)[:, :, None]
        return apart.reshape(*own.shape[:-1], -1)

    def size(self, pads: int) -> int:
        """Number of coefficients for this number of pads."""
        return int(self.shapes().shape[1] * (1 if self.shared else pads))


def cubic_bspline(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """The cubic B-spline at a distance of z knots from its centre."""
    z = jnp.abs(z)
    inner = 2 / 3 - z**2 + z**3 / 2
    return jnp.where(z < 1, inner, jnp.maximum(2 - z, 0) ** 3 / 6)


def restore_field(kind: type[AbstractField], settings: Mapping[str, np.ndarray]) -> AbstractField:
    """The field of this class whose settings were stored as arrays, by setting."""
    given = {name: _setting(value) for name, value in settings.items()}
    kept = {name: value for name, value in given.items() if name not in kind.former or value != kind.former[name]}
    return kind(**{**kind.early, **kept})


def _setting(value: np.ndarray) -> Any:
    """A whole number or flag as Python's own; other settings as arrays."""
    if value.ndim == 0 and value.dtype.kind in "bui":
        return bool(value) if value.dtype.kind in "bu" else int(value)
    return jnp.asarray(value)
