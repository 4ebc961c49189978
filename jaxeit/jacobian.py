"""The Jacobian of the readings with respect to an image of the conductivity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .basis import AbstractBasis, BasisMap, Elements
from .discretise import Model
from .forward import Coefficients, Fields, coefficients, fields, series_resistance

_BATCH = 64  # electrode pairs differentiated at once: bounds the memory to 64 images of the mesh


def jacobian(
    model: Model,
    sigma: Float[Array, " elements"] | None = None,
    basis: AbstractBasis | BasisMap | None = None,
) -> Float[Array, "readings basis"]:
    """Derivative of `forward` at ``sigma`` with respect to the coefficients of ``basis``, V/S.

    By automatic differentiation of the energy with the fields held fixed, which `forward` derives
    from the implicit function theorem: one factorisation, and one gradient for each of the L(L+1)/2
    electrode pairs that the readings are differences of.

    Args:
        sigma: (elements,) S; default: the untouched sheet.
        basis: the image, such as `Pixels`; default: one coefficient per element.  Under jit pass a
            `BasisMap` made outside with ``basis.on(model)``.

    Raises:
        ValueError: if ``sigma`` does not fit the model.
    """
    basis = Elements() if basis is None else basis
    image = basis if isinstance(basis, BasisMap) else basis.on(model)
    theta = coefficients(model, sigma)
    return _jacobian(model, theta, fields(model, theta), image)


@eqx.filter_jit
def _jacobian(model: Model, theta: Coefficients, x: Fields, image: BasisMap) -> Float[Array, "readings basis"]:
    first, second = np.triu_indices(model.electrodes)
    zero = jnp.zeros(image.size, model.dtype)

    def slope(pair):
        def resistance(coefficients):
            change = image.expand(coefficients)
            series = series_resistance(model.system, theta._replace(sigma=theta.sigma + change))
            own = jnp.where(pair[0] == pair[1], series[pair[0]], 0.0)
            return own - _pair_energy(model, change, x, pair)

        return jax.grad(resistance)(zero)

    pairs = jax.lax.map(slope, (jnp.asarray(first), jnp.asarray(second)), batch_size=_BATCH)
    # dZ is symmetric: `row` finds an unordered pair among the gradients.
    number = np.zeros((model.electrodes, model.electrodes), int)
    number[first, second] = number[second, first] = np.arange(len(first))
    row = jnp.asarray(number)
    source, sink, plus, minus = model.pattern.T
    out = pairs[row[plus, source]] - pairs[row[minus, source]]
    return model.current * (out - pairs[row[plus, sink]] + pairs[row[minus, sink]])


def _pair_energy(model: Model, sigma: Float[Array, " elements"], x: Fields, pair) -> Array:
    """Sheet part of ``A(theta; x_a, x_b)`` for one pair of electrodes."""
    a, b = (x.potential[:, index][model.system.dofs] for index in pair)
    return jnp.einsum("e,ei,eij,ej->", sigma, a, model.system.stiffness, b)
