"""Covariance of fitted parameters: of independent samples, or of samples that depend on each other within groups."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxeit.linalg import eigh, svd

from .problem import CurveProblem, residuals

# Largest leverage of one press in a direction; above it the press alone determines it, and CR2 divides by the rest.
MAX_LEVERAGE = 1 - 1e-3
# Least mean derivative of the influence in any direction; below it nearly all samples there are outliers.
MIN_CURVATURE = 0.05


def independent_covariance(
    left: Float[Array, "n k"], psi: Float[Array, " n"], dpsi: Float[Array, " n"], valid: Bool[Array, " n"]
) -> Float[Array, "k k"]:
    """Huber's covariance in whitened coordinates, for independent residuals of equal variance."""
    n, k = jnp.sum(valid).astype(psi.dtype), left.shape[1]
    mean = jnp.sum(dpsi) / n
    variance = jnp.sum(jnp.where(valid, (dpsi - mean) ** 2, 0.0)) / n
    correction = 1 + k / n * variance / mean**2
    size = (correction / mean) ** 2 * jnp.sum(psi**2) / (n - k)
    return size * jnp.eye(k, dtype=left.dtype)


def cluster_covariance(
    left: Float[Array, "n k"], psi: Float[Array, " n"], dpsi: Float[Array, " n"], group: Int[Array, " n"], n_groups: int
) -> tuple[Float[Array, "k k"], Bool[Array, ""]]:
    """Sandwich over presses in whitened coordinates, and whether there are enough presses for it.

    Scores are corrected for the leverage of their own press (CR2). With G = U S V' the corrected score
    U_g' (I - U_g U_g')^(-1/2) psi_g equals (I - U_g' U_g)^(-1/2) U_g' psi_g, which needs only a k x k root per press.
    A press that alone determines a direction (an eigenvalue of one) leaves no scatter to estimate a variance from. The
    bread weights each sample with its own psi', because both residuals and slope grow with the load.
    """
    score = jax.ops.segment_sum(left * psi[:, None], group, n_groups)
    leverage = jax.ops.segment_sum(left[:, :, None] * left[:, None, :], group, n_groups)
    values, vectors = jax.vmap(eigh)(leverage)
    degenerate = values > MAX_LEVERAGE
    root = jax.lax.rsqrt(1 - values)
    adjusted = jnp.einsum("gij,gj,gkj,gk->gi", vectors, root, vectors, score)
    curvature, axes = eigh(left.T @ (left * dpsi[:, None]))
    bread = axes / curvature @ axes.T
    enough = ~jnp.any(degenerate) & (curvature[0] > MIN_CURVATURE)
    return bread @ adjusted.T @ adjusted @ bread, enough


def thin_svd(matrix: Float[Array, "n k"]) -> tuple[Float[Array, "n k"], Float[Array, " k"], Float[Array, "k k"]]:
    """U, singular values and V' of a tall matrix of few columns, by Gram-Schmidt applied twice (Giraud et al. 2005)."""
    columns: list[Array] = []
    for column in matrix.T:
        for _ in range(2):
            for earlier in columns:
                column = column - earlier * (earlier @ column)
        length = jnp.sqrt(column @ column)
        columns.append(column / jnp.where(length > 0, length, 1))
    q = jnp.stack(columns, 1)
    left, singular, right = svd(q.T @ matrix)
    return q @ left, singular, right


class CurveMinimum(NamedTuple):
    """End of a fit.

    | field       | meaning                                             | shape |
    |-------------|-----------------------------------------------------|-------|
    | free        | free parameters                                     | (k,)  |
    | spread      | scale of the residuals                              | ()    |
    | bend_weight | weight of the roughness penalty                     | ()    |
    | at_bound    | slopes and exponents that are on their lower bound  | (k,)  |
    """

    free: Float[Array, " k"]
    spread: Float[Array, ""]
    bend_weight: Float[Array, ""]
    at_bound: Bool[Array, " k"]


class CurveCovariance(NamedTuple):
    """Covariance of the parameters, and what it rests on.

    | field         | meaning                                                                           | shape  |
    |---------------|-----------------------------------------------------------------------------------|--------|
    | covariance    | of the parameters, in their units                                                 | (k, k) |
    | rank          | number of directions that the samples determine                                   | ()     |
    | enough        | whether there are enough groups                                                   | ()     |
    | contradiction | share of the residuals' influence that slopes below zero would explain; 0 if none | ()     |
    |               | is on its bound                                                                   |        |
    """

    covariance: Float[Array, "k k"]
    rank: Int[Array, ""]
    enough: Bool[Array, ""]
    contradiction: Float[Array, ""]


def covariance_at(end: CurveMinimum, problem: CurveProblem) -> CurveCovariance:
    """Covariance at the end of a fit.

    The Jacobian is with respect to the slopes as multiples of their start, not to their logarithms, so that a slope on
    its bound is not degenerate.
    """
    curve, samples, scale, loss = problem.curve, problem.samples, problem.scale, problem.loss
    unit = jnp.where(curve.positive, jnp.exp(problem.start - end.free), 1.0)
    r = residuals(end.free, curve, samples, scale, end.spread)
    jacobian = jax.jacfwd(residuals)(end.free, curve, samples, scale, end.spread) * unit
    left, singular, right = thin_svd(jacobian)
    tiny = singular[0] * max(jacobian.shape) * jnp.finfo(r.dtype).eps
    psi = jnp.where(samples.valid, loss.psi(r), 0.0)
    dpsi = jnp.where(samples.valid, loss.dpsi(r), 0.0)
    if problem.n_groups:
        inner, enough = cluster_covariance(left, psi, dpsi, samples.group, problem.n_groups)
    else:
        inner, enough = independent_covariance(left, psi, dpsi, samples.valid), jnp.array(True)
    units = jax.jacfwd(curve.bound)(end.free, scale) * unit @ (right.T / singular)
    bends = end.bend_weight * problem.bends
    push = psi @ jacobian
    gradient = jnp.minimum(push, push + bends.T @ (bends @ (1 / unit)))
    multiplier = jnp.where(end.at_bound, jnp.maximum(gradient, 0), 0)
    _, size, axes = thin_svd(jnp.concatenate([jacobian, bends])) if len(bends) else (left, singular, right)
    contradiction = jnp.sum(jnp.where(size > tiny, axes @ multiplier / size, 0) ** 2) / jnp.sum(psi**2)
    return CurveCovariance(units @ inner @ units.T, jnp.sum(singular > tiny), enough, contradiction)
