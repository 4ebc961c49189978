"""Derivatives and changes of a scan's criterion by its readings, and exchanges of readings (Fedorov 1972)."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._compile import verb
from .contact_information import UNKNOWNS, inverse_information
from .criteria import AbstractCriterion

MIN_RELATIVE_FALL = 1e-4  # least fall of h by an exchange, over h
UPPER_TRIANGLE = np.triu_indices(UNKNOWNS)


class Cases(NamedTuple):
    """Candidates, and the cases over which h is averaged: all electrodes alive, and, if asked, each of them dead."""

    rows: Float[Array, "sites 4 candidates"]
    alive: Float[Array, "cases candidates"]
    prior: Float[Array, "4 4"]

    def subset(self, index: Any) -> "Cases":
        """Some of the candidates."""
        return self._replace(rows=self.rows[:, :, index], alive=self.alive[:, index])


def information_matrix(cases: Cases, weights: Float[Array, " candidates"]) -> Float[Array, "sites cases 4 4"]:
    """Information matrix of the unknowns at each site in each case, with that of the prior."""
    weighted = (cases.alive * weights).T

    def site(rows: Float[Array, "4 candidates"]) -> Float[Array, "cases 4 4"]:
        upper = (rows[UPPER_TRIANGLE[0]] * rows[UPPER_TRIANGLE[1]] @ weighted).T
        triangle = jnp.zeros((len(upper), UNKNOWNS, UNKNOWNS), rows.dtype).at[:, *UPPER_TRIANGLE].set(upper)
        return triangle + jnp.triu(triangle, 1).swapaxes(1, 2) + cases.prior

    found: Array = jax.lax.map(site, cases.rows)
    return found


def invert_information(information: Float[Array, "sites cases 4 4"]) -> Float[Array, "sites cases 4 4"]:
    """Covariance of the unknowns from their information matrix."""
    return inverse_information(information.reshape(-1, UNKNOWNS, UNKNOWNS)).reshape(information.shape)


def covariance_matrix(cases: Cases, weights: Float[Array, " candidates"]) -> Float[Array, "sites cases 4 4"]:
    """Covariance of the unknowns at each site in each case, for these weights."""
    return invert_information(information_matrix(cases, weights))


def mean_and_forms(
    criterion: AbstractCriterion, covariance: Float[Array, "sites cases 4 4"]
) -> tuple[Float[Array, ""], Float[Array, "sites cases 4 4"]]:
    """The mean of h, and the matrices Q with which ``-dh/dw_i = sum over sites and cases of j_i^T Q j_i``."""
    flat = covariance.reshape(-1, UNKNOWNS, UNKNOWNS)
    mean = criterion.mean(flat)

    def form(c: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        factor, metric = criterion.metric(c[:2, :2])
        return factor / len(flat) * c[:, :2] @ metric @ c[:2]

    return mean, jax.vmap(form)(flat).reshape(covariance.shape)


def _quadratic(form: Float[Array, "cases 4 4"], rows: Float[Array, "4 candidates"]) -> Float[Array, "cases candidates"]:
    """``j^T Q j`` of each candidate, in each case."""
    multiplicity = np.where(UPPER_TRIANGLE[0] == UPPER_TRIANGLE[1], 1.0, 2.0).astype(rows.dtype)
    return (form[:, *UPPER_TRIANGLE] * multiplicity) @ (rows[UPPER_TRIANGLE[0]] * rows[UPPER_TRIANGLE[1]])


def directional_derivatives(cases: Cases, forms: Float[Array, "sites cases 4 4"]) -> Float[Array, " candidates"]:
    """The derivatives ``-dh/dw_i`` from the matrices of `mean_and_forms`."""

    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        return total + _quadratic(site[1], site[0]), None

    total, _ = jax.lax.scan(add, jnp.zeros_like(cases.alive), (cases.rows, forms))
    return jnp.sum(total * cases.alive, 0)


def criterion_changes(
    criterion: AbstractCriterion, cases: Cases, covariance: Float[Array, "sites cases 4 4"], sign: float
) -> Float[Array, " candidates"]:
    """The exact change of the mean of h when each candidate is added (sign 1) or removed (-1).

    By Sherman and Morrison ``(M + s j j^T)^-1 = M^-1 - s k k^T / (1 + s j^T k)`` with ``k = M^-1 j``.
    """

    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        rows, inverse = site
        metric = jax.vmap(lambda c: c[:, :2] @ criterion.metric(c[:2, :2])[1] @ c[:2])(inverse)
        denominator = jnp.maximum(1 + sign * _quadratic(inverse, rows), 1e-12)
        place, zero = inverse[:, :2, :2], jnp.zeros(1, rows.dtype)
        change = -sign * _quadratic(metric, rows) / denominator
        after = jax.vmap(criterion.after)(place, change) - jax.vmap(lambda p: criterion.after(p, zero))(place)
        return total + jnp.sum(after * cases.alive, 0), None

    total, _ = jax.lax.scan(add, jnp.zeros(cases.alive.shape[1], cases.rows.dtype), (cases.rows, covariance))
    return total / (covariance.shape[0] * covariance.shape[1])


def exchange_readings(
    criterion: AbstractCriterion,
    cases: Cases,
    chosen: np.ndarray,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
) -> tuple[np.ndarray, float]:
    """Improve the chosen readings by exchanges; the readings, and the mean of h."""
    iterate, best = jnp.asarray(chosen), np.inf
    for _ in progress(range(2 * len(chosen))):
        mean, after = _exchange_step(criterion, cases, iterate)
        if best - float(mean) <= MIN_RELATIVE_FALL * abs(float(mean)):
            break
        chosen, best, iterate = np.asarray(iterate), float(mean), after
    return chosen, best


@verb
def _exchange_step(
    criterion: AbstractCriterion, cases: Cases, chosen: Int[Array, " count"]
) -> tuple[Float[Array, ""], Int[Array, " count"]]:
    """The mean of h for the chosen readings, and the readings after the best addition and removal."""

    def covariance_for(rows: Int[Array, " k"]) -> tuple[Cases, Float[Array, "sites cases 4 4"]]:
        subset = cases.subset(rows)
        return subset, covariance_matrix(subset, jnp.ones(len(rows), cases.rows.dtype))

    _, covariance = covariance_for(chosen)
    addition = criterion_changes(criterion, cases, covariance, 1.0).at[chosen].set(jnp.inf)
    larger = jnp.append(chosen, jnp.argmin(addition).astype(chosen.dtype))
    worst = jnp.argmin(criterion_changes(criterion, *covariance_for(larger), -1.0))
    return mean_and_forms(criterion, covariance)[0], larger.at[worst].set(larger[-1])[:-1]
