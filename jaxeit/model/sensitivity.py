"""The Jacobian of the readings with respect to an image of the conductivity.

The derivative rule of the transfer matrix, ``dZ[a, b] = -A(dtheta; x_a, x_b)`` (`forward_model`), needs
no further solve.  As A is a sum over elements, the derivative for one coefficient of an image is that
sum over its few elements, a product of the L fields at their nodes (`stiffness`).  All readings are
differences of these L(L+1)/2 products, which are formed for a batch of coefficients at a time:
no array of the size elements times readings exists unless the caller asks for it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer

from .._compile import verb
from ..budget import require
from ..effects import AbstractTerminalEffect, chosen
from ..messages.kinds import require_kind
from .bases import AbstractBasis, BasisMap, Elements
from .discretisation import Model, require_model
from .forward_model import Fields, energy, fields, series_resistance, series_slopes, terminal_matrix, voltages
from .sheet_conductivity import CoatedSheet, Coefficients, coefficients

BATCH_ELEMENTS = 512  # elements in a batch, whose slopes and products fit in a core's cache


def jacobian(
    model: Model,
    sigma: Float[ArrayLike, " elements"] | None = None,
    basis: AbstractBasis | BasisMap | None = None,
) -> Float[Array, "readings basis"]:
    """Derivative of `forward` at ``sigma`` with respect to the coefficients of ``basis``, V/S.

    One factorisation and one substitution for the L fields; the rest is products.

    Args:
        sigma: (elements,) S; default: the untouched sheet.
        basis: the image, such as `Pixels`; default: one coefficient per element.  Under jit pass a
            `BasisMap` made outside with ``basis.on(model)``.

    Raises:
        SceneError: if ``model`` is no model, such as a skin.
        ValueError: if ``sigma`` does not fit the model, is that of two sheets, or is a basis, or ``basis`` is none.
    """
    require_model(model)
    if isinstance(sigma, CoatedSheet):
        raise ValueError("sigma is that of a sheet and its coat; the Jacobian is for one sheet: give sigma.sigma")
    if isinstance(sigma, AbstractBasis | BasisMap):
        kind = type(sigma).__name__
        raise ValueError(f"sigma is a basis, {kind}; give it by name, as in jaxeit.jacobian(model, basis=...)")
    basis = Elements() if basis is None else basis
    require_kind(basis, (AbstractBasis, BasisMap), ValueError, "a basis", "an object, such as basis=Pixels(40)")
    image = basis if isinstance(basis, BasisMap) else basis.on(model)
    return scaled_jacobian(model, None if sigma is None else jnp.asarray(sigma), image)


@verb
def scaled_jacobian(
    model: Model,
    sigma: Float[Array, " elements"] | None,
    image: BasisMap,
    scale: Float[Array, " elements"] | None = None,
) -> Float[Array, "readings basis"]:
    """`jacobian`, for coefficients that change the elements' conductivity by ``scale`` times the basis."""
    theta = coefficients(model, sigma)
    return field_jacobian(model, theta, fields(model, theta), image, scale)


def field_jacobian(
    model: Model, theta: Coefficients, x: Fields, image: BasisMap, scale: Float[Array, " elements"] | None = None
) -> Float[Array, "readings basis"]:
    """`scaled_jacobian` from the fields x at theta, without a factorisation."""
    first, second = np.triu_indices(model.electrodes)
    # dZ is symmetric: `pair` finds an unordered pair of electrodes among the columns.
    number = np.zeros((model.electrodes, model.electrodes), np.int32)
    number[first, second] = number[second, first] = np.arange(len(first))
    pair = jnp.asarray(number)
    slopes = _pair_slopes(model, theta, x.potential, image, np.stack([first, second], 1), scale)
    by_pair: Array = jax.lax.optimization_barrier(slopes.T)
    if chosen(model.effects, AbstractTerminalEffect):
        z = terminal_matrix(model, theta, x)
        at_terminals = partial(jax.jvp, partial(voltages, model), (z,))
        felt: Array = jax.vmap(lambda column: at_terminals((column[pair],))[1], 1, 1)(by_pair)
        return felt
    source, sink, plus, minus = model.pattern.T
    out = by_pair[pair[plus, source]] - by_pair[pair[minus, source]]
    found: Array = model.current * (out - by_pair[pair[plus, sink]] + by_pair[pair[minus, sink]])
    return found if model.mixing is None else model.mixing(found)


def field_slope(
    model: Model, theta: Coefficients, x: Fields, direction: Float[Array, " elements"]
) -> Float[Array, " readings"]:
    """Derivative of the readings along a change of the elements' conductivity, V, from the fields x at theta."""
    change = theta._replace(sigma=direction, contact=jnp.zeros_like(theta.contact))
    own = jax.jvp(partial(series_resistance, model.system), (theta,), (change,))[1]
    slope = jnp.diag(own) - energy(model, change, x)
    felt: Array = jax.jvp(partial(voltages, model), (terminal_matrix(model, theta, x),), (slope,))[1]
    return felt


def pair_jacobian(
    model: Model,
    sigma: Float[Array, " elements"] | None,
    image: BasisMap,
    electrodes: Integer[ArrayLike, "k 2"],
    mixed: Float[Array, "r k"] | None = None,
) -> Float[Array, "k basis"] | Float[Array, "r basis"]:
    """Derivative of the transfer matrix's entries for these pairs of electrodes, ohm/S, or of mixtures of them; see
    `whitening`.

    Two programs: the images of one model share that of the fields, which takes most of the time to compile.
    """
    theta, x = solved_fields(model, sigma)
    found: Array = _mixed_slopes(model, theta, x.potential, image, electrodes, mixed)
    return found


@verb
def solved_fields(model: Model, sigma: Float[Array, " elements"] | None) -> tuple[Coefficients, Fields]:
    """The coefficients for a conductivity, by default the scene's own, and the fields at them."""
    theta = coefficients(model, sigma)
    return theta, fields(model, theta)


@verb
def _mixed_slopes(
    model: Model,
    theta: Coefficients,
    potential: Float[Array, "n electrodes"],
    image: BasisMap,
    electrodes: Integer[ArrayLike, "k 2"],
    mixed: Float[Array, "r k"] | None,
) -> Float[Array, "k basis"] | Float[Array, "r basis"]:
    slopes = _pair_slopes(model, theta, potential, image, electrodes).T
    return slopes if mixed is None else mixed @ slopes


def element_slopes(
    model: Model,
    theta: Coefficients,
    potential: Float[Array, "n electrodes"],
    element: Int[Array, " e"],
    pairs: Integer[ArrayLike, "k 2"],
) -> Float[Array, "e k"]:
    """Derivative of the transfer matrix's entries for these pairs of electrodes with respect to the conductivity of a
    few elements, ohm/S, from the fields at theta."""
    first, second = jnp.asarray(pairs).T
    system = model.system
    gradients = system.gradients(potential, element)
    products = jnp.sum(gradients[..., first] * gradients[..., second], 1)
    if not system.near_element.size:
        return -products
    series = series_slopes(system, theta)[:, element]
    return jnp.where(first == second, series.T[:, first], 0) - products


def _pair_slopes(
    model: Model,
    theta: Coefficients,
    potential: Float[Array, "n electrodes"],
    image: BasisMap,
    pairs: Integer[ArrayLike, "k 2"],
    scale: Float[Array, " elements"] | None = None,
) -> Float[Array, "basis k"]:
    """dZ for these pairs of electrodes."""
    pair_count = np.shape(pairs)[0]
    require("array_bytes", model.dtype.itemsize * image.size * pair_count, "jacobian: image times pairs of electrodes")
    made_for, given = (image.elements, image.stiffness.unknowns), (len(model.areas), model.system.unknowns)
    if made_for != given:
        raise ValueError(
            f"the basis lies on a model of {made_for[0]} elements and {made_for[1]} unknowns, this one has {given[0]} "
            f"and {given[1]}; make basis.on(model) of this model"
        )
    first, second = jnp.asarray(pairs).T
    if scale is None and model.system.moved:  # the stiffness of the image is that of the mesh before
        scale = jnp.ones_like(model.background)
    if scale is None:
        owner = None if image.single else image.coefficient
        products = image.stiffness.products(potential, (first, second), owner, image.size)
    else:
        products = _by_elements(model, potential, image, (first, second), scale)
    series = _series_slopes(model, theta, image, scale)
    return jnp.where(first == second, series.T[:, first], 0) - products


def _by_elements(
    model: Model,
    potential: Float[Array, "n electrodes"],
    image: BasisMap,
    pairs: tuple[Int[Array, " k"], Int[Array, " k"]],
    scale: Float[Array, " elements"],
) -> Float[Array, "basis k"]:
    """The result of `Stiffness.products` with elements weighted by ``scale``, one batch of lines after another."""
    system, (first, second) = model.system, pairs
    weights = image.weight * scale[image.element]
    size = min(len(weights), max(1, BATCH_ELEMENTS // image.element.shape[1]))

    def line(element: Int[Array, " e"], weight: Float[Array, " e"]) -> Float[Array, " k"]:
        gradients = system.gradients(potential, element)
        return jnp.einsum("e,era,erb->ab", weight, gradients, gradients)[first, second]

    found = jax.lax.map(lambda table: line(*table), (image.element, weights), batch_size=size)
    return jnp.zeros((image.size, len(first)), potential.dtype).at[image.coefficient].add(found)


def _series_slopes(
    model: Model, theta: Coefficients, image: BasisMap, scale: Float[Array, " elements"] | None
) -> Float[Array, "electrodes basis"]:
    """Derivative of the contact resistances in closed form, each of which depends on few elements."""
    if not model.system.near_element.size:
        return jnp.zeros((model.electrodes, image.size), model.dtype)
    slopes = series_slopes(model.system, theta)
    return jax.vmap(image.restrict)(slopes if scale is None else scale * slopes)
