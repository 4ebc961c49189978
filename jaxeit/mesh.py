"""Triangle meshes of the sheet, flat or lifted onto a surface, graded around its electrodes.

A mesh keeps two positions per node: where it is in space, and where it is on the flat sheet (its
*chart*), in which electrodes and pixels are laid out.  `triangulate` makes graded meshes that follow
every electrode's footprint; `structured` makes regular ones that others can rebuild node by node.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .domain import Domain, Rectangle
from .grading import SizeField, divide_rim, fill, narrow_places, thin
from .smoothing import Problem, corner_angles, directed_edges, doubled_areas, edge_keys, relax

Surface = Callable[[np.ndarray], np.ndarray]

MOST_NODES = 2_000_000


class MeshError(ValueError):
    """A mesh that cannot be built, or that would give wrong answers."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the plane or on a surface in space.  Arrays are copied and made read-only.

    | meaning                                            | shape       | unit |
    |----------------------------------------------------|-------------|------|
    | nodes: positions in space, float64                 | (n, 2 or 3) | m    |
    | triangles: node numbers, int32, counter-clockwise in the chart | (m, 3) |  |
    | chart: positions on the flat sheet; nodes if not given and nodes are plane | (n, 2) | m |

    Raises MeshError for wrong shapes; `check` looks at the values.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    chart: np.ndarray = None  # type: ignore[assignment]  # filled in below, never None afterwards

    def __post_init__(self):
        chart = self.nodes if self.chart is None else self.chart
        _set(self, "nodes", _array("nodes", self.nodes, np.float64, (2, 3)))
        _set(self, "triangles", _array("triangles", self.triangles, np.int32, (3,)))
        _set(self, "chart", _array("chart", chart, np.float64, (2,)))
        if len(self.chart) != len(self.nodes):
            raise MeshError(
                f"mesh: {len(self.nodes)} nodes but {len(self.chart)} chart positions; give each "
                "node one"
            )

    @cached_property
    def areas(self) -> np.ndarray:
        """Areas of the triangles on the surface, (m,) m^2."""
        corners = self.nodes[self.triangles]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        gram = (u * u).sum(1) * (v * v).sum(1) - (u * v).sum(1) ** 2
        return 0.5 * np.sqrt(np.maximum(gram, 0.0))

    @property
    def centroids(self) -> np.ndarray:
        """Centroids of the triangles in space, (m, 2 or 3) m."""
        return self.nodes[self.triangles].mean(1)

    @property
    def chart_centroids(self) -> np.ndarray:
        """Centroids of the triangles on the flat sheet, (m, 2) m."""
        return self.chart[self.triangles].mean(1)

    @cached_property
    def edges(self) -> np.ndarray:
        """Every edge once, lower node first, in ascending order; (e, 2) int32."""
        return np.unique(np.sort(directed_edges(self.triangles), axis=1), axis=0).astype(np.int32)

    @cached_property
    def boundary_edges(self) -> np.ndarray:
        """Edges of exactly one triangle, with the sheet on their left; (b, 2) int32."""
        directed = directed_edges(self.triangles)
        alone = ~np.isin(edge_keys(directed), edge_keys(directed[:, ::-1]))
        return directed[alone].astype(np.int32)

    @property
    def min_angles(self) -> np.ndarray:
        """Smallest angle of each triangle on the surface, (m,) degrees."""
        return corner_angles(self.nodes[self.triangles]).min(1)

    def check(self, min_angle: float = 20.0) -> "Mesh":
        """This mesh, or MeshError naming its worst fault, where it is, and what to do.

        Looks for values that are not finite, indices out of range, nodes that coincide or belong to
        no triangle, flipped triangles, edges of more than two triangles, separate pieces, and angles
        below ``min_angle`` degrees.
        """
        _require_finite(self)
        _require_indices(self)
        _require_distinct_nodes(self)
        _require_orientation(self)
        _require_manifold(self)
        _require_connected(self)
        _require_angles(self, min_angle)
        return self

    def lift(self, surface: Surface) -> "Mesh":
        """The same triangles on a curved sheet: ``surface`` maps chart (n, 2) m to space (n, 3) m."""
        return Mesh(_on_surface(surface, self.chart), self.triangles, self.chart)

    def refine(self, surface: Surface | None = None) -> "Mesh":
        """Every triangle cut into four at the middles of its edges; old nodes keep their numbers.

        New nodes are at the middle of their edge, in space and on the chart; with ``surface``, as in
        `lift`, they are put on the curved sheet instead.
        """
        chart = self.chart[self.edges].mean(1)
        nodes = _on_surface(surface, chart) if surface else self.nodes[self.edges].mean(1)
        return Mesh(
            np.concatenate([self.nodes, nodes]),
            _quartered(self),
            np.concatenate([self.chart, chart]),
        )


def _set(mesh: Mesh, name: str, value: np.ndarray) -> None:
    value.setflags(write=False)
    object.__setattr__(mesh, name, value)


def _array(name: str, value, dtype: type, columns: tuple[int, ...]) -> np.ndarray:
    array = np.array(value)
    if array.ndim != 2 or array.shape[1] not in columns or not len(array):
        wanted = " or ".join(f"(n, {c})" for c in columns)
        raise MeshError(f"mesh: {name} has shape {array.shape}; give an array of shape {wanted}")
    if dtype is np.int32 and not np.issubdtype(array.dtype, np.integer):
        raise MeshError(f"mesh: {name} are {array.dtype}; give whole node numbers")
    return array.astype(dtype)


def _on_surface(surface: Surface, chart: np.ndarray) -> np.ndarray:
    nodes = np.asarray(surface(chart), float)
    if nodes.shape != (len(chart), 3):
        raise MeshError(
            f"mesh: the surface returned shape {nodes.shape} for {len(chart)} points; "
            f"it must map (n, 2) to (n, 3)"
        )
    return nodes


def _quartered(mesh: Mesh) -> np.ndarray:
    """Triangles (4 m, 3) of the refined mesh; edge k carries node n + k."""
    keys = edge_keys(mesh.edges)
    sides = np.sort(directed_edges(mesh.triangles), axis=1)
    middle = len(mesh.nodes) + np.searchsorted(keys, edge_keys(sides)).reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = mesh.triangles.T, middle.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


# What `check` looks for, in the order in which one fault would hide the next.


def _place(position: np.ndarray) -> str:
    return "(" + ", ".join(f"{1e3 * x:.2f}" for x in position) + ") mm"


def _require_finite(mesh: Mesh) -> None:
    bad = ~(np.isfinite(mesh.nodes).all(1) & np.isfinite(mesh.chart).all(1))
    if bad.any():
        node = int(np.flatnonzero(bad)[0])
        raise MeshError(
            f"mesh: node {node} is at {mesh.nodes[node]} m; {int(bad.sum())} of {len(bad)} nodes "
            "are not finite: correct the coordinates or the surface they are lifted onto"
        )


def _require_indices(mesh: Mesh) -> None:
    count = len(mesh.nodes)
    bad = ((mesh.triangles < 0) | (mesh.triangles >= count)).any(1)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise MeshError(
            f"mesh: triangle {row} has nodes {mesh.triangles[row].tolist()}, but they run from 0 "
            f"to {count - 1}; correct the indices (files that count from 1 need 1 subtracted)"
        )
    unused = np.bincount(mesh.triangles.ravel(), minlength=count) == 0
    if unused.any():
        node = int(np.flatnonzero(unused)[0])
        raise MeshError(
            f"mesh: node {node} at {_place(mesh.nodes[node])} belongs to no triangle "
            f"({int(unused.sum())} such nodes); remove them, or the system is singular"
        )


def _require_distinct_nodes(mesh: Mesh) -> None:
    nearest = 1e-9 * float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
    pairs = cKDTree(mesh.nodes).query_pairs(nearest, output_type="ndarray")
    if len(pairs):
        a, b = (int(i) for i in pairs[np.lexsort(pairs.T[::-1])[0]])
        raise MeshError(
            f"mesh: nodes {a} and {b} are both at {_place(mesh.nodes[a])} ({len(pairs)} such "
            "pairs); merge them, or the sheet is torn there"
        )


def _require_orientation(mesh: Mesh) -> None:
    doubled = doubled_areas(mesh.chart[mesh.triangles])
    worst = int(np.argmin(doubled))
    if doubled[worst] <= 0:
        raise MeshError(
            f"mesh: triangle {worst} at {_place(mesh.centroids[worst])} has area "
            f"{0.5e6 * doubled[worst]:.3g} mm^2 in the chart ({int((doubled <= 0).sum())} such "
            "triangles); list its nodes counter-clockwise, remove it if it is flat"
        )


def _require_manifold(mesh: Mesh) -> None:
    directed = directed_edges(mesh.triangles)
    keys, first, count = np.unique(edge_keys(directed), return_index=True, return_counts=True)
    if np.any(count > 1):
        edge = directed[first[np.argmax(count > 1)]]
        raise MeshError(
            f"mesh: the edge between nodes {edge[0]} and {edge[1]} at "
            f"{_place(mesh.nodes[edge].mean(0))} belongs to two triangles on the same side; remove "
            "overlapping triangles"
        )
    starts = np.bincount(mesh.boundary_edges[:, 0], minlength=len(mesh.nodes))
    if starts.max() > 1:
        node = int(np.argmax(starts))
        raise MeshError(
            f"mesh: parts of the sheet meet only in node {node} at {_place(mesh.nodes[node])}; "
            "join them along an edge or mesh them apart"
        )


def _require_connected(mesh: Mesh) -> None:
    start, stop = mesh.edges.T
    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(len(mesh.nodes),) * 2)
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        node = int(np.argmin(np.bincount(label)[label]))
        raise MeshError(
            f"mesh: {pieces} separate pieces; the smallest holds node {node} at "
            f"{_place(mesh.nodes[node])}; keep the piece with the electrodes or join them"
        )


def _require_angles(mesh: Mesh, min_angle: float) -> None:
    angles = mesh.min_angles
    worst = int(np.argmin(angles))
    if not angles[worst] >= min_angle:
        raise MeshError(
            f"mesh: triangle {worst} at {_place(mesh.centroids[worst])} has an angle of "
            f"{angles[worst]:.1f} degrees ({int((angles < min_angle).sum())} triangles are below "
            f"{min_angle:g}); use a shorter edge_length or more segments there, or move what is "
            "crowded apart"
        )


# Footprints: what a mesh must follow.


@dataclass(frozen=True)
class PointFootprint:
    """A node exactly at ``position``, (2,) m."""

    position: tuple[float, float]

    def __post_init__(self):
        _require_position("PointFootprint", self.position)


@dataclass(frozen=True)
class DiscFootprint:
    """A regular polygon of the disc's exact area, filled with triangles, and a node at its centre.

    | meaning                                             | shape | unit |
    |-----------------------------------------------------|-------|------|
    | position of the centre                              | (2,)  | m    |
    | radius of the disc, not of the polygon              | ()    | m    |
    | segments: least number of sides; 6 to 12 times a power of two | () | |

    Raises ValueError for other values.
    """

    position: tuple[float, float]
    radius: float
    segments: int = 16

    def __post_init__(self):
        _require_position("DiscFootprint", self.position)
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(
                f"DiscFootprint: radius is {self.radius}; give a positive length in metres"
            )
        if not _halves_to_a_hub(self.segments):
            raise ValueError(
                f"DiscFootprint: segments is {self.segments}; give 6 to 12 times a power of two, "
                "such as 12, 16, 24 or 32, so that the rings inside can halve their nodes"
            )


@dataclass(frozen=True)
class ArcFootprint:
    """Nodes exactly at both ends of the rim from arc length ``start`` to ``stop`` > start, m.

    ``stop`` may exceed the perimeter: the arc then runs on past the origin.
    """

    start: float
    stop: float

    def __post_init__(self):
        if not (np.isfinite(self.start) and np.isfinite(self.stop) and self.start < self.stop):
            raise ValueError(
                f"ArcFootprint: runs from {self.start} to {self.stop} m; give finite arc lengths, "
                "start before stop (an arc across the origin stops past the perimeter)"
            )


Footprint = PointFootprint | DiscFootprint | ArcFootprint


def _require_position(what: str, position: tuple[float, float]) -> None:
    if np.shape(position) != (2,) or not np.all(np.isfinite(position)):
        raise ValueError(f"{what}: position is {position}; give two finite numbers in metres")


def _halves_to_a_hub(segments: int) -> bool:
    if segments != int(segments) or segments < 6:
        return False
    while segments > 12 and segments % 2 == 0:
        segments //= 2
    return segments <= 12


def polygon_radius(radius: float, segments: int) -> float:
    """Circumradius in m of the regular polygon with the area of the disc of ``radius`` m."""
    sector = 2 * np.pi / segments
    return float(radius * np.sqrt(sector / np.sin(sector)))


# Graded meshes.


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

    Edges at a disc are its circumference / segments; a disc gets twice, four times ... its segments
    where edge_length or the gap to a neighbour is shorter than that.  Near anything narrow (gaps,
    short arcs, waists of the domain) edges shrink to fit.  The rim is followed exactly where it is
    straight, and by chords where it is round.  Nodes: the rim counter-clockwise, then the
    footprints' in their order, then the rest.

    Raises ValueError for footprints that overlap or leave the domain, naming the electrodes by their
    place in ``footprints``, and MeshError if no mesh passes `Mesh.check` with angles of 20 degrees.
    """
    fine = _lengths(domain, edge_length, growth, electrode_edge)
    footprints = list(footprints)
    _require_inside(domain, footprints)
    _require_apart(domain, footprints)
    footprints = _subdivided(domain, footprints, edge_length)
    rim = _rim_positions(domain, footprints)
    size = _size_field(domain, footprints, rim, edge_length, growth - 1, fine)
    problem = _problem(domain, footprints, rim, size)
    free = fill(domain, size)
    free = free[problem.open_to(free)]
    points, triangles = relax(problem, thin(free, problem.fixed, 0.72 * size(free)))
    return Mesh(points, triangles).check()


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


def _name(index: int, footprint: Footprint) -> str:
    if isinstance(footprint, ArcFootprint):
        return f"electrode {index} (arc {1e3 * footprint.start:.2f} to {1e3 * footprint.stop:.2f} mm)"
    kind = "disc" if isinstance(footprint, DiscFootprint) else "point"
    return f"electrode {index} ({kind} at {_place(np.asarray(footprint.position))})"


def _reach(footprint: PointFootprint | DiscFootprint) -> float:
    """Radius of what is meshed around the position, m."""
    if isinstance(footprint, PointFootprint):
        return 0.0
    return polygon_radius(footprint.radius, footprint.segments)


def _require_inside(domain: Domain, footprints: list[Footprint]) -> None:
    for index, footprint in enumerate(footprints):
        if isinstance(footprint, ArcFootprint):
            _require_on_rim(domain, index, footprint)
            continue
        position = np.asarray([footprint.position], float)
        room = float(domain.boundary_distance(position)[0])
        if not domain.contains(position)[0]:
            raise ValueError(
                f"{_name(index, footprint)} is {1e3 * room:.2f} mm outside the domain; move it "
                "inside (coordinates are metres)"
            )
        if isinstance(footprint, DiscFootprint) and room <= 1.02 * _reach(footprint):
            raise ValueError(
                f"{_name(index, footprint)} of radius {1e3 * footprint.radius:.2f} mm is only "
                f"{1e3 * room:.2f} mm from the rim; move it inward or make it smaller so that it is "
                "wholly inside the domain"
            )


def _require_on_rim(domain: Domain, index: int, arc: ArcFootprint) -> None:
    if arc.stop - arc.start > domain.perimeter * (1 - 1e-6):
        raise ValueError(
            f"{_name(index, arc)} is longer than the rim, {1e3 * domain.perimeter:.2f} mm; leave a "
            "gap (arc lengths are metres)"
        )


def _require_apart(domain: Domain, footprints: list[Footprint]) -> None:
    for (i, a), (j, b) in combinations(enumerate(footprints), 2):
        if _overlap(domain, a, b):
            raise ValueError(
                f"{_name(i, a)} and {_name(j, b)} overlap or touch; move them apart"
            )


def _overlap(domain: Domain, a: Footprint, b: Footprint) -> bool:
    if isinstance(a, ArcFootprint) and isinstance(b, ArcFootprint):
        return _in_arc(domain, a, b.start) or _in_arc(domain, b, a.start)
    if isinstance(a, ArcFootprint):
        return _overlap(domain, b, a)
    if isinstance(b, ArcFootprint):
        position = np.asarray([a.position], float)
        on_rim = domain.boundary_distance(position)[0] <= domain.tolerance
        return bool(on_rim) and _in_arc(domain, b, float(domain.boundary_coordinate(position)[0]))
    apart = np.linalg.norm(np.subtract(a.position, b.position))
    return bool(apart <= 1.02 * (_reach(a) + _reach(b)) + domain.tolerance)


def _in_arc(domain: Domain, arc: ArcFootprint, s: float) -> bool:
    """Whether s is on the arc, ends included; neighbours that touch would share a node."""
    slack = 2 * domain.tolerance
    return (s - arc.start + slack) % domain.perimeter <= arc.stop - arc.start + 2 * slack


def _subdivided(
    domain: Domain, footprints: list[Footprint], edge_length: float
) -> list[Footprint]:
    """The footprints, with discs given more segments where neighbours or edge_length ask for it."""
    return [
        _subdivide(domain, footprints, index, edge_length)
        if isinstance(footprint, DiscFootprint)
        else footprint
        for index, footprint in enumerate(footprints)
    ]


def _subdivide(
    domain: Domain, footprints: list[Footprint], index: int, edge_length: float
) -> DiscFootprint:
    disc = footprints[index]
    assert isinstance(disc, DiscFootprint)
    position = np.asarray(disc.position, float)
    others = [f for k, f in enumerate(footprints) if k != index]
    gaps = [
        np.linalg.norm(position - f.position) - _reach(f)
        for f in others
        if not isinstance(f, ArcFootprint)
    ]
    room = min(float(domain.boundary_distance(position[None])[0]), *gaps, np.inf) - _reach(disc)
    segments = disc.segments
    while 2 * np.pi * disc.radius / segments > 1.3 * min(edge_length, room):
        segments *= 2
    return DiscFootprint(disc.position, disc.radius, segments)


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
    cap = _cap(domain, edge_length)
    features = _fitted(_features(domain, footprints, rim, cap, fine), domain)
    places, widths = narrow_places(domain, cap, slope)
    centres = np.array([f.centre for f in features]).reshape(-1, 2)
    return SizeField(
        centres=np.concatenate([centres, places]),
        radii=np.concatenate([[f.radius for f in features], np.zeros(len(widths))]),
        sizes=np.concatenate([[f.size for f in features], widths]),
        slope=slope,
        cap=cap,
    )


def _cap(domain: Domain, edge_length: float) -> float:
    """No edge is longer than a sixteenth of the rim: the coarsest mesh still has a shape."""
    return min(edge_length, domain.perimeter / 16)


def _features(
    domain: Domain, footprints: list[Footprint], rim: np.ndarray, cap: float, fine: float
) -> list[_Feature]:
    """One per disc, interior point and fixed node of the rim."""
    features = []
    for f in footprints:
        if isinstance(f, DiscFootprint):
            edge = 2 * np.pi * f.radius / f.segments
            features.append(_Feature(np.asarray(f.position, float), _reach(f), min(edge, cap)))
        elif isinstance(f, PointFootprint):
            features.append(_Feature(np.asarray(f.position, float), 0.0, fine))
    arcs = [f for f in footprints if isinstance(f, ArcFootprint)]
    # Two edges or more under an arc: the current crowds at its ends.
    for arc in arcs:
        size = min(fine, 0.5 * (arc.stop - arc.start))
        ends = domain.boundary_point([arc.start, arc.stop])
        features += [_Feature(end, 0.0, size) for end in ends]
    return features + [_Feature(p, 0.0, cap) for p in domain.boundary_point(rim)]


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
    return [
        _Feature(f.centre, f.radius, min(f.size, r))
        for f, r in zip(features, room.tolist(), strict=True)
    ]


def _problem(
    domain: Domain, footprints: list[Footprint], rim: np.ndarray, size: SizeField
) -> Problem:
    """Fixed nodes and the edges between them: the rim, then each footprint's own."""
    nodes = [domain.boundary_point(divide_rim(domain, rim, size))]
    rings = [np.zeros((0, 2), int)]
    rim_edges = _cycle(0, len(nodes[0]))
    count = len(nodes[0])
    for f in footprints:
        own = _own_nodes(domain, f)
        if isinstance(f, DiscFootprint):
            rings.append(_cycle(count, f.segments))
        nodes.append(own)
        count += len(own)
    discs = [f for f in footprints if isinstance(f, DiscFootprint)]
    return Problem(
        domain,
        size,
        np.concatenate(nodes),
        rim_edges,
        np.concatenate(rings),
        partial(_open_to, domain, discs, size),
    )


def _cycle(first: int, count: int) -> np.ndarray:
    """Edges (count, 2) of a closed ring of consecutive nodes."""
    around = np.arange(count)
    return first + np.stack([around, (around + 1) % count], axis=1)


def _own_nodes(domain: Domain, footprint: Footprint) -> np.ndarray:
    """Nodes (k, 2) a footprint adds to those of the rim; a disc's outermost ring comes first."""
    if isinstance(footprint, DiscFootprint):
        return _disc_nodes(footprint)
    if isinstance(footprint, ArcFootprint):
        return np.zeros((0, 2))
    position = np.asarray([footprint.position], float)
    return position[domain.boundary_distance(position) > domain.tolerance]


def _disc_nodes(disc: DiscFootprint) -> np.ndarray:
    """Rings from the polygon inward, each with half the nodes of the one around it, and a hub."""
    count, radius, rings = disc.segments, _reach(disc), []
    while True:
        angle = 2 * np.pi * np.arange(count) / count
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        if count <= 8 or count % 2:
            break
        # A gap as wide as the ring's own edge balances the two kinds of triangle.
        radius, count = radius * (1 - 2.0 * np.sin(np.pi / count)), count // 2
    return np.asarray(disc.position) + np.concatenate([*rings, np.zeros((1, 2))])


def _open_to(
    domain: Domain, discs: list[DiscFootprint], size: SizeField, points: np.ndarray
) -> np.ndarray:
    """Whether a free node may be put at each of points: inside, off the rim and off the discs."""
    wanted = size(points)
    allowed = domain.contains(points) & (domain.boundary_distance(points) > 0.45 * wanted)
    for disc in discs:
        away = np.linalg.norm(points - disc.position, axis=1) - _reach(disc)
        allowed &= away > 0.4 * wanted
    return allowed


# Regular meshes.


class Pattern(Enum):
    """How the cells of a structured mesh are cut.

    RISING: by the diagonal from lower left to upper right.
    ALTERNATING: by either diagonal in turn (union jack); mirror-symmetric for even numbers of cells.
    CROSSED: by both, with a node at the middle of each cell; has all symmetries of the rectangle.
    """

    RISING = "rising"
    ALTERNATING = "alternating"
    CROSSED = "crossed"


def structured(
    rectangle: Rectangle, nx: int, ny: int, *, pattern: Pattern = Pattern.ALTERNATING
) -> Mesh:
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
