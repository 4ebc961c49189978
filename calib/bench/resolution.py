"""Whether a mesh carries the load of a tip, against an integral on points that are close together about the tip."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxeit as je

from .bench import Bench, BenchError

# Distances from the tip's centre, m, of the points of the integral, and their number; directions at each distance.
NEAREST, FARTHEST, DISTANCES, DIRECTIONS = 1e-6, 1.0, 500, 32
CHECKED_PLACES = 8  # of a bench, evenly among its sites
MAX_ERROR = 0.25  # of the force on the mesh, at half of the places: single places err more where a tip is flat


def require_resolved(bench: Bench, model: je.Model) -> None:
    """Refuse a scene whose loads are so narrow that the elements of the mesh miss them, or count them twice.

    Raises:
        BenchError: says which part of the force arrives.
    """
    sites = bench.sites[np.unique(np.linspace(0, len(bench.sites) - 1, CHECKED_PLACES).astype(int))]
    shares = force_shares(model, bench.scene.skin.domain, sites, bench.tip_diameter)
    if np.median(np.abs(shares - 1)) > MAX_ERROR:
        size = float(np.sqrt(np.median(np.asarray(model.areas))))
        raise BenchError(
            f"{100 * shares.min():.3g} to {100 * shares.max():.3g} % of the force of a tip of {bench.tip_diameter:g} m "
            f"arrives on the mesh, whose elements measure about {size:.2g} m; take a finer fidelity, a larger tip, or "
            "spread the load wider"
        )


def force_shares(
    model: je.Model, domain: je.geometry.Domain, places: Float[np.ndarray, "places 2"], diameter: float
) -> Float[np.ndarray, " places"]:
    """Force that arrives on the elements of the mesh over that which arrives on the sheet, of a tip at each place.

    It is zero for a load so narrow that no point of the integral feels it.

    Args:
        places: of tips, on the sheet, m.
        diameter: of the tip, m.
    """
    distance = np.geomspace(NEAREST, FARTHEST, DISTANCES)
    turn = 2 * np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS  # none along an edge of the sheet
    rays = np.stack([np.cos(turn), np.sin(turn)], -1)
    offset = (distance[:, None, None] * rays).reshape(-1, 2)
    radius, step = np.repeat(distance, DIRECTIONS), np.log(distance[1] / distance[0])
    area = 2 * np.pi / DIRECTIONS * radius**2 * step  # the area of a ring is an integral over the logarithm of r
    inside = np.ones((len(places), len(offset)), bool)
    for row, place, free in zip(inside, places, domain.boundary_distance(places), strict=True):
        far = radius >= free  # nearer points lie on the sheet, as the place does
        row[far] = domain.contains(place + offset[far])
    at, tip, points, areas = (jnp.asarray(given, model.dtype) for given in (places, diameter, offset, area))
    shares = np.asarray(_shares(model, at, tip, points, areas, jnp.asarray(inside)))
    return np.where(np.isfinite(shares), shares, 0.0)


@eqx.filter_jit
def _shares(
    model: je.Model,
    places: Float[Array, "places 2"],
    diameter: Float[Array, ""],
    offset: Float[Array, "points 2"],
    area: Float[Array, " points"],
    inside: Bool[Array, "places points"],
) -> Float[Array, " places"]:
    def share(given: tuple[Array, Array]) -> Array:
        place, on_sheet = given
        arriving = je.model.load_spread(model, place, diameter) @ model.areas
        whole = je.model.load_spread(model, place, diameter, place + offset) @ jnp.where(on_sheet, area, 0)
        return arriving / whole

    found: Array = jax.lax.map(share, (places, inside))
    return found
