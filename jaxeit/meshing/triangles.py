"""Triangle meshes as values, in the plane or on a surface in space, and checks of their validity."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .smoothing import corner_angles, directed_edges, doubled_areas, edge_keys

MIN_ANGLE = 20.0
"""Smallest angle of a triangle, degrees, that is accepted unless told otherwise."""

OWN_MESH = "move its nodes apart, or accept such triangles with min_angle=, an argument of discretise and of Mesh.check"

CROWDED = "use a shorter edge_length or more segments there, or move what is crowded apart"

Surface = Callable[[np.ndarray], np.ndarray]


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

    Raises:
        MeshError: for wrong shapes; `check` tests the values.
    """

    nodes: np.ndarray
    triangles: np.ndarray
    chart: np.ndarray = None  # type: ignore[assignment]  # `__post_init__` replaces None

    def __post_init__(self) -> None:
        chart = self.nodes if self.chart is None else self.chart
        _set(self, "nodes", _array("nodes", self.nodes, np.float64, (2, 3)))
        _set(self, "triangles", _array("triangles", self.triangles, np.int32, (3,)))
        _set(self, "chart", _array("chart", chart, np.float64, (2,)))
        if len(self.chart) != len(self.nodes):
            raise MeshError(f"mesh: {len(self.nodes)} nodes but {len(self.chart)} chart positions; give each node one")

    @cached_property
    def areas(self) -> np.ndarray:
        """Areas of the triangles on the surface, (m,) m^2."""
        corners = self.nodes[self.triangles]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        gram = (u * u).sum(1) * (v * v).sum(1) - (u * v).sum(1) ** 2
        return np.asarray(0.5 * np.sqrt(np.maximum(gram, 0.0)))

    @property
    def centroids(self) -> np.ndarray:
        """Centroids of the triangles in space, (m, 2 or 3) m."""
        return np.asarray(self.nodes[self.triangles].mean(1))

    @cached_property
    def chart_centroids(self) -> np.ndarray:
        """Centroids of the triangles on the flat sheet, (m, 2) m."""
        return np.asarray(self.chart[self.triangles].mean(1))

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
        return np.asarray(corner_angles(self.nodes[self.triangles]).min(1))

    def check(self, min_angle: float = MIN_ANGLE, advice: str = OWN_MESH) -> "Mesh":
        """This mesh; raises MeshError with its worst fault, the place of the fault, and what to do.

        Tests for values that are not finite, indices out of range, nodes that coincide or belong
        to no triangle, flipped triangles, edges of more than two triangles, separate pieces, and
        angles below ``min_angle`` degrees; ``advice`` says what to do about these.
        """
        _require_finite(self)
        _require_indices(self)
        _require_distinct_nodes(self)
        _require_orientation(self)
        _require_manifold(self)
        _require_connected(self)
        _require_angles(self, min_angle, advice)
        return self

    def lift(self, surface: Surface) -> "Mesh":
        """The same triangles on a curved sheet: ``surface`` maps chart (n, 2) to nodes (n, 3)."""
        return Mesh(_on_surface(surface, self.chart), self.triangles, self.chart)

    def refine(self, surface: Surface | None = None) -> "Mesh":
        """The mesh with every triangle divided into four at the midpoints of its edges; old nodes keep their numbers.

        New nodes are at the middle of their edge, in space and on the chart; with ``surface``, as
        in `lift`, new nodes are on the curved sheet instead.
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


def _array(name: str, value: ArrayLike, dtype: type, columns: tuple[int, ...]) -> np.ndarray:
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
            f"mesh: the surface returned shape {nodes.shape} for {len(chart)} points; it must map (n, 2) to (n, 3)"
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


# The tests of `check`; each assumes that a mesh has passed the tests before it.


def place(position: np.ndarray) -> str:
    """A position as text, in millimetres."""
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
            f"mesh: node {node} at {place(mesh.nodes[node])} belongs to no triangle "
            f"({int(unused.sum())} such nodes); remove them, or the system is singular"
        )


def _require_distinct_nodes(mesh: Mesh) -> None:
    nearest = 1e-9 * float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
    pairs = cKDTree(mesh.nodes).query_pairs(nearest, output_type="ndarray")
    if len(pairs):
        a, b = (int(i) for i in pairs[np.lexsort(pairs.T[::-1])[0]])
        raise MeshError(
            f"mesh: nodes {a} and {b} are both at {place(mesh.nodes[a])} ({len(pairs)} such "
            "pairs); merge them, or the sheet is torn there"
        )


def _require_orientation(mesh: Mesh) -> None:
    doubled = doubled_areas(mesh.chart[mesh.triangles])
    worst = int(np.argmin(doubled))
    if doubled[worst] <= 0:
        raise MeshError(
            f"mesh: triangle {worst} at {place(mesh.centroids[worst])} has area "
            f"{0.5e6 * doubled[worst]:.3g} mm^2 in the chart ({int((doubled <= 0).sum())} such "
            "triangles); list its nodes counter-clockwise, remove it if it is flat"
        )


def _require_manifold(mesh: Mesh) -> None:
    directed = directed_edges(mesh.triangles)
    _, first, count = np.unique(edge_keys(directed), return_index=True, return_counts=True)
    if np.any(count > 1):
        edge = directed[first[np.argmax(count > 1)]]
        raise MeshError(
            f"mesh: the edge between nodes {edge[0]} and {edge[1]} at "
            f"{place(mesh.nodes[edge].mean(0))} belongs to two triangles on the same side; remove "
            "overlapping triangles"
        )
    starts = np.bincount(mesh.boundary_edges[:, 0], minlength=len(mesh.nodes))
    if starts.max() > 1:
        node = int(np.argmax(starts))
        raise MeshError(
            f"mesh: parts of the sheet meet only in node {node} at {place(mesh.nodes[node])}; "
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
            f"{place(mesh.nodes[node])}; keep the piece with the electrodes or join them"
        )


def _require_angles(mesh: Mesh, min_angle: float, advice: str) -> None:
    angles = mesh.min_angles
    worst = int(np.argmin(angles))
    if not angles[worst] >= min_angle:
        raise MeshError(
            f"mesh: triangle {worst} at {place(mesh.centroids[worst])} has an angle of "
            f"{angles[worst]:.1f} degrees ({int((angles < min_angle).sum())} triangles are below "
            f"{min_angle:g}); {advice}"
        )
