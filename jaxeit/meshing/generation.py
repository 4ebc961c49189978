"""Meshes of the sheet: graded around its electrodes, or regular.

A mesh keeps two positions per node: in space, and on the flat sheet (its *chart*), in which electrodes
and pixels are laid out.  `triangulate` makes graded meshes that
follow every electrode's footprint; `structured` makes regular ones that other programs can
rebuild node by node.  The module `triangles` holds and checks a mesh, `footprints` and `outlines` state the
constraints of electrodes, `sizes` states the wanted edge lengths, and `smoothing` raises the triangles' angles.
"""

from collections.abc import Sequence
from enum import Enum
from functools import partial, reduce

import numpy as np
from scipy.spatial import cKDTree

from ..budget import require
from ..geometry.shapes import Domain, Rectangle
from .footprints import AbstractFootprint, Feature, cycle, neighbours, require_placed
from .sizes import SizeField, divide_rim, fill, narrow_places, thin
from .smoothing import SmoothingConstraints, Triangulation, better, missing_edges, relax
from .triangles import CROWDED, MIN_ANGLE, Mesh, MeshError, place

START_SPACINGS = (0.72, 0.69, 0.75, 0.66, 0.78)
"""Least distance between the initial nodes, over the wanted edge length; the next is tried where one leads to a mesh
that `Mesh.check` refuses."""

RIM_SPACING = 0.45
"""Least distance of free nodes from the rim, over the wanted edge length."""


def triangulate(
    domain: Domain,
    footprints: Sequence[AbstractFootprint],
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
    segments where edge_length or the gap to a neighbour is shorter than that.  In narrow
    places (gaps, short arcs, thin polygons, waists of the domain) edges shrink to fit.  The rim is followed
    exactly where it is straight, and by chords where it is round.  Nodes: the rim counter-clockwise,
    then the footprints' in their order, then the rest.

    Raises ValueError for footprints that overlap or leave the domain, naming the electrodes by
    their place in ``footprints``, and MeshError if the resulting mesh does not pass `Mesh.check`.
    """
    fine = _lengths(domain, edge_length, growth, electrode_edge)
    nodes = expected_nodes(domain, footprints, edge_length, growth, fine)
    require("mesh_nodes", nodes, f"triangulate: edge_length {edge_length:.3g} m")
    require_placed(domain, footprints)
    footprints = [
        footprint.subdivided(domain, near, edge_length, growth - 1)
        for footprint, near in zip(footprints, neighbours(footprints, edge_length), strict=True)
    ]
    rim = _rim_positions(domain, footprints)
    size = _size_field(domain, footprints, rim, edge_length, growth - 1, fine)
    problem = _problem(domain, footprints, rim, size)
    free = fill(domain, size)
    free = free[problem.open_to(free)]
    _, points, triangles = _relaxed(problem, free)
    _require_followed(problem, triangles)
    return Mesh(points, triangles).check(advice=CROWDED)


def _relaxed(problem: SmoothingConstraints, free: np.ndarray) -> Triangulation:
    """The first triangulation that is good enough, or the best one; free: places for nodes, (n, 2) m."""
    size, found = problem.size(free), []
    for spacing in START_SPACINGS:
        found.append(relax(problem, thin(free, problem.fixed, spacing * size)))
        if found[-1].angle >= MIN_ANGLE:
            break
    return reduce(better, found)


def expected_nodes(
    domain: Domain,
    footprints: Sequence[AbstractFootprint],
    edge_length: float,
    growth: float,
    electrode_edge: float | None = None,
) -> float:
    """Estimated number of nodes of `triangulate`, within 20 % where electrodes are spread over the domain.

    The integral of the nodes per area, ``1 / (sqrt(3)/2 h^2)``, over the sheet. Around a feature of radius r the edges
    grow as ``h = s + k d`` with the distance d, as far as the next feature. No edge is longer than the sheet is wide.
    """
    width = 2 * domain.area / domain.perimeter
    longest, slope = min(edge_length, domain.perimeter / 16, width), growth - 1
    shortest = edge_length / 4 if electrode_edge is None else electrode_edge
    own = sum(len(footprint.nodes(domain)) for footprint in footprints)
    features = [feature for footprint in footprints for feature in footprint.features(domain, longest, shortest)]
    radius = np.array([feature.radius for feature in features])
    size = np.minimum([feature.size for feature in features], longest)
    room = np.maximum(np.sqrt(domain.area / (np.pi * max(1, len(features)))) - radius, 0)
    away = np.minimum((longest - size) / slope, room)
    end = size + slope * away
    graded = ((radius - size / slope) * (1 / size - 1 / end) + np.log(end / size) / slope) / slope
    even = (radius * away + away**2 / 2) / longest**2
    return float(own + (domain.area / longest**2 + 2 * np.pi * (graded - even).sum()) / np.sqrt(0.75))


def _require_followed(problem: SmoothingConstraints, triangles: np.ndarray) -> None:
    missing = missing_edges(problem, triangles)
    if len(missing):
        where = problem.fixed[missing[0]].mean(0)
        raise MeshError(
            f"triangulate: the mesh cannot follow the outline at {place(where)}; use a shorter "
            "edge_length there or a smaller growth, or move what is crowded apart"
        )


def _lengths(domain: Domain, edge_length: float, growth: float, edge: float | None) -> float:
    """The edge length at points and arc ends, m; raises ValueError for a value out of range."""
    fine = edge_length / 4 if edge is None else edge
    for name, value in {"edge_length": edge_length, "electrode_edge": fine}.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"triangulate: {name} is {value}; give a positive length in metres")
    if not 1 < growth <= 2:
        raise ValueError(f"triangulate: growth is {growth}; give a ratio above 1 and at most 2")
    return min(fine, edge_length)


def _rim_positions(domain: Domain, footprints: list[AbstractFootprint]) -> np.ndarray:
    """Arc lengths in [0, perimeter), ascending, where the rim must have a node: corners, arc ends
    and points on the rim; those that coincide are given once."""
    asked = [s for footprint in footprints for s in footprint.rim_positions(domain)]
    # Corners come first, so that of a corner and an arc end that coincide the exact corner is kept.
    s = np.concatenate([domain.corners, np.mod(asked, domain.perimeter)])
    return np.sort(s[_first_of_each(domain.boundary_point(s), domain.tolerance)])


def _first_of_each(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether each of points (n, 2) coincides with no earlier one; (n,) bool."""
    kept = np.ones(len(points), bool)
    if len(points):
        pairs = cKDTree(points).query_pairs(4 * tolerance, output_type="ndarray")
        kept[pairs.max(1)] = False
    return kept


def _size_field(
    domain: Domain,
    footprints: list[AbstractFootprint],
    rim: np.ndarray,
    edge_length: float,
    slope: float,
    fine: float,
) -> SizeField:
    # No edge is longer than a sixteenth of the rim, so that the coarsest mesh still follows a round rim.
    cap = min(edge_length, domain.perimeter / 16)
    features = [Feature(node, 0.0, cap) for node in domain.boundary_point(rim)]
    features += [feature for footprint in footprints for feature in footprint.features(domain, cap, fine)]
    features = [feature for feature in _fitted(features, domain) if feature.size < cap]
    places, widths = narrow_places(domain, cap, slope)
    centres = np.array([f.centre for f in features]).reshape(-1, 2)
    return SizeField(
        centres=np.concatenate([centres, places]),
        radii=np.concatenate([[f.radius for f in features], np.zeros(len(widths))]),
        sizes=np.concatenate([[f.size for f in features], widths]),
        slope=slope,
        cap=cap,
    )


def _fitted(features: list[Feature], domain: Domain) -> list[Feature]:
    """The features with sizes no larger than the gaps to their neighbours."""
    if not features:
        return features
    centres = np.array([f.centre for f in features])
    radii = np.array([f.radius for f in features])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2) - radii - radii[:, None]
    gaps[gaps <= 4 * domain.tolerance] = np.inf  # a feature itself, or another one at the same place
    rim = domain.boundary_distance(centres) - radii
    rim[rim <= 4 * domain.tolerance] = np.inf
    room = np.minimum(gaps.min(1), rim)
    return [Feature(f.centre, f.radius, min(f.size, r)) for f, r in zip(features, room.tolist(), strict=True)]


def _problem(
    domain: Domain, footprints: list[AbstractFootprint], rim: np.ndarray, size: SizeField
) -> SmoothingConstraints:
    """Fixed nodes and the edges between them: those of the rim, then those of each footprint."""
    around = domain.boundary_point(divide_rim(domain, rim, size))
    own = [footprint.nodes(domain) for footprint in footprints]
    first = len(around) + np.cumsum([0, *map(len, own)])
    rings = [start + footprint.edges() for start, footprint in zip(first, footprints, strict=False)]
    return SmoothingConstraints(
        domain=domain,
        size=size,
        fixed=np.concatenate([around, *own]),
        rim=cycle(len(around)),
        rings=np.concatenate([np.zeros((0, 2), int), *rings]),
        open_to=partial(_is_open, domain, footprints, size),
    )


def _is_open(domain: Domain, footprints: list[AbstractFootprint], size: SizeField, points: np.ndarray) -> np.ndarray:
    """Whether a free node may start at each of points: inside, away from the rim and from the outlines; (n,) bool."""
    wanted = size(points)
    allowed = domain.contains(points) & (domain.boundary_distance(points) > RIM_SPACING * wanted)
    for footprint in footprints:
        allowed &= footprint.leaves_room(points, wanted)
    return allowed


# Regular meshes.


class TrianglePattern(Enum):
    """How the cells of a structured mesh are divided into triangles.

    RISING: by the diagonal from lower left to upper right.
    ALTERNATING: by either diagonal in turn (union jack); mirror-symmetric for even nx and ny.
    CROSSED: by both diagonals, with a node at the middle of each cell; has all symmetries of the rectangle.
    """

    RISING = "rising"
    ALTERNATING = "alternating"
    CROSSED = "crossed"


def structured(
    rectangle: Rectangle, nx: int, ny: int, *, pattern: TrianglePattern = TrianglePattern.ALTERNATING
) -> Mesh:
    """A regular mesh of nx by ny cells.

    Node ``j (nx + 1) + i`` is at column i of row j (rows upward, y outer, x inner); for
    TrianglePattern.CROSSED the middles of the cells follow, in the same order.  Raises ValueError unless nx
    and ny are whole and positive.
    """
    _require_counts(nx, ny)
    x, y = np.linspace(0, rectangle.width, nx + 1), np.linspace(0, rectangle.height, ny + 1)
    corners = _grid(x, y)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny)))
    a = j * (nx + 1) + i
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    if pattern is TrianglePattern.CROSSED:
        middles = _grid(0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1]))
        hub = len(corners) + np.arange(nx * ny)
        return Mesh(np.concatenate([corners, middles]), _fans(hub, (a, b, c, d)))
    rising = (i + j) % 2 == 0 if pattern is TrianglePattern.ALTERNATING else np.ones(nx * ny, bool)
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
