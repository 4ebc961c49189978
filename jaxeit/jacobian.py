"""The Jacobian of the readings with respect to an image of the conductivity.

`forward` gives the derivative rule of the transfer matrix, ``dZ[a, b] = -A(dtheta; x_a, x_b)``: no
further solve.  As A is a sum over elements, the derivative for one coefficient of an image is that
sum over its few elements, ``-sum_e w_e sum_r g_era g_erb`` with the slopes g of the L fields.  All
readings are differences of these L(L+1)/2 products, which are formed for a batch of coefficients at
a time: nothing of the size elements times readings exists unless it is asked for.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from .basis import AbstractBasis, BasisMap, Elements
from .discretise import Model
from .effects import AbstractTerminalEffect, chosen
from .forward import CoatedSheet, Coefficients, coefficients, fields, series_resistance, transfer, voltages
from .verbs import verb

_BATCH = 512  # elements at once: their slopes and products stay in a core's cache


def jacobian(
    model: Model,
    sigma: Float[Array, " elements"] | None = None,
    basis: AbstractBasis | BasisMap | None = None,
) -> Float[Array, "readings basis"]:
    """Derivative of `forward` at ``sigma`` with respect to the coefficients of ``basis``, V/S.

    One factorisation and one substitution for the L fields; the rest is products (see above).

    Args:
        sigma: (elements,) S; default: the untouched sheet.
        basis: the image, such as `Pixels`; default: one coefficient per element.  Under jit pass a
            `BasisMap` made outside with ``basis.on(model)``.

    Raises:
        ValueError: if ``sigma`` does not fit the model, or is that of two sheets.
    """
    if isinstance(sigma, CoatedSheet):
        raise ValueError("sigma is that of a sheet and its coat; the Jacobian is for one sheet: give sigma.sigma")
    basis = Elements() if basis is None else basis
    image = basis if isinstance(basis, BasisMap) else basis.on(model)
    return _jacobian(model, None if sigma is None else jnp.asarray(sigma), image)


@verb
def _jacobian(model: Model, sigma: Float[Array, " elements"] | None, image: BasisMap) -> Float[Array, "readings basis"]:
    first, second = np.triu_indices(model.electrodes)
    # dZ is symmetric: `pair` finds an unordered pair of electrodes among the columns.
    number = np.zeros((model.electrodes, model.electrodes), np.int32)
    number[first, second] = number[second, first] = np.arange(len(first))
    pair = jnp.asarray(number)
    slopes = _pair_slopes(model, sigma, image, np.stack([first, second], 1))
    by_pair = jax.lax.optimization_barrier(slopes.T)
    if chosen(model.effects, AbstractTerminalEffect):
        z = transfer(model, coefficients(model, sigma))
        at_terminals = partial(jax.jvp, partial(voltages, model), (z,))
        return jax.vmap(lambda column: at_terminals((column[pair],))[1], 1, 1)(by_pair)
    source, sink, plus, minus = model.pattern.T
    out = by_pair[pair[plus, source]] - by_pair[pair[minus, source]]
    return model.current * (out - by_pair[pair[plus, sink]] + by_pair[pair[minus, sink]])


@verb
def pair_jacobian(
    model: Model,
    sigma: Float[Array, " elements"] | None,
    image: BasisMap,
    electrodes: Int[ArrayLike, "k 2"],
    mixed: Float[Array, "r k"] | None = None,
) -> Float[Array, "k basis"] | Float[Array, "r basis"]:
    """Derivative of the transfer matrix's entries for these pairs of electrodes, ohm/S, or of mixtures of them; see
    `whitening`."""
    slopes = _pair_slopes(model, sigma, image, electrodes).T
    return slopes if mixed is None else mixed @ slopes


def _pair_slopes(
    model: Model, sigma: Float[Array, " elements"] | None, image: BasisMap, pairs: Int[ArrayLike, "k 2"]
) -> Float[Array, "basis k"]:
    """dZ for these pairs of electrodes."""
    theta, (first, second) = coefficients(model, sigma), jnp.asarray(pairs).T
    products = _products(model, fields(model, theta).potential, image, first * model.electrodes + second)
    return jnp.where(first == second, _series_slopes(model, theta, image).T[:, first], 0) - products


def _products(
    model: Model, potential: Float[Array, "n electrodes"], image: BasisMap, place: Int[Array, " k"]
) -> Float[Array, "basis k"]:
    """A restricted to each coefficient, for the pairs of electrodes at these places of a matrix; batch after batch."""
    system, electrodes = model.system, model.electrodes
    lines = max(1, _BATCH // image.element.shape[1])
    count = -(-len(image.element) // lines)

    def batch(array, i):
        return jax.lax.dynamic_slice_in_dim(array, i * lines, lines)

    tables = [_padded(a, count * lines) for a in (image.element, image.weight, image.coefficient)]

    def add(i, sums):
        element, weight, coefficient = (batch(table, i) for table in tables)
        nodes = potential[system.dofs[element]]
        slopes = jnp.einsum("lekr,leka->lera", system.slopes[element], nodes).reshape(lines, -1, electrodes)
        weighted = jnp.repeat(weight, system.slopes.shape[2], 1)[..., None] * slopes
        products = jnp.einsum("lxa,lxb->lab", weighted, slopes).reshape(lines, -1)[:, place]
        return sums.at[coefficient].add(products)

    return jax.lax.fori_loop(0, count, add, jnp.zeros((image.size, len(place)), potential.dtype))


def _padded(array: Array, length: int) -> Array:
    return jnp.concatenate([array, jnp.zeros_like(array, shape=(length - len(array), *array.shape[1:]))])


def _series_slopes(model: Model, theta: Coefficients, image: BasisMap) -> Float[Array, "electrodes basis"]:
    """Derivative of the contact resistances in closed form, each of which knows few elements."""
    if not model.system.near_element.size:
        return jnp.zeros((model.electrodes, image.size), model.dtype)
    slopes = jax.jacrev(lambda sigma: series_resistance(model.system, theta._replace(sigma=sigma)))(theta.sigma)
    return jax.vmap(image.restrict)(slopes)
