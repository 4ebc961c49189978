"""The forward model: from sheet conductivity to voltages.

All readings are differences of the entries of one small symmetric matrix, the transfer matrix
``Z[a, b]``: the potential of electrode a per ampere driven into electrode b (and out at a ground inside the
sheet, which cancels).  With x_a the field of a unit current into electrode a, and
``A(theta; x, y) = integral of sigma grad x . grad y + sum_l g_l integral over E_l of (x - X_l)(y - Y_l)``,

    Z[a, b] = A(theta; x_a, x_b),          dZ[a, b] = -A(dtheta; x_a, x_b),

since A is linear in theta = (sigma, g) and the fields are stationary.  The derivative needs no
further solve (the adjoint identity; Geselowitz 1971, Lehr 1972).  Where a metal coat touches the sheet
(`metal_sheet`), A has two more terms; the rest is the same.
"""

from dataclasses import replace
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import i0e, i1e
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import full_precision, verb
from ..effects import AbstractTerminalEffect, Circuit, fold
from ..linalg import AbstractPlan, inverse_columns
from ..linalg.array_libraries import real_array
from ..linalg.small_matrices import summed
from .discretisation import Model, require_model
from .matrix.metal_sheet import CoatFields, assemble_coat, coat_energy, coat_fields
from .matrix.system import System
from .sheet_conductivity import CoatedSheet, Coefficients, coefficients, conductivity


class Fields(NamedTuple):
    """Potentials per ampere driven into each electrode, in ohm.

    | meaning                                        | shape                       |
    |------------------------------------------------|-----------------------------|
    | potential of the sheet at its unknowns         | (unknowns, electrodes)      |
    | drop from sheet to electrode, where under one  | (unknowns, electrodes)      |
    | terminal: potential of each electrode          | (electrodes, electrodes)    |
    | coat: fields of the coat, if it touches        |                             |
    """

    potential: Float[Array, "unknowns electrodes"]
    drop: Float[Array, "unknowns electrodes"]
    terminal: Float[Array, "electrodes electrodes"]
    coat: CoatFields | None


def forward(
    model: Model, sigma: Float[ArrayLike, " elements"] | CoatedSheet | None = None
) -> Float[Array, " readings"]:
    """Voltages of one frame.

    Args:
        model: from `discretise`.
        sigma: sheet conductivity of each element, S, or a result of `conductivity`; default: that of
            the untouched sheet.

    Returns:
        (readings,) V, in the order of the protocol; none of them finite if ``sigma`` is negative anywhere, or
        zero all around a place.  If parts of the sheet hardly touch, digits are lost: see `rounding`.

    Raises:
        ValueError: if ``sigma`` has another shape or precision than the model, or has a coat and the model none.
        SceneError: if ``model`` is no model, such as a skin.
        DerivativeError: if JAX differentiates with respect to the mesh of the model or arrays made of it.
    """
    require_model(model)
    sigma = conductivity(model) if sigma is None else sigma  # one program, with or without a conductivity given
    return _forward(model, sigma if isinstance(sigma, CoatedSheet) else real_array("sigma", sigma, ValueError))


@verb
def _forward(model: Model, sigma: Float[Array, " elements"] | CoatedSheet) -> Float[Array, " readings"]:
    return voltages(model, transfer(model, coefficients(model, sigma)))


@verb
def rounding(model: Model, sigma: Float[Array, " elements"] | CoatedSheet | None = None) -> Float[Array, " readings"]:
    """Estimated rounding error of each reading of `forward`, (readings,) V.

    A reading is a potential difference and also an energy of the same fields.  If the fields have an error e, the
    potential has the error ``A(x, e)``, and the energy twice that and a square: the difference of the two is the
    error, to first order.  The energy depends on differences of potentials only, so that it is exact for a part of
    the sheet whose potential is off as a whole because it hardly touches the ground.

    Arguments as for `forward`; it takes a few times as long.
    """
    theta = coefficients(model, sigma)
    x = fields(model, theta)
    return jnp.abs(readings(model, energy(model, theta, x)) - readings(model, x.terminal))


def voltages(model: Model, z: Float[Array, "electrodes electrodes"]) -> Float[Array, " readings"]:
    """Voltages of the protocol from the transfer matrix in ohm, with errors of the scene's source and amplifiers."""
    circuit = Circuit(z, model.pattern, model.current)
    found: Array = fold(model.effects, AbstractTerminalEffect, readings(model, z), circuit)
    return found


def readings(model: Model, z: Float[Array, "electrodes electrodes"]) -> Float[Array, " readings"]:
    """Voltages of the protocol from the transfer matrix in ohm."""
    found: Array = model.current * four_terminal(z, model.pattern)
    return found if model.mixing is None else model.mixing(found)


def four_terminal(z: Any, pattern: Any) -> Any:
    """Readings (..., readings) of a pattern (readings, 4) from matrices (..., electrodes, electrodes), NumPy or JAX."""
    source, sink, plus, minus = pattern.T
    return z[..., plus, source] - z[..., minus, source] - z[..., plus, sink] + z[..., minus, sink]


class DerivativeError(ValueError):
    """A derivative with respect to an array that is not a parameter of the physics.

    Example:
        import equinox as eqx

        try:
            eqx.filter_grad(lambda model: je.forward(model).sum())(model)  # of the mesh, too
        except je.model.DerivativeError as error:
            print(error)
    """


@jax.custom_jvp
def _without_derivative(geometry: dict[str, Any]) -> dict[str, Any]:
    """The same arrays. JAX calls the rule below only if it differentiates with respect to one of them."""
    return geometry


@_without_derivative.defjvp
def _(_: Any, __: Any) -> NoReturn:
    raise DerivativeError(
        "the model has no derivative with respect to its mesh and the matrices made of it (nodes, chart, centroids, "
        "areas, system, coat); differentiate with respect to sigma, or to background, contact, current or the effects "
        "of the model, one of which eqx.tree_at puts in place, or to the shifts of its electrodes (je.model.moved)"
    )


@jax.custom_jvp
def _perfect_contact(contact: Float[Array, " electrodes"]) -> Float[Array, " electrodes"]:
    """The same array, for a skin without contact resistances; the rule below refuses its derivative."""
    return contact


@_perfect_contact.defjvp
def _(_: Any, __: Any) -> NoReturn:
    raise DerivativeError(
        "no electrode of this model has a contact resistance, so that readings do not depend on its contacts; give the "
        "electrodes a contact above zero to differentiate with respect to it"
    )


def _parameters_only(model: Model, theta: Coefficients) -> tuple[Model, Coefficients]:
    """Model and coefficients that refuse derivatives which would be zero without a reason.

    The derivative rule of the transfer matrix contains the coefficients, and the system if its electrodes move.
    """
    names = ("nodes", "chart", "centroids", "areas", "coat", *(() if model.system.moved else ("system",)))
    fixed = _without_derivative({name: getattr(model, name) for name in names})
    system = model.system
    if not system.contact_dofs.size and not system.near_element.size:
        theta = theta._replace(contact=_perfect_contact(theta.contact))
    return replace(model, **fixed), theta


@verb
def transfer(model: Model, theta: Coefficients) -> Float[Array, "electrodes electrodes"]:
    """The transfer matrix Z in ohm; its derivatives of first order cost no further solve.

    Raises:
        DerivativeError: if JAX differentiates with respect to the mesh of the model or arrays made of it.
    """
    model, theta = _parameters_only(model, theta)
    z: Array = _transfer(theta, model) + jnp.diag(series_resistance(model.system, theta))
    return z


def series_resistance(system: System, theta: Coefficients) -> Float[Array, " electrodes"]:
    """Contact resistance of discs taken in closed form, ohm; else 0: ``laplace(u) = (u - U) g / sigma`` under the disc.

    With x = a sqrt(g / sigma), the radius over the transfer length:
    ``R = I0(x) / I1(x) / (2 pi a sqrt(sigma g))``.
    """
    near = system.near_share * theta.sigma[system.near_element]
    sigma = jnp.zeros_like(theta.contact).at[system.near_electrode].add(near)
    lumped = system.lumped > 0
    # Electrodes without a closed form have the value 1 here, so that no NaN enters a gradient.
    radius, sigma, contact = (jnp.where(lumped, v, 1.0) for v in (system.lumped, sigma, theta.contact))
    x = radius * jnp.sqrt(contact / sigma)
    resistance = i0e(x) / i1e(x) / (2 * jnp.pi * radius * jnp.sqrt(sigma * contact))
    return jnp.where(lumped, resistance, 0.0)


def series_slopes(system: System, theta: Coefficients) -> Float[Array, "electrodes elements"]:
    """Derivative of `series_resistance` with respect to the conductivity of each element, ohm/S."""
    found: Array = jax.jacrev(lambda sigma: series_resistance(system, theta._replace(sigma=sigma)))(theta.sigma)
    return found


def terminal_matrix(model: Model, theta: Coefficients, x: Fields) -> Float[Array, "electrodes electrodes"]:
    """The transfer matrix Z in ohm, from the fields x at theta."""
    return x.terminal + jnp.diag(series_resistance(model.system, theta))


@eqx.filter_custom_jvp
def _transfer(theta: Coefficients, model: Model) -> Float[Array, "electrodes electrodes"]:
    plan, matrix = _matrix(model, theta)
    corner = model.solver.corner(plan, matrix.values) - matrix.lift
    return corner[model.system.electrode_root][:, model.system.electrode_root]


@full_precision
def _transfer_jvp(
    primals: tuple[Coefficients, Model], tangents: tuple[Coefficients | None, Any]
) -> tuple[Float[Array, "electrodes electrodes"], Float[Array, "electrodes electrodes"]]:
    theta, model = primals
    direction, of_model = tangents
    x = fields(model, theta)
    slope = jnp.zeros_like(x.terminal)
    if direction is not None:
        slope = -energy(model, _filled(direction, theta), x)
    if model.system.moved and of_model is not None:
        slope = slope - _moved_energy(model, theta, x, of_model.system)
    return x.terminal, slope


def _moved_energy(model: Model, theta: Coefficients, x: Fields, direction: System) -> Float[Array, "a b"]:
    """Derivative of the energy of fields that are held, in the direction of a change of slopes and contacts."""

    def held(slopes: Float[Array, "elements k r"], mass: Float[Array, "p k k"]) -> Float[Array, "a b"]:
        return energy(replace(model, system=replace(model.system, slopes=slopes, contact_mass=mass)), theta, x)

    parts = (model.system.slopes, model.system.contact_mass)
    changes = tuple(
        jnp.zeros_like(part) if change is None else change
        for part, change in zip(parts, (direction.slopes, direction.contact_mass), strict=True)
    )
    change: Array = jax.jvp(held, parts, changes)[1]
    return change


_transfer.def_jvp(_transfer_jvp)


def _filled(direction: Coefficients, theta: Coefficients) -> Coefficients:
    filled: Coefficients = jax.tree.map(lambda t, d: jnp.zeros_like(t) if d is None else d, theta, direction)
    return filled


@verb
def fields(model: Model, theta: Coefficients) -> Fields:
    """Fields of a unit current into each electrode; one factorisation, differentiable as `transfer` is."""
    model, theta = _parameters_only(model, theta)
    system = model.system
    plan, matrix = _matrix(model, theta)
    whole = inverse_columns(model.solver, plan, matrix.values)[:, system.electrode_root]
    x = whole[: system.unknowns]
    terminal = x[system.electrode_dof]
    return Fields(
        potential=x + _under_electrodes(system, matrix.share[:, None] * terminal) - matrix.lift,
        drop=x - _under_electrodes(system, matrix.rest[:, None] * terminal),
        terminal=terminal - matrix.lift,
        coat=coat_fields(model.coat, theta.coat, whole, matrix.share) if model.coat and theta.coat else None,
    )


class Matrix(NamedTuple):
    """The matrix for (w, U), as numbers.

    | meaning                                                            | shape         | unit |
    |--------------------------------------------------------------------|---------------|------|
    | values of its lower triangle                                       | (nnz,)        | S    |
    | share, rest: s and 1 - s of the module `unknowns`                  | (electrodes,) | 1    |
    | lift: potential of the grounded unknown per ampere into the sheet  | ()            | ohm  |
    """

    values: Float[Array, " nnz"]
    share: Float[Array, " electrodes"]
    rest: Float[Array, " electrodes"]
    lift: Float[Array, ""]


def _matrix(model: Model, theta: Coefficients) -> tuple[AbstractPlan, Matrix]:
    """The plan and the matrix of the sheet, or of sheet and coat if the coat touches."""
    matrix = assemble(model.system, theta)
    if model.coat and theta.coat:
        both = assemble_coat(model.coat, theta.coat, matrix.values, matrix.share)
        return model.coat.plan, matrix._replace(values=both)
    return model.system.plan, matrix


def _under_electrodes(system: System, values: Float[Array, "electrodes k"]) -> Float[Array, "n k"]:
    """Each electrode's values at the unknowns under it, zero elsewhere."""
    return jnp.concatenate([values, jnp.zeros_like(values[:1])])[system.under]


def assemble(system: System, theta: Coefficients) -> Matrix:
    """The matrix for (w, U).

    The shares determine the unknowns only, and the ground the constant: no difference of potentials depends
    on them, nor do its derivatives.
    """
    sigma, contact = theta.sigma, theta.contact
    chi, electrode = system.rim_chi, system.rim_electrode
    around = sigma[system.rim_element, None] * system.rim_flux
    sheet = jnp.zeros_like(contact).at[electrode].add(jnp.sum(chi * around, 1))
    touch = contact * system.measure
    total = jnp.where(touch > 0, touch + sheet, 1.0)
    share, rest = jax.lax.stop_gradient((touch / total, sheet / total))

    pieces = contact[system.contact_electrode]
    load = pieces[:, None] * system.contact_mass.sum(2)
    contributions = [
        pieces[:, None, None] * system.contact_mass,
        share[electrode, None] * around,
        -rest[system.contact_electrode, None] * load,
        share**2 * sheet + rest**2 * touch,
        jnp.prod(share[system.bridge_electrodes], 1) * sigma[system.bridge_element] * system.bridge_flux,
    ]
    values = jnp.concatenate([summed(e.weight * sigma[e.element], 1) for e in system.sheet])
    added = jnp.concatenate([c.ravel() for c in contributions])
    values, lift = _grounded(system, values.at[system.slots].add(added, mode="drop"))
    return Matrix(values, share, rest, lift)


def _grounded(system: System, values: Float[Array, " nnz"]) -> tuple[Float[Array, " nnz"], Float[Array, ""]]:
    """The matrix with one unknown grounded, and the potential of that unknown per ampere into the sheet, ohm.

    The ground is the unknown with the largest weighted conductance on the diagonal; a conductance as large joins it
    to zero volts.  All current leaves there, so its potential depends on this conductance only.
    """
    own = jax.lax.stop_gradient(values[system.plan.diagonal[system.ground]])
    best = jnp.argmax(own * system.ground_weight)
    place = system.plan.diagonal[system.ground[best]]
    return values.at[place].add(own[best]), 1 / own[best]


def energy(model: Model, theta: Coefficients, x: Fields) -> Float[Array, "a b"]:
    """``A(theta; x_a, x_b)`` for all pairs of fields, in ohm."""
    system = model.system
    gradients = system.gradients(x.potential)
    # As a product of stored matrices, whose derivative by sigma is one as well: XLA would gather the potentials again
    # for each use, and multiply with the axes of a product of three transposed.
    rows: Array = jax.lax.optimization_barrier(gradients.reshape(-1, gradients.shape[2]))
    sigma = jnp.broadcast_to(theta.sigma[:, None], gradients.shape[:2]).reshape(-1, 1)
    sheet = (sigma * rows).T @ rows
    drop = x.drop[system.contact_dofs]
    mass = theta.contact[system.contact_electrode][:, None, None] * system.contact_mass
    own = sheet + jnp.einsum("pia,pij,pjb->ab", drop, mass, drop)
    if model.coat and theta.coat and x.coat:
        return own + coat_energy(model.coat, theta.coat, x.coat)
    return own
