"""How the criterion of a scan changes with its readings, and exchanges of readings one for one."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._compile import verb
from .contact_information import UNKNOWNS, inverse_information
from .criteria import AbstractCriterion

MIN_GAIN = 1e-4  # part of h by which an exchange must lower it
UPPER = np.triu_indices(UNKNOWNS)


class Cases(NamedTuple):
    """Candidates, and the cases over which h is averaged: all electrodes alive, and, if asked, each of them dead."""

    rows: Float[Array, "sites 4 candidates"]
    alive: Float[Array, "cases candidates"]
    prior: Float[Array, "4 4"]

    def only(self, kept: Any) -> "Cases":
        return self._replace(rows=self.rows[:, :, kept], alive=self.alive[:, kept])


def information_of(cases: Cases, weights: Float[Array, " candidates"]) -> Float[Array, "sites cases 4 4"]:
    """Information on the unknowns at each site in each case, that before the frame with it."""
    weighted = (cases.alive * weights).T

    def site(rows: Float[Array, "4 candidates"]) -> Float[Array, "cases 4 4"]:
        upper = (rows[UPPER[0]] * rows[UPPER[1]] @ weighted).T
        whole = jnp.zeros((len(upper), UNKNOWNS, UNKNOWNS), rows.dtype).at[:, *UPPER].set(upper)
        return whole + jnp.triu(whole, 1).swapaxes(1, 2) + cases.prior

    found: Array = jax.lax.map(site, cases.rows)
    return found


def inverse_of(information: Float[Array, "sites cases 4 4"]) -> Float[Array, "sites cases 4 4"]:
    """The covariance of this information."""
    return inverse_information(information.reshape(-1, UNKNOWNS, UNKNOWNS)).reshape(information.shape)


def covariance_of(cases: Cases, weights: Float[Array, " candidates"]) -> Float[Array, "sites cases 4 4"]:
    """Covariance of the unknowns at each site in each case."""
    return inverse_of(information_of(cases, weights))


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
    twice = np.where(UPPER[0] == UPPER[1], 1.0, 2.0).astype(rows.dtype)
    return (form[:, *UPPER] * twice) @ (rows[UPPER[0]] * rows[UPPER[1]])


def summed_forms(cases: Cases, forms: Float[Array, "sites cases 4 4"]) -> Float[Array, " candidates"]:
    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        return total + _quadratic(site[1], site[0]), None

    total, _ = jax.lax.scan(add, jnp.zeros_like(cases.alive), (cases.rows, forms))
    return jnp.sum(total * cases.alive, 0)


def changes(
    criterion: AbstractCriterion, cases: Cases, covariance: Float[Array, "sites cases 4 4"], sign: float
) -> Float[Array, " candidates"]:
    """The change of the mean of h when each candidate is added (sign 1) or taken away (-1), exactly.

    By Sherman and Morrison ``(M + s j j^T)^-1 = M^-1 - s k k^T / (1 + s j^T k)`` with ``k = M^-1 j``.
    """

    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        rows, inverse = site
        metric = jax.vmap(lambda c: c[:, :2] @ criterion.metric(c[:2, :2])[1] @ c[:2])(inverse)
        left = jnp.maximum(1 + sign * _quadratic(inverse, rows), 1e-12)
        place, nothing = inverse[:, :2, :2], jnp.zeros(1, rows.dtype)
        change = -sign * _quadratic(metric, rows) / left
        after = jax.vmap(criterion.after)(place, change) - jax.vmap(lambda p: criterion.after(p, nothing))(place)
        return total + jnp.sum(after * cases.alive, 0), None

    total, _ = jax.lax.scan(add, jnp.zeros(cases.alive.shape[1], cases.rows.dtype), (cases.rows, covariance))
    return total / (covariance.shape[0] * covariance.shape[1])


def exchanged(
    criterion: AbstractCriterion,
    cases: Cases,
    taken: np.ndarray,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
) -> tuple[np.ndarray, float]:
    """The readings after exchanges, and the mean of h."""
    now, best = jnp.asarray(taken), np.inf
    for _ in progress(range(2 * len(taken))):
        mean, after = _exchange(criterion, cases, now)
        if best - float(mean) <= MIN_GAIN * abs(float(mean)):
            break
        taken, best, now = np.asarray(now), float(mean), after
    return taken, best


@verb
def _exchange(
    criterion: AbstractCriterion, cases: Cases, taken: Int[Array, " count"]
) -> tuple[Float[Array, ""], Int[Array, " count"]]:
    """The mean of h for the readings taken, and the readings after the best one has come in and the least has gone."""

    def of(rows: Int[Array, " k"]) -> tuple[Cases, Float[Array, "sites cases 4 4"]]:
        part = cases.only(rows)
        return part, covariance_of(part, jnp.ones(len(rows), cases.rows.dtype))

    _, covariance = of(taken)
    worth = changes(criterion, cases, covariance, 1.0).at[taken].set(jnp.inf)
    more = jnp.append(taken, jnp.argmin(worth).astype(taken.dtype))
    out = jnp.argmin(changes(criterion, *of(more), -1.0))
    return mean_and_forms(criterion, covariance)[0], more.at[out].set(more[-1])[:-1]
