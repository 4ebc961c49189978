"""The GREIT figures of merit of the image of a single small contact."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import verb
from .inputs import Pictured, Places, on_pixels
from .place_errors import inward_bias


class GreitFigures(eqx.Module):
    """Figures of merit of the image of a single small contact; see `greit_figures`.

    | meaning                                                        | shape | unit  | best  |
    |----------------------------------------------------------------|-------|-------|-------|
    | amplitude AR: integral of the image                            | (...) | S m^2 | even  |
    | position_error PE: inward shift, negative if outward           | (...) | m     | 0     |
    | resolution RES: square root of A_q / A_sheet                   | (...) |       | small |
    | shape_deformation SD: share of q outside its circle            | (...) |       | 0     |
    | ringing RNG: negative part of the image over the sum over q    | (...) |       | 0     |
    """

    amplitude: Float[Array, "..."]
    position_error: Float[Array, "..."]
    resolution: Float[Array, "..."]
    shape_deformation: Float[Array, "..."]
    ringing: Float[Array, "..."]


def greit_figures(
    image: Float[ArrayLike, "... pixels"],
    recon: Pictured,
    target: Places,
    centre: Float[ArrayLike, "2"] | Sequence[float],
) -> GreitFigures:
    """The GREIT figures of merit; every sum over pixels is weighted by their areas A on the sheet.

    With q = {pixels of at least a quarter of the largest value x}, r_q the centroid of q (each
    pixel weighted by its area alone), and C the circle about r_q that has the area of q:

        AR  = sum(A x)                                  RES = sqrt(A_q / A_sheet)
        PE  = |target - centre| - |r_q - centre|        SD  = A_(q outside C) / A_q
        RNG = -sum(A x over negative x) / sum(A x over q)

    A pixel is in C if its centre is. These are the definitions of EIDORS
    (``eval_GREIT_fig_merit``), with the origin at ``centre``; there AR is divided by its mean over
    targets near the centre when there are more than ten images; here the caller does this.
    The text of the paper sums the ringing outside and inside C in place of q.

    PE is radial: it does not contain an error along the circle about ``centre``. `localisation_error`
    contains both. For contacts that lower the conductivity, change the sign of the image.

    Args:
        image: (..., pixels) S; pixels that miss the sheet are ignored.
        recon: the reconstructor, basis map or picture that the image belongs to.
        target: true position, (..., 2) m.
        centre: of the sheet, (2,) m.

    Returns:
        The figures; all but the amplitude are NaN where the image is nowhere positive, and only there.

    Source: Adler et al. 2009, Physiol. Meas. 30 S35, section 2.2.
    """
    image, dtype = on_pixels(image, recon), recon.areas.dtype
    where = jnp.asarray(target, dtype), jnp.asarray(centre, dtype)
    return _greit_figures(image, recon.centres, recon.areas, *where)


@verb
def _greit_figures(
    image: Float[Array, "... pixels"],
    centres: Float[Array, "pixels 2"],
    areas: Float[Array, " pixels"],
    target: Float[Array, "... 2"],
    centre: Float[Array, "2"],
) -> GreitFigures:
    image = jnp.where(areas > 0, image, 0)
    top = jnp.max(image, -1, keepdims=True)
    seen = top[..., 0] > 0
    lit = jnp.where(image >= top / 4, areas, 0)
    area = lit.sum(-1)
    middle = lit @ centres / area[..., None]
    outside = jnp.sum((centres - middle[..., None, :]) ** 2, -1) >= area[..., None] / jnp.pi
    negative = jnp.minimum(image, 0) @ areas
    positive = jnp.where(seen, jnp.sum(lit * image, -1), 1)
    return GreitFigures(
        amplitude=image @ areas,
        position_error=jnp.where(seen, inward_bias(middle, target, centre), jnp.nan),
        resolution=jnp.where(seen, jnp.sqrt(area / areas.sum()), jnp.nan),
        shape_deformation=jnp.where(seen, jnp.sum(jnp.where(outside, lit, 0), -1) / area, jnp.nan),
        ringing=jnp.where(seen, -negative / positive, jnp.nan),
    )
