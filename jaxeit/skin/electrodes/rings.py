"""Ring electrodes: a washer, or the outer part of a concentric pair; outline, electrode and form in a skin file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ...geometry.shapes import Domain
from ...meshing.elements import Space
from ...meshing.footprints import AbstractFootprint, Feature, cycle
from ...meshing.outlines import MAX_OUTLINE_EDGES, DiscFootprint, enough_segments
from ...meshing.triangles import MeshError, place
from ...toml import TomlTable
from .base import (
    AbstractAreaElectrode,
    ElectrodeDrawing,
    ElectrodeError,
    require_contact,
    require_covered,
    require_positive,
)
from .places import read_area_contact, read_positions_inside, read_radius

DRAWN_SIDES = 64  # of each circle in pictures


@dataclass(frozen=True)
class RingFootprint(AbstractFootprint):
    """Two concentric regular polygons of the circles' exact areas, with triangles between and inside them.

    | meaning                                                                | shape | unit |
    |------------------------------------------------------------------------|-------|------|
    | position of the centre                                                 | (2,)  | m    |
    | inner, outer: radii of the circles                                     | ()    | m    |
    | inner_segments, outer_segments: sides; 6 to 12 times a power of two    | ()    |      |
    | fills_hole: whether the hole is meshed like a disc; else an electrode inside meshes it  | () | |
    """

    position: tuple[float, float]
    inner: float
    outer: float
    inner_segments: int = 16
    outer_segments: int = 16
    fills_hole: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.inner < self.outer < np.inf:
            raise ValueError(f"RingFootprint: radii are {self.inner} and {self.outer} m; give 0 < inner < outer")
        _ = self._hole, self._whole  # the constructors raise ValueError for discs that cannot be meshed

    @property
    def _hole(self) -> DiscFootprint:
        return DiscFootprint(self.position, self.inner, self.inner_segments)

    @property
    def _whole(self) -> DiscFootprint:
        return DiscFootprint(self.position, self.outer, self.outer_segments)

    @property
    def label(self) -> str:
        return f"ring at {place(np.asarray(self.position))}"

    @property
    def corners(self) -> np.ndarray:
        return np.concatenate([self._whole.rim, self._hole.rim])

    @property
    def is_closed(self) -> bool:
        return True  # the two sides that join the polygons lie on the ring itself

    def distance(self, points: np.ndarray) -> np.ndarray:
        # The sides of the polygon are nearest to the centre at their midpoints, the apothem away.
        within = self._hole.reach * np.cos(np.pi / self.inner_segments)
        return np.asarray(
            np.maximum(self._whole.distance(points), within - np.linalg.norm(points - self.position, axis=1))
        )

    def require_inside(self, domain: Domain, name: str) -> None:
        self._whole.require_inside(domain, name)

    def subdivided(
        self, domain: Domain, others: Sequence[AbstractFootprint], edge_length: float, slope: float
    ) -> "RingFootprint":
        edge = min([edge_length, self.outer - self.inner, self.rim_gap(domain), *map(self.gap, others)])
        if 2 * np.pi * self.outer > MAX_OUTLINE_EDGES * edge:
            raise MeshError(
                f"triangulate: the {self.label} needs more than {MAX_OUTLINE_EDGES} edges around it; "
                "use a longer edge_length, or make it wider and move what is near it away"
            )
        return replace(
            self,
            inner_segments=enough_segments(self.inner, self.inner_segments, edge),
            outer_segments=enough_segments(self.outer, self.outer_segments, edge),
            fills_hole=not any((self._hole.distance(other.corners) < 0).any() for other in others),
        )

    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        return [Feature(corner, 0.0, longest) for corner in self.corners]

    def nodes(self, domain: Domain) -> np.ndarray:
        return np.concatenate([self._whole.rim, self._hole.nodes(domain) if self.fills_hole else self._hole.rim])

    def edges(self) -> np.ndarray:
        return np.concatenate([cycle(self.outer_segments), self.outer_segments + cycle(self.inner_segments)])

    def leaves_room(self, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        return self._hole.leaves_room(points, wanted) | (not self.fills_hole)


@dataclass(frozen=True)
class RingPatch(AbstractAreaElectrode):
    """A ring pressed on the film: current spreads into the sheet under its whole area, as under an `AreaPatch`.

    | meaning                                 | shape | unit    |
    |-----------------------------------------|-------|---------|
    | position of the centre                  | (2,)  | m       |
    | inner_radius, outer_radius              | ()    | m       |
    | contact: specific contact resistance    | ()    | ohm m^2 |

    Another electrode may lie in the hole.  There is no closed form: the mesh must resolve the transfer length
    ``sqrt(contact / sheet resistance)`` along both circles if the resistance of the ring matters.

    Example:
        guarded = (je.AreaPatch((0.06, 0.04), 0.002), je.skin.RingPatch((0.06, 0.04), 0.004, 0.006))
    """

    name: ClassVar[str] = "ring"

    position: tuple[float, float]
    inner_radius: float
    outer_radius: float
    contact: float = 1e-6

    def __post_init__(self) -> None:
        require_positive(inner_radius=self.inner_radius, outer_radius=self.outer_radius)
        if not self.inner_radius < self.outer_radius:
            raise ElectrodeError(
                f"a ring's inner radius is {self.inner_radius} m and its outer radius {self.outer_radius} m; "
                "give an outer radius above the inner one"
            )
        require_contact(self.contact, "ohm m^2")

    def footprint(self, segments: int) -> RingFootprint:
        return RingFootprint(self.position, self.inner_radius, self.outer_radius, segments, segments)

    def elements(self, space: Space) -> np.ndarray:
        away = np.linalg.norm(space.mesh.chart_centroids - np.asarray(self.position), axis=1)
        inside = np.flatnonzero((away > self.inner_radius) & (away < self.outer_radius))
        what = f"the ring of radii {self.inner_radius} and {self.outer_radius} m at {self.position}"
        require_covered(space, inside, np.pi * (self.outer_radius**2 - self.inner_radius**2), what)
        return inside

    def centre(self, domain: Domain) -> np.ndarray:
        return np.asarray(self.position, float)

    def drawing(self, domain: Domain) -> ElectrodeDrawing:
        radii = self.outer_radius, self.inner_radius
        return ElectrodeDrawing(tuple(DiscFootprint(self.position, radius, DRAWN_SIDES).rim for radius in radii))

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["RingPatch", ...]:
        positions = read_positions_inside(table, domain)
        inner = table.positive("inner_radius", "the radius of the hole in m")
        outer = read_radius(table, "outer_radius", "the radius of the whole in m", domain)
        if outer <= inner:
            raise table.error("outer_radius", f"is {outer} m, not above the inner radius, {inner} m")
        contact = read_area_contact(table)
        return tuple(cls(position, inner, outer, contact) for position in positions)
