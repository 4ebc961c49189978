"""The sheet conductivity of a scene: what its effects make of it under pressure, and the coefficients of the energy."""

from typing import NamedTuple, overload

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import verb
from ..effects import (
    AbstractContactEffect,
    AbstractLoadEffect,
    AbstractSheetEffect,
    Indenter,
    Sheet,
    chosen,
    fold,
)
from .discretisation import Model
from .matrix.metal_sheet import CoatCoefficients


class CoatedSheet(NamedTuple):
    """The conductivities of a sheet pressed against a metal coat.

    | meaning                                 | shape       | unit  |
    |-----------------------------------------|-------------|-------|
    | sigma: conductivity of the sheet itself | (elements,) | S     |
    | metal: conductivity of the coat         | ()          | S     |
    | coupling: conductance between the two   | (elements,) | S/m^2 |
    """

    sigma: Float[Array, " elements"]
    metal: Float[Array, ""]
    coupling: Float[Array, " elements"]


class Coefficients(NamedTuple):
    """The coefficients in which the energy A is linear: conductivity of the elements, S; contact conductances;
    coefficients of a coat, if it touches the sheet."""

    sigma: Float[Array, " elements"]
    contact: Float[Array, " electrodes"]
    coat: CoatCoefficients | None = None


@overload
def conductivity(
    model: Model, pressure: None = None, temperature: Float[ArrayLike, ""] = 0.0
) -> Float[Array, " elements"]: ...


@overload
def conductivity(
    model: Model, pressure: Float[Array, " elements"], temperature: Float[ArrayLike, ""] = 0.0
) -> Float[Array, " elements"] | CoatedSheet: ...


def conductivity(
    model: Model, pressure: Float[Array, " elements"] | None = None, temperature: Float[ArrayLike, ""] = 0.0
) -> Float[Array, " elements"] | CoatedSheet:
    """Sheet conductivity, (elements,) S, under the scene's material effects.

    If the scene has a metal coat and ``pressure`` is given, the result is a `CoatedSheet`: both sheets and
    their contact.  Without pressure the coat does not touch the sheet.

    Args:
        pressure: on the sheet, (elements,) Pa; default: none.
        temperature: above that at which the skin's sheet resistance was measured, K.
    """
    _require_values(model, "background", model.background)
    if not chosen(model.effects, AbstractSheetEffect):
        return model.background  # no effect changes it: the program is that of the ideal sensor
    return _conductivity(model, pressure, temperature)


@verb
def _conductivity(
    model: Model, pressure: Float[Array, " elements"] | None, temperature: Float[ArrayLike, ""]
) -> Float[Array, " elements"] | CoatedSheet:
    touched = pressure is not None
    pressure = jnp.zeros_like(model.background) if pressure is None else pressure
    warmer = jnp.asarray(temperature, model.dtype)
    sheet = Sheet(model.background, pressure, model.centroids, jnp.sqrt(model.areas), warmer)
    after = fold(model.effects, AbstractSheetEffect, sheet)
    return CoatedSheet(after.sigma, after.metal, after.coupling) if touched and after.metal is not None else after.sigma


@verb
def load_spread(
    model: Model,
    centre: Float[ArrayLike, "2"],
    diameter: Float[ArrayLike, ""],
    points: Float[Array, "points 2"] | None = None,
) -> Float[Array, " elements"] | Float[Array, " points"]:
    """Pressure on the sheet per unit load of a flat round tip, 1/m^2, at the middle of each element.

    The ideal tip presses evenly on its own area; effects of the scene may spread the load. A load that is narrower
    than the elements is not resolved: the sum over the elements of pressure times area is then not one.

    Args:
        centre: of the tip, (2,) m in the sheet's flat coordinates.
        diameter: of the tip, m.
        points: where else to tell the pressure, (points, 2) m.
    """
    points = model.centroids if points is None else points
    touch = Indenter(jnp.asarray(centre, model.dtype), jnp.asarray(diameter, model.dtype))
    offset = jnp.linalg.norm(points - touch.centre, axis=-1)
    even = jnp.where(offset < touch.diameter / 2, 4 / (jnp.pi * touch.diameter**2), 0.0)
    spread: Array = fold(model.effects, AbstractLoadEffect, even, touch, points)
    return spread


def coefficients(model: Model, sigma: Float[Array, " elements"] | CoatedSheet | None) -> Coefficients:
    """The coefficients for this conductivity, by default the scene's own; raises ValueError if it does not fit."""
    if sigma is None:
        sigma = conductivity(model)
    contact = fold(model.effects, AbstractContactEffect, model.contact)
    if not isinstance(sigma, CoatedSheet):
        return Coefficients(_checked_values(model, "sigma", sigma), contact)
    if model.coat is None:
        raise ValueError("this model has no metal coat; discretise a scene whose effects have one")
    sheet, coupling = _checked_values(model, "sigma", sigma.sigma), _checked_values(model, "coupling", sigma.coupling)
    return Coefficients(sheet, contact, CoatCoefficients(jnp.asarray(sigma.metal, model.dtype), coupling))


def _checked_values(model: Model, name: str, values: Float[Array, " elements"]) -> Float[Array, " elements"]:
    _require_values(model, name, values)
    # With small negative values the matrix remains positive definite, and the voltages would look valid.
    return jnp.where(values < 0, jnp.nan, values)


def _require_values(model: Model, name: str, values: Float[Array, "..."]) -> None:
    """Raise ValueError unless there is one value for each element, in the model's precision."""
    needed = model.areas.shape
    if values.shape != needed or values.dtype != model.dtype:
        batch = values.ndim > 1 and values.shape[-1:] == needed
        cast = values.shape == needed
        hint = "; use jax.vmap for a batch" if batch else "; use .astype(model.dtype)" if cast else ""
        raise ValueError(
            f"{name} is {values.dtype}{list(values.shape)}; this model needs "
            f"{model.dtype}{list(needed)}, one value per element{hint}"
        )
