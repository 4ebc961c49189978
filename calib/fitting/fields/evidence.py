"""Posterior of linear coefficients, averaged over priors.

Each prior of a fixed list, of every size and shape, is weighted by its restricted marginal likelihood, with the noise
profiled and the levels of the pads integrated out (Patterson and Thompson 1971, Biometrika 58; Rasmussen and Williams
2006, 5.4).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxeit.linalg import eigh, solve

# Sizes of the prior: variance of a coefficient over the variance of the noise. The smallest allows no visible field,
# the largest leaves the coefficients to the presses; four sizes per decade.
PRIOR_RATIOS = np.logspace(-3, 7, 41)


class ProjectedPresses(NamedTuple):
    """Weighted features z (n, m) and log ratios y (n,) of presses without the pads' levels; degrees of freedom left."""

    z: Array
    y: Array
    degrees: Array


def project_out_levels(
    z: Float[Array, "n m"], y: Float[Array, " n"], share: Float[Array, "n pads"], weight: Float[Array, " n"]
) -> ProjectedPresses:
    """Project the levels of the pads out of features and log ratios, since they belong to the curves."""
    root = jnp.sqrt(weight)[:, None]
    z, y, x = z * root, y * root[:, 0], share * root
    present = jnp.sum(x**2, 0) > 0
    gram = x.T @ x + jnp.diag(jnp.where(present, 1e-12, 1.0).astype(x.dtype))
    levels = solve(gram, x.T @ jnp.column_stack([z, y]))
    residual = jnp.column_stack([z, y]) - x @ levels
    degrees = jnp.sum(weight) - jnp.sum(present, dtype=weight.dtype)
    return ProjectedPresses(residual[:, :-1], residual[:, -1], jnp.maximum(degrees, 1.0))


class Posterior(NamedTuple):
    """Coefficients and covariance over all priors.

    ``evidence`` is the largest log evidence, ``variance`` that of the noise, and ``effective`` the number of
    coefficients that the presses determine: the trace of the matrix that maps log ratios to their fit.
    """

    coefficients: Array
    covariance: Array
    evidence: Array
    variance: Array
    effective: Array


class _ShapePosterior(NamedTuple):
    """Posteriors of one shape of prior, in the axes in which the prior of every size is diagonal; rows are sizes.

    | field    | meaning                                                | shape      |
    |----------|--------------------------------------------------------|------------|
    | evidence | log of the restricted marginal likelihood              | (sizes,)   |
    | variance | of the noise                                           | (sizes,)   |
    | shrink   | posterior variance of the coordinates over the noise's | (sizes, m) |
    | moment   | posterior mean of the coordinates                      | (sizes, m) |
    | axes     | coefficients for each coordinate                       | (m, m)     |
    | trace    | number of coordinates that the presses determine       | (sizes,)   |
    """

    evidence: Array
    variance: Array
    shrink: Array
    moment: Array
    axes: Array
    trace: Array


def _shape_posterior(projected: ProjectedPresses, shape: Float[Array, " m"]) -> _ShapePosterior:
    root, ratio = jnp.sqrt(shape), jnp.asarray(PRIOR_RATIOS, shape.dtype)[:, None]
    values, vectors = eigh(root[:, None] * (projected.z.T @ projected.z) * root)
    values, axes = jnp.maximum(values, 0), root[:, None] * vectors
    moment = axes.T @ (projected.z.T @ projected.y)
    shrink = ratio / (1 + ratio * values)
    square = jnp.maximum(projected.y @ projected.y - jnp.sum(shrink * moment**2, 1), jnp.finfo(shape.dtype).tiny)
    evidence = -0.5 * (jnp.sum(jnp.log1p(ratio * values), 1) + projected.degrees * jnp.log(square))
    trace = jnp.sum(values * shrink, 1)
    return _ShapePosterior(evidence, square / projected.degrees, shrink, shrink * moment, axes, trace)


def average_over_priors(projected: ProjectedPresses, shapes: Float[Array, "shapes m"]) -> Posterior:
    """Posterior over all sizes and shapes of the prior; its covariance by the law of total variance."""
    posteriors = jax.lax.map(lambda shape: _shape_posterior(projected, shape), shapes)
    weight = jnp.exp(posteriors.evidence - jnp.max(posteriors.evidence))
    weight = weight / jnp.sum(weight)
    shape_weight = jnp.sum(weight, 1)
    share = weight / jnp.where(shape_weight > 0, shape_weight, 1)[:, None]
    shape_mean = jnp.einsum("sr,srk->sk", share, posteriors.moment)
    deviation = posteriors.moment - shape_mean[:, None]
    within = jnp.einsum("sr,sri,srj->sij", weight, deviation, deviation)
    within = within + jax.vmap(jnp.diag)(jnp.einsum("sr,sr,srk->sk", weight, posteriors.variance, posteriors.shrink))
    means = jnp.einsum("sik,sk->si", posteriors.axes, shape_mean)
    mean = shape_weight @ means
    between = jnp.einsum("s,si,sj->ij", shape_weight, means - mean, means - mean)
    covariance = jnp.einsum("sik,skl,sjl->ij", posteriors.axes, within, posteriors.axes) + between
    return Posterior(
        mean,
        covariance,
        jnp.max(posteriors.evidence),
        jnp.sum(weight * posteriors.variance),
        jnp.sum(weight * posteriors.trace),
    )
