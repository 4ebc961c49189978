"""Fit of a field to the log ratios of true force over the force of the curves, robust and with its covariance.

The coefficients beta of `base` have a normal prior, beta ~ N(0, noise^2 diag(d)). Its size, and the length of a
Gaussian process, are averaged over rather than chosen; see `evidence`. A field that the presses do not support is
thereby shrunk to zero, and the uncertainty of the prior is part of the variance.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...presses.pooled import MIN_SHARE
from ...presses.streams import MAD_TO_SIGMA
from ..results import FitResult
from .base import AbstractField
from .evidence import Posterior, ProjectedPresses, average_over_priors, project_out_levels
from .fitted import FittedField, pad_features
from .geometry import Geometry, onto_pads, relative_to_pads
from .places import Places

# Distance from the field, in standard deviations, beyond which a press loses weight (Huber's weights): 1 % of normal
# noise lies beyond.
HUBER_WIDTH = 2.5
# Number of iteratively reweighted fits; the first has weights of one.
ITERATIONS = 3


def _supported_box(
    field: AbstractField,
    geometry: Geometry,
    places: Places,
    share: Float[Array, "n pads"],
    reach: Float[Array, "2 2"],
) -> Float[Array, "pads 2 2"]:
    """Lowest and highest corner (m) of the box of each pad, within `reach`, in which presses determine the field.

    Only presses count of which the pad carried at least `MIN_SHARE`. A press beside a pad loads the pad a little, at
    its edge, but says little about the gain there: a field free to bend there would fit the other errors of that press.
    Pads that share a field share its support.
    """
    place = relative_to_pads(geometry, onto_pads(geometry, places.position))
    valid = jnp.isfinite(place) & (places.weight > 0)[..., None] & (share >= MIN_SHARE)[:, None, :, None]
    over = (0, 1, 2) if field.shared else (0, 1)
    low, high = jnp.min(jnp.where(valid, place, jnp.inf), over), jnp.max(jnp.where(valid, place, -jnp.inf), over)
    none = low > high
    low, high = field.supported(jnp.where(none, -1, low), jnp.where(none, 1, high))
    corner, far = geometry.start.min(1), geometry.start.max(1)
    box = (corner[:, None] + far[:, None] + (far - corner)[:, None] * jnp.stack([low, high], -2)) / 2
    return jnp.stack([jnp.maximum(box[:, 0], reach[0]), jnp.minimum(box[:, 1], reach[1])], 1)


def _centred_features(
    features: Float[Array, "n pads m"], share: Float[Array, "n pads"], weight: Float[Array, " n"]
) -> tuple[Float[Array, "n m"], Float[Array, "pads m"]]:
    """Features of the presses, relative to the mean of each pad and summed by the pads' shares; and those means.

    A feature that is not known (NaN) counts as the mean of its pad.
    """
    loads = share * weight[:, None]
    known = jnp.isfinite(features)
    load_known = jnp.einsum("np,npm->pm", loads, known.astype(loads.dtype))
    features = jnp.where(known, features, 0)
    centre = jnp.einsum("np,npm->pm", loads, features) / jnp.where(load_known > 0, load_known, 1)
    features = jnp.where(known, features, centre)
    return jnp.einsum("np,npm->nm", share, features - centre), centre


def _huber_weights(
    projected: ProjectedPresses, coefficients: Float[Array, " m"], valid: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Huber's weights: 1 for presses within `HUBER_WIDTH` of the field, falling as 1 / distance beyond."""
    residual = jnp.abs(projected.y - projected.z @ coefficients)
    deviation = MAD_TO_SIGMA * jnp.nanmedian(jnp.where(valid & (residual > 0), residual, jnp.nan))
    width = HUBER_WIDTH * jnp.where(deviation > 0, deviation, jnp.inf)
    return jnp.minimum(1.0, width / jnp.maximum(residual, jnp.finfo(residual.dtype).tiny))


def _robust_posterior(
    z: Float[Array, "n m"],
    y: Float[Array, " n"],
    share: Float[Array, "n pads"],
    weight: Float[Array, " n"],
    shapes: Float[Array, "shapes m"],
) -> tuple[Posterior, Float[Array, ""], Float[Array, ""]]:
    """Posterior of the coefficients; weighted sum of squares of y without the levels; its degrees of freedom."""

    def reweight(huber: Array, _: None) -> tuple[Array, tuple[Posterior, Array, Array]]:
        projected = project_out_levels(z, y, share, weight * huber)
        found = average_over_priors(projected, shapes)
        # Outliers are judged by the distance of the whole press, not by the part that weights of a shared place leave.
        plain = project_out_levels(z, y, share, (weight > 0).astype(z.dtype))
        huber = _huber_weights(plain, found.coefficients, weight > 0)
        return huber, (found, jnp.sum(projected.y**2), projected.degrees)

    _, iterations = jax.lax.scan(reweight, jnp.ones_like(y), None, length=ITERATIONS)
    found, square, degrees = jax.tree.map(lambda leaf: leaf[-1], iterations)
    return found, square, degrees


def _valid_presses(
    places: Places, log_ratio: Float[Array, " n"], share: Float[Array, "n pads"], weight: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, "n pads"], Float[Array, " n"]]:
    """Log ratios, shares and weights, without the presses that are not finite or whose place is not known."""
    finite = jnp.isfinite(log_ratio) & jnp.all(jnp.isfinite(share), -1)
    known = jnp.all(places.known | (share <= 0), -1)
    weight = jnp.where(finite & known, weight, 0)
    return jnp.where(weight > 0, log_ratio, 0), jnp.where(finite[:, None], share, 0), weight


def fit_field(
    field: AbstractField,
    geometry: Geometry,
    places: Places,
    log_ratio: Float[Array, " n"],
    share: Float[Array, "n pads"],
    weight: Float[Array, " n"],
    reach: Float[Array, "2 2"],
) -> FittedField:
    """Fit a field of gain to presses: fixed shapes, works under jit and vmap, never raises.

    Args:
      places: of the presses, from their images.
      log_ratio: log of true force over the sum of the pads' curves at each press.
      share: share of each pad in that sum; rows sum to one.
      weight: of each press; 0 leaves it out. k presses at one place have 1 / k each, because they share the error of
        the place.
      reach: lowest and highest corner of the box of all presses, m.

    Example:
        import jax.numpy as jnp

        import jaxeit as je

        skin = je.load_skin("testbed")
        lines = np.linspace(0.01, 0.19, 8)
        sites = np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)  # m, one press at each
        share = np.eye(4)[2 * (sites[:, 1] > 0.1) + (sites[:, 0] > 0.1)]  # each press on one pad
        distance = np.minimum(sites % 0.1, 0.1 - sites % 0.1).min(1)  # m, to the walls of its pad
        dip = jnp.asarray(-0.4 * np.exp(-distance / 0.01))  # log of true force over that of the curve
        presses = fitting.single_places(sites, pads=4)
        reach = jnp.array([[0.01, 0.01], [0.19, 0.19]])  # m
        for field in (fitting.Constant(), calib.PadEdge(), fitting.Bilinear()):
            found = fitting.fit_field(
                field, fitting.geometry_of(skin), presses, dip, jnp.asarray(share), jnp.ones(64), reach
            )
            print(f"{fitting.FIELDS.text(field)}: scatter {found.noise:.3f} of {found.spread:.3f}")
    """
    y, share, weight = _valid_presses(places, log_ratio, share, weight)
    reach = _supported_box(field, geometry, places, jnp.where(weight[:, None] > 0, share, 0), reach)
    z, centre = _centred_features(pad_features(field, geometry, places, reach), share, weight)
    shapes = jnp.asarray(np.tile(field.shapes(), (1, 1 if field.shared else geometry.pads)), z.dtype)
    found, square, degrees = _robust_posterior(z, y, share, weight, shapes)
    n = jnp.sum(weight)
    enough = n >= 2 + jnp.sum(jnp.sum(share * weight[:, None], 0) > 0, dtype=n.dtype)
    finite = jnp.all(jnp.isfinite(found.coefficients)) & jnp.all(jnp.isfinite(found.covariance))
    result = jnp.select([~enough, ~finite], [FitResult.TOO_FEW, FitResult.NOT_FINITE], FitResult.SUCCESS)
    good = result == FitResult.SUCCESS
    return FittedField(
        field=field,
        geometry=geometry,
        coefficients=jnp.where(good, found.coefficients, 0),
        covariance=jnp.where(good, found.covariance, 0),
        reach=reach,
        centre=centre,
        noise=jnp.sqrt(found.variance),
        spread=jnp.sqrt(square / degrees),
        evidence=found.evidence + 0.5 * degrees * jnp.log(jnp.maximum(square, jnp.finfo(square.dtype).tiny)),
        effective=jnp.where(good, found.effective, 0),
        n=n,
        result=result,
        error_scale=jnp.ones_like(found.variance),
    )
