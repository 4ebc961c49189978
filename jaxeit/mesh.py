"""Meshes of the sheet: graded around its electrodes, or regular.

A mesh keeps two positions per node: where it is in space, and where it is on the flat sheet (its
*chart*), in which electrodes and pixels are laid out.  `triangulate` makes graded meshes that
follow every electrode's footprint; `structured` makes regular ones that others can rebuild node by
node.  The work is shared out: `triangles` holds and checks a mesh, `footprints` says what it must
follow, `grading` how fine it is where, and `smoothing` makes its triangles good.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from .domain import Domain, Polygon, Rectangle
from .footprints import (
    ArcFootprint,
    DiscFootprint,
    Footprint,
    PointFootprint,
    PolygonFootprint,
    gap,
    polygon_radius,
    reach,
    require_placed,
    rim_gap,
)
from .grading import SizeField, divide_rim, fill, narrow_places, thin
from .smoothing import Problem, missing_edges, relax
from .triangles import Mesh, MeshError, Surface, place

__all__ = [
    "ArcFootprint",
    "DiscFootprint",
    "Footprint",
    "Mesh",
    "MeshError",
    "Pattern",
    "PointFootprint",
    "PolygonFootprint",
    "Surface",
    "polygon_radius",
    "structured",
    "triangulate",
]

MOST_NODES = 2_000_000
"""A mesh that would be larger is taken for a mistake in units."""

MOST_EDGES = 2000
"""Around one polygon; checks of an outline compare all pairs of its sides."""


@dataclass(frozen=True, eq=False)
class _Feature:
    """A point or disc that the mesh follows, as the size field and the overlap tests see it."""

    centre: np.ndarray
    radius: float
    size: float


def triangulate(
    domain: Domain,
    footprints: Sequence[Footprint],
    edge_length: float,
    *,
    growth: float = 1.3,
    electrode_edge: float | None = None,
) -> Mesh:
    """A graded mesh of ``domain`` that follows every footprint; the same input gives the same mesh.

    | meaning                                                          | unit |
    |------------------------------------------------------------------|------|
    | edge_length: of triangles far from electrodes                    | m    |
    | growth: ratio of edge lengths from one layer to the next, above 1 to 2 |  |
    | electrode_edge: edges at points and arc ends; edge_length / 4 if not given | m |

    Edges at a disc or polygon are its circumference / segments; a disc gets twice, four times ... its
    segments where edge_length or the gap to a neighbour is shorter than that.  Near anything narrow
    (gaps, short arcs, thin polygons, waists of the domain) edges shrink to fit.  The rim is followed
    exactly where it is straight, and by chords where it is round.  Nodes: the rim counter-clockwise,
    then the footprints' in their order, then the rest.

    Raises ValueError for footprints that overlap or leave the domain, naming the electrodes by
    their place in ``footprints``, and MeshError if the mesh reached does not pass `Mesh.check`.
    """
    fine = _lengths(domain, edge_length, growth, electrode_edge)
    footprints = list(footprints)
    require_placed(domain, footprints)
    footprints = _subdivided(domain, footprints, edge_length, growth - 1)
    rim = _rim_positions(domain, footprints)
    size = _size_field(domain, footprints, rim, edge_length, growth - 1, fine)
    problem = _problem(domain, footprints, rim, size)
    free = fill(domain, size)
    free = free[problem.open_to(free)]
    points, triangles = relax(problem, thin(free, problem.fixed, 0.72 * size(free)))
    _require_followed(problem, triangles)
    return Mesh(points, triangles).check()


def _require_followed(problem: Problem, triangles: np.ndarray) -> None:
    missing = missing_edges(problem, triangles)
    if len(missing):
        where = problem.fixed[missing[0]].mean(0)
        raise MeshError(
            f"triangulate: the mesh cannot follow the outline at {place(where)}; use a shorter "
            "edge_length there or a smaller growth, or move what is crowded apart"
        )


def _lengths(domain: Domain, edge_length: float, growth: float, edge: float | None) -> float:
    """The edge length at points and arc ends, after looking at all three values."""
    fine = edge_length / 4 if edge is None else edge
    for name, value in {"edge_length": edge_length, "electrode_edge": fine}.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"triangulate: {name} is {value}; give a positive length in metres")
    if not 1 < growth <= 2:
        raise ValueError(f"triangulate: growth is {growth}; give a ratio above 1 and at most 2")
    nodes = domain.area / (np.sqrt(0.75) * edge_length**2)
    if nodes > MOST_NODES:
        raise ValueError(
            f"triangulate: edge_length {edge_length} m makes about {nodes:.1e} nodes, above the "
            f"limit of {MOST_NODES}; is it in metres?"
        )
    return min(fine, edge_length)


def _subdivided(domain: Domain, footprints: list[Footprint], edge_length: float, slope: float) -> list[Footprint]:
    """The footprints, with discs and polygons given more edges where neighbours or edge_length ask for it."""
    out = list(footprints)
    for index, f in enumerate(footprints):
        others = footprints[:index] + footprints[index + 1 :]
        if isinstance(f, DiscFootprint):
            out[index] = _subdivide(domain, f, others, edge_length)
        elif isinstance(f, PolygonFootprint):
            out[index] = _with_nodes(_Among(f.outline.vertices, domain, others), f, edge_length, slope)
    return out


def _subdivide(domain: Domain, disc: DiscFootprint, others: list[Footprint], edge_length: float) -> DiscFootprint:
    room, segments = min([rim_gap(domain, disc), *(gap(disc, f) for f in others)]), disc.segments
    while 2 * np.pi * disc.radius / segments > 1.3 * min(edge_length, room):
        segments *= 2
    return DiscFootprint(disc.position, disc.radius, segments)


@dataclass(frozen=True)
class _Among(Polygon):
    """A polygon whose clearance counts the rim of the domain and the other footprints too."""

    domain: Domain
    others: list[Footprint]

    def clearance(self, s: ArrayLike) -> np.ndarray:
        points = self.boundary_point(s)
        room = [super().clearance(s), self.domain.boundary_distance(points)]
        return np.min(room + [_distance(points, f) for f in self.others], axis=0)


def _distance(points: np.ndarray, footprint: Footprint) -> np.ndarray:
    """Of points (n, 2) outside a footprint from it; (n,) m, infinite for arcs, which are of the rim."""
    if isinstance(footprint, ArcFootprint):
        return np.full(len(points), np.inf)
    if isinstance(footprint, PolygonFootprint):
        return footprint.outline.boundary_distance(points)
    return np.linalg.norm(points - footprint.position, axis=1) - reach(footprint)


def _with_nodes(among: _Among, polygon: PolygonFootprint, edge_length: float, slope: float) -> PolygonFootprint:
    """The polygon with a corner wherever the mesh gets a node."""
    cap = min(edge_length, polygon.outline.perimeter / polygon.segments)
    places, widths = narrow_places(among, cap, slope)
    size = SizeField(places, np.zeros(len(widths)), widths, slope, cap)
    edges = among.perimeter * np.mean(1 / size(among.boundary_point(np.linspace(0, among.perimeter, MOST_EDGES))))
    if edges > MOST_EDGES:
        raise MeshError(
            f"triangulate: the polygon from {place(among.corner_points[0])} needs {edges:.0f} edges around it, above "
            f"the limit of {MOST_EDGES}; use a longer edge_length, or make it wider and move what is near it away"
        )
    s = divide_rim(among, among.corners, size)
    return PolygonFootprint(Polygon(among.boundary_point(s)), len(s))


def _rim_positions(domain: Domain, footprints: list[Footprint]) -> np.ndarray:
    """Arc lengths in [0, perimeter), ascending, where the rim must have a node: corners, arc ends
    and points on the rim; those that coincide are given once."""
    asked = [s for f in footprints if isinstance(f, ArcFootprint) for s in (f.start, f.stop)]
    points = [f.position for f in footprints if isinstance(f, PointFootprint)]
    if points:
        on_rim = domain.boundary_distance(points) <= domain.tolerance
        asked += list(domain.boundary_coordinate(points)[on_rim])
    # Corners come first, so that a coinciding arc end gives way and the corner stays exact.
    s = np.concatenate([domain.corners, np.mod(asked, domain.perimeter)])
    return np.sort(s[_first_of_each(domain.boundary_point(s), domain.tolerance)])


def _first_of_each(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Which points (n, 2) do not coincide with an earlier one; (n,) bool."""
    kept = np.ones(len(points), bool)
    if len(points):
        pairs = cKDTree(points).query_pairs(4 * tolerance, output_type="ndarray")
        kept[pairs.max(1)] = False
    return kept


def _size_field(
    domain: Domain,
    footprints: list[Footprint],
    rim: np.ndarray,
    edge_length: float,
    slope: float,
    fine: float,
) -> SizeField:
    # No edge is longer than a sixteenth of the rim: the coarsest mesh still has a shape.
    cap = min(edge_length, domain.perimeter / 16)
    features = _fitted(_features(domain, footprints, rim, cap, fine), domain)
    features = [f for f in features if f.size < cap]
    places, widths = narrow_places(domain, cap, slope)
    centres = np.array([f.centre for f in features]).reshape(-1, 2)
    return SizeField(
        centres=np.concatenate([centres, places]),
        radii=np.concatenate([[f.radius for f in features], np.zeros(len(widths))]),
        sizes=np.concatenate([[f.size for f in features], widths]),
        slope=slope,
        cap=cap,
    )


def _features(domain: Domain, footprints: list[Footprint], rim: np.ndarray, cap: float, fine: float) -> list[_Feature]:
    """One per disc, point, arc end and fixed node of the rim or a polygon, with the edge length asked there."""
    features = [_Feature(p, 0.0, cap) for p in domain.boundary_point(rim)]
    for f in footprints:
        if isinstance(f, DiscFootprint):
            edge = 2 * np.pi * f.radius / f.segments
            features.append(_Feature(np.asarray(f.position, float), reach(f), min(edge, cap)))
        elif isinstance(f, PointFootprint):
            features.append(_Feature(np.asarray(f.position, float), 0.0, fine))
        elif isinstance(f, PolygonFootprint):
            features += [_Feature(p, 0.0, cap) for p in f.outline.corner_points]
        else:
            # Two edges or more under an arc: the current crowds at its ends.
            size = min(fine, 0.5 * (f.stop - f.start))
            ends = domain.boundary_point([f.start, f.stop])
            features += [_Feature(end, 0.0, size) for end in ends]
    return features


def _fitted(features: list[_Feature], domain: Domain) -> list[_Feature]:
    """The features with sizes no larger than the gaps to their neighbours."""
    if not features:
        return features
    centres = np.array([f.centre for f in features])
    radii = np.array([f.radius for f in features])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2) - radii - radii[:, None]
    gaps[gaps <= 4 * domain.tolerance] = np.inf  # itself, or the same place named twice
    rim = domain.boundary_distance(centres) - radii
    rim[rim <= 4 * domain.tolerance] = np.inf
    room = np.minimum(gaps.min(1), rim)
    return [_Feature(f.centre, f.radius, min(f.size, r)) for f, r in zip(features, room.tolist(), strict=True)]


def _problem(domain: Domain, footprints: list[Footprint], rim: np.ndarray, size: SizeField) -> Problem:
    """Fixed nodes and the edges between them: the rim, then each footprint's own."""
    around = domain.boundary_point(divide_rim(domain, rim, size))
    own = [_own_nodes(domain, f) for f in footprints]
    first = len(around) + np.cumsum([0, *map(len, own)])
    closed = DiscFootprint | PolygonFootprint
    rings = [_cycle(k, f.segments) for k, f in zip(first, footprints, strict=False) if isinstance(f, closed)]
    return Problem(
        domain=domain,
        size=size,
        fixed=np.concatenate([around, *own]),
        rim=_cycle(0, len(around)),
        rings=np.concatenate([np.zeros((0, 2), int), *rings]),
        open_to=partial(_open_to, domain, [f for f in footprints if isinstance(f, DiscFootprint)], size),
    )


def _cycle(first: int, count: int) -> np.ndarray:
    """Edges (count, 2) of a closed ring of consecutive nodes."""
    around = np.arange(count)
    return first + np.stack([around, (around + 1) % count], axis=1)


def _own_nodes(domain: Domain, footprint: Footprint) -> np.ndarray:
    """Nodes (k, 2) a footprint adds to those of the rim; a disc's outermost ring comes first."""
    if isinstance(footprint, DiscFootprint):
        return _disc_nodes(footprint)
    if isinstance(footprint, PolygonFootprint):
        return footprint.outline.corner_points
    if isinstance(footprint, ArcFootprint):
        return np.zeros((0, 2))
    position = np.asarray([footprint.position], float)
    return position[domain.boundary_distance(position) > domain.tolerance]


def _disc_nodes(disc: DiscFootprint) -> np.ndarray:
    """Rings from the polygon inward, each with half the nodes of the one around it, and a hub."""
    count, radius, rings = disc.segments, reach(disc), []
    while True:
        angle = 2 * np.pi * np.arange(count) / count
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        if count <= 8 or count % 2:
            break
        # A gap as wide as the ring's own edge balances the two kinds of triangle.
        radius, count = radius * (1 - 2.0 * np.sin(np.pi / count)), count // 2
    return np.asarray(disc.position) + np.concatenate([*rings, np.zeros((1, 2))])


def _open_to(domain: Domain, discs: list[DiscFootprint], size: SizeField, points: np.ndarray) -> np.ndarray:
    """Whether a free node may be put at each of points: inside, off the rim and off the discs."""
    wanted = size(points)
    allowed = domain.contains(points) & (domain.boundary_distance(points) > 0.45 * wanted)
    for disc in discs:
        away = np.linalg.norm(points - disc.position, axis=1) - reach(disc)
        allowed &= away > 0.4 * wanted
    return allowed


# Regular meshes.


class Pattern(Enum):
    """How the cells of a structured mesh are cut.

    RISING: by the diagonal from lower left to upper right.
    ALTERNATING: by either diagonal in turn (union jack); mirror-symmetric for even nx and ny.
    CROSSED: by both, with a node at the middle of each cell; has all symmetries of the rectangle.
    """

    RISING = "rising"
    ALTERNATING = "alternating"
    CROSSED = "crossed"


def structured(rectangle: Rectangle, nx: int, ny: int, *, pattern: Pattern = Pattern.ALTERNATING) -> Mesh:
    """A regular mesh of nx by ny cells.

    Node ``j (nx + 1) + i`` is at column i of row j (rows upward, y outer, x inner); for
    Pattern.CROSSED the middles of the cells follow, in the same order.  Raises ValueError unless nx
    and ny are whole and positive.
    """
    _require_counts(nx, ny)
    x, y = np.linspace(0, rectangle.width, nx + 1), np.linspace(0, rectangle.height, ny + 1)
    corners = _grid(x, y)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny)))
    a = j * (nx + 1) + i
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    if pattern is Pattern.CROSSED:
        middles = _grid(0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1]))
        hub = len(corners) + np.arange(nx * ny)
        return Mesh(np.concatenate([corners, middles]), _fans(hub, (a, b, c, d)))
    rising = (i + j) % 2 == 0 if pattern is Pattern.ALTERNATING else np.ones(nx * ny, bool)
    first = np.where(rising, (a, b, c), (a, b, d))
    second = np.where(rising, (a, c, d), (b, c, d))
    return Mesh(corners, np.stack([first.T, second.T], axis=1).reshape(-1, 3))


def _require_counts(nx: int, ny: int) -> None:
    for name, value in {"nx": nx, "ny": ny}.items():
        if value != int(value) or value < 1:
            raise ValueError(f"structured: {name} is {value}; give a whole number of cells, 1 or more")


def _grid(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _fans(hub: np.ndarray, ring: tuple[np.ndarray, ...]) -> np.ndarray:
    """Four triangles from each cell's middle to its sides, cell by cell."""
    fans = [np.stack([hub, ring[k], ring[(k + 1) % 4]], axis=1) for k in range(4)]
    return np.stack(fans, axis=1).reshape(-1, 3)
