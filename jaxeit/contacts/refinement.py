"""Refinement of the contacts of one frame through the full forward map."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from .._compile import require_known, verb
from ..imaging.inputs import InverseError, require_real
from ..imaging.readings.whitening import Whitening
from ..least_squares import ImplicitStep
from ..least_squares.searches import normal_inverse
from ..model.discretisation import Model
from ..model.forward_model import forward
from ..model.sheet_conductivity import conductivity
from .bump_responses import mean_conductivity, quadrature_points
from .fit import MAX_STEPS, SOLVER, contact_bounds
from .preparation import sheet_and_readings
from .result import ContactResult, Contacts


def refine_contacts(
    model: Model,
    dv: Float[ArrayLike, " readings"],
    contacts: Contacts,
    *,
    noise: Float[ArrayLike, "..."],
    widths: tuple[float, float] = (0.003, 0.05),
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> Contacts:
    """Fit the contacts of one frame again through the full forward map, for use offline.

    Each step of Levenberg-Marquardt solves the forward problem once; derivatives cost no further solve (`forward`).

    Args:
        dv: difference of frames, (readings,) V.
        contacts: from a `ContactFinder`, of one frame; which are present is not looked at again.
        noise, untouched, sigma, channels: as for `prepare_contacts`.
        widths: bounds, m.

    Raises:
        InverseError: as for `prepare_contacts`, or if shapes do not fit, or a reading that is used is not finite.
    """
    require_known("refine_contacts", InverseError, dv, contacts)
    require_real(dv=dv)
    sigma, whitened = sheet_and_readings("refine_contacts", model, noise, untouched, sigma, channels)
    readings, dv, used = model.readings, np.asarray(dv, float), np.asarray(whitened.whitening.channels)
    if dv.shape != (readings,) or contacts.present.ndim != 1:
        raise InverseError(f"dv has shape {dv.shape}; refine one frame of {readings} readings at a time")
    if not np.isfinite(dv[used]).all():
        raise InverseError(f"reading {int(np.argmax(used & ~np.isfinite(dv)))} is not finite; leave its channel out")
    count = int(contacts.present.sum())
    if not count:
        return contacts
    sigma = conductivity(model) if sigma is None else jnp.asarray(sigma, model.dtype)
    chart = np.asarray(model.chart, float)
    points, weights = (jnp.asarray(a, model.dtype) for a in quadrature_points(model, widths[0] * 2))
    background = jnp.asarray(mean_conductivity(model, np.asarray(sigma, float)), model.dtype)
    compress = jnp.asarray(whitened.compress, model.dtype)
    problem = _ForwardProblem(
        model, sigma, background, forward(model, sigma), whitened.whitening, compress, points, weights
    )
    columns = [contacts.position, jnp.log(contacts.width)[:, None], contacts.amplitude[:, None]]
    start = jnp.concatenate(columns, 1)[:count].astype(model.dtype)
    low, high = (jnp.asarray(bound, model.dtype) for bound in contact_bounds(chart[:, 0], chart[:, 1], widths).values())
    return _fit_forward(problem, jnp.asarray(dv, model.dtype), contacts, start, low, high)


class _ForwardProblem(eqx.Module):
    """Forward model from contacts to whitened readings, by the full forward map."""

    model: Model
    sigma: Float[Array, " elements"]
    background: Float[Array, ""]
    untouched: Float[Array, " readings"]
    whitening: Whitening
    compress: Float[Array, "r k"]
    points: Float[Array, "elements q 2"]
    weights: Float[Array, " q"]

    def whiten(self, dv: Float[Array, " readings"]) -> Float[Array, " r"]:
        return self.compress @ self.whitening.sums(dv)

    def response(self, flat: Float[Array, " m"]) -> Float[Array, " r"]:
        """Whitened readings of contacts (x, y, log width, amplitude in S)."""
        change = sum(self._bump(contact) for contact in flat.reshape(-1, 4)) / self.background
        return self.whiten(forward(self.model, self.sigma * (1 + change)) - self.untouched)

    def _bump(self, contact: Float[Array, "4"]) -> Float[Array, " elements"]:
        square = jnp.sum((self.points - contact[:2]) ** 2, -1)
        return contact[3] * jnp.exp(-0.5 * square * jnp.exp(-2 * contact[2])) @ self.weights


@verb
def _fit_forward(
    problem: _ForwardProblem,
    dv: Float[Array, " readings"],
    contacts: Contacts,
    start: Float[Array, "n 4"],
    low: Float[Array, "4"],
    high: Float[Array, "4"],
) -> Contacts:
    count, y = len(start), problem.whiten(dv)
    low, high = jnp.tile(low, count), jnp.tile(high, count)
    solution: optx.Solution[Array, Any] = optx.least_squares(
        lambda flat, args: args[1] - args[0].response(flat),
        SOLVER,
        jnp.clip(start.ravel(), low, high),
        (problem, y),
        {"lower": low, "upper": high},
        max_steps=MAX_STEPS + 1,
        adjoint=ImplicitStep(),
        throw=False,
    )
    misfit = solution.state.square / max(len(y) - 4 * count, 1)
    covariance = _contact_covariances(solution, count) * jnp.maximum(misfit, 1)
    theta = solution.value.reshape(count, 4)
    return Contacts(
        present=contacts.present,
        position=contacts.position.at[:count].set(theta[:, :2]),
        width=contacts.width.at[:count].set(jnp.exp(theta[:, 2])),
        amplitude=contacts.amplitude.at[:count].set(theta[:, 3]),
        covariance=contacts.covariance.at[:count].set(covariance),
        misfit=misfit,
        result=contacts.result.at[:count].set(_results(solution, low, high)),
    )


def _results(
    solution: optx.Solution[Array, Any], low: Float[Array, " m"], high: Float[Array, " m"]
) -> Int[Array, " n"]:
    """`ContactResult` of each contact."""
    at_bound = ((solution.value <= low) | (solution.value >= high)).reshape(-1, 4).any(1)
    converged = jnp.where(at_bound, ContactResult.AT_BOUND, ContactResult.CONVERGED)
    return jnp.where(solution.state.converged, converged, ContactResult.NOT_CONVERGED)


def _contact_covariances(solution: optx.Solution[Array, Any], count: int) -> Float[Array, "n 4 4"]:
    """Covariance of the four parameters of each contact, for whitened readings of variance one."""
    normal = solution.state.quadratic.hessian.matrix
    covariance = normal_inverse(normal, jnp.ones(4 * count, bool))(jnp.eye(4 * count, dtype=normal.dtype))
    return covariance.reshape(count, 4, count, 4)[np.arange(count), :, np.arange(count)]
