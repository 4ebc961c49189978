"""Electrode models: how a terminal of the instrument meets the sheet.

Every model says two things: what the mesh must follow (`footprint`), and which pieces of the mesh
it touches (`pieces`).  A complete electrode has a contact conductance ``g`` per unit of its measure
(area for a bolt, length for an edge electrode) and obeys, with u the sheet potential and U its own,

    -div(sigma grad u) + sum_l chi_l g_l (u - U_l) = 0,      integral over E_l of g_l (U_l - u) = I_l

(area patch: current enters through the film from above; boundary patch: through its edge, which is
the complete electrode model of Somersalo, Cheney and Isaacson 1992).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.special import ive

from .domain import Domain, Polygon, cross
from .elements import Space
from .mesh import ArcFootprint, DiscFootprint, Footprint, PointFootprint, PolygonFootprint
from .smoothing import doubled_areas


class ElectrodeError(ValueError):
    """An electrode that cannot be built on this sheet or mesh."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Where one electrode touches a function space.

    | meaning                                         | shape  | unit   |
    |-------------------------------------------------|--------|--------|
    | dofs of each triangle or boundary edge touched  | (p, k) |        |
    | mass: integrals of phi_i phi_j over each        | (p, k, k) | m^2 or m |
    """

    dofs: np.ndarray
    mass: np.ndarray


class AbstractElectrode(ABC):
    """One terminal.  ``contact`` is its specific contact resistance; 0 means a perfect contact."""

    contact: float

    @abstractmethod
    def footprint(self, segments: int) -> Footprint:
        """What the mesh must follow, discs as polygons of ``segments`` sides."""

    @abstractmethod
    def pieces(self, space: Space, domain: Domain) -> Pieces:
        """The parts of the space that it touches."""

    def lumped_radius(self, space: Space, sheet_resistance: float) -> float:
        """Radius in m of the disc whose contact is taken in closed form because the mesh does not
        resolve it; 0 where it does, or where there is no closed form."""
        return 0.0

    @abstractmethod
    def centre(self, domain: Domain) -> np.ndarray:
        """Its middle in the sheet's flat coordinates, (2,) m."""


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ElectrodeError(f"an electrode's {name} is {value}; give a positive number")


def _contact(value: float, unit: str) -> None:
    if not (np.isfinite(value) and value >= 0):
        raise ElectrodeError(f"an electrode's contact is {value} {unit}; give zero (perfect) or a positive number")


@dataclass(frozen=True)
class PointElectrode(AbstractElectrode):
    """The ideal limit: a node of the mesh.  Its own drive resistance is infinite in the limit of
    fine meshes (the potential is logarithmic there); four-terminal readings are not affected.

    | meaning  | shape | unit |
    |----------|-------|------|
    | position | (2,)  | m    |
    """

    position: tuple[float, float]
    contact = 0.0

    def footprint(self, segments: int) -> PointFootprint:
        return PointFootprint(self.position)

    def pieces(self, space: Space, domain: Domain) -> Pieces:
        distance = np.linalg.norm(space.chart - np.asarray(self.position), axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] > 1e-6 * np.ptp(space.chart):
            raise ElectrodeError(f"no mesh node at the point electrode {self.position}")
        return Pieces(np.array([[nearest]]), np.ones((1, 1, 1)))

    def centre(self, domain: Domain) -> np.ndarray:
        return np.asarray(self.position, float)


@dataclass(frozen=True)
class AreaPatch(AbstractElectrode):
    """A bolt head or disc pressed on the film: current spreads into the sheet under its whole area.

    | meaning                                 | shape | unit    |
    |-----------------------------------------|-------|---------|
    | position of the centre                  | (2,)  | m       |
    | radius                                  | ()    | m       |
    | contact: specific contact resistance    | ()    | ohm m^2 |

    The current passes within the transfer length ``sqrt(contact / sheet resistance)`` of the rim,
    0.08 mm for the default.  Where triangles under the bolt are larger, the bolt is a perfect
    contact in series with the closed form `disc_resistance`; where they are smaller, the area
    integral over ``(u - U) / contact`` is resolved.  Four-terminal readings feel neither.

    The mesh generator needs it wholly inside the sheet.  On a mesh of your own the rim may cut off less than
    half of it: what is left is what conducts.
    """

    position: tuple[float, float]
    radius: float
    contact: float = 1e-6

    def __post_init__(self):
        _positive(radius=self.radius)
        _contact(self.contact, "ohm m^2")

    def footprint(self, segments: int) -> DiscFootprint:
        return DiscFootprint(self.position, self.radius, segments)

    def elements(self, space: Space) -> np.ndarray:
        """Triangles under the bolt."""
        offset = space.mesh.chart_centroids - np.asarray(self.position)
        inside = np.flatnonzero(np.linalg.norm(offset, axis=1) < self.radius)
        if not len(inside):
            raise ElectrodeError(f"the mesh has no triangle under the bolt at {self.position}")
        covered = space.mesh.areas[inside].sum() / (np.pi * self.radius**2)
        if covered < 0.5:
            raise ElectrodeError(
                f"the mesh covers {100 * covered:.0f} % of the bolt of radius {self.radius} m at {self.position}; "
                "move it inside the sheet, or make the mesh finer there"
            )
        return inside

    def pieces(self, space: Space, domain: Domain) -> Pieces:
        inside = self.elements(space)
        return Pieces(space.dofs[inside], space.element_mass(inside))

    def lumped_radius(self, space: Space, sheet_resistance: float) -> float:
        inside = self.elements(space)
        distance = np.linalg.norm(space.mesh.chart_centroids[inside] - np.asarray(self.position), axis=1)
        rim = inside[distance >= np.quantile(distance, 0.75)]  # where the current passes
        edge = np.sqrt(4 / np.sqrt(3) * space.mesh.areas[rim].mean())  # of equilateral triangles
        transfer = np.sqrt(self.contact / sheet_resistance)
        return self.radius if 0 < transfer < edge / space.element.order else 0.0

    def centre(self, domain: Domain) -> np.ndarray:
        return np.asarray(self.position, float)


@dataclass(frozen=True)
class PolygonPatch(AbstractElectrode):
    """An area electrode of straight sides, such as a rectangular pad of a flexible circuit: current
    spreads into the sheet under its whole area, as under an `AreaPatch`.

    | meaning                                 | shape        | unit    |
    |-----------------------------------------|--------------|---------|
    | outline: its shape on the flat sheet    | `Polygon`    | m       |
    | contact: specific contact resistance    | ()           | ohm m^2 |

    The mesh generator needs it wholly inside the sheet; on a mesh of your own whose edges follow it, it
    may reach the rim or run from rim to rim.  There is no closed form: the mesh must resolve the
    transfer length along its sides where its own resistance matters.
    """

    outline: Polygon
    contact: float = 1e-6

    def __post_init__(self):
        _contact(self.contact, "ohm m^2")

    def footprint(self, segments: int) -> PolygonFootprint:
        return PolygonFootprint(self.outline, segments)

    def elements(self, space: Space) -> np.ndarray:
        """Triangles under the electrode."""
        mesh = space.mesh
        inside = np.flatnonzero(self.outline.contains(mesh.chart_centroids))
        corners = mesh.chart[mesh.triangles[inside]]
        covered = 0.5 * doubled_areas(corners).sum()
        whole = abs(covered - self.outline.area) < 1e-6 * self.outline.area
        if not (whole and self.outline.contains(corners.reshape(-1, 2)).all()):
            raise ElectrodeError(
                f"mesh edges cross the polygon electrode {self.outline.corner_points.tolist()}; "
                "give a mesh whose edges follow it"
            )
        return inside

    def pieces(self, space: Space, domain: Domain) -> Pieces:
        inside = self.elements(space)
        return Pieces(space.dofs[inside], space.element_mass(inside))

    def centre(self, domain: Domain) -> np.ndarray:
        corners = self.outline.corner_points
        after = np.roll(corners, -1, 0)
        weight = cross(corners - corners[0], after - corners[0])
        return (weight @ (corners[0] + corners + after)) / (3 * weight.sum())


@dataclass(frozen=True)
class BoundaryPatch(AbstractElectrode):
    """An electrode along the edge of the sheet: the complete electrode model.

    | meaning                                              | shape | unit  |
    |------------------------------------------------------|-------|-------|
    | start, stop: arc length along the domain's boundary  | ()    | m     |
    | contact: contact impedance z in  u + z sigma du/dn = U | ()  | ohm m |
    """

    start: float
    stop: float
    contact: float = 1e-3

    def __post_init__(self):
        _positive(length=self.stop - self.start)
        _contact(self.contact, "ohm m")

    def footprint(self, segments: int) -> ArcFootprint:
        return ArcFootprint(self.start, self.stop)

    def pieces(self, space: Space, domain: Domain) -> Pieces:
        ends = space.mesh.chart[space.mesh.boundary_edges]
        along = (domain.boundary_coordinate(ends.mean(1)) - self.start) % domain.perimeter
        touched = np.flatnonzero((along < self.stop - self.start) & _on_the_rim(ends, domain))
        if not len(touched):
            raise ElectrodeError(f"the mesh has no edge under the electrode from {self.start} to {self.stop} m")
        return Pieces(space.boundary_dofs[touched], space.edge_mass(touched))

    def centre(self, domain: Domain) -> np.ndarray:
        return np.asarray(domain.boundary_point(0.5 * (self.start + self.stop)))


def _on_the_rim(ends: np.ndarray, domain: Domain) -> np.ndarray:
    """Which of these edges (e, 2, 2) are of the sheet's own rim and not of a hole in the mesh; (e,) bool."""
    away = domain.boundary_distance(ends.reshape(-1, 2)).reshape(-1, 2).max(1)
    return away < 0.1 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def disc_resistance(radius: float, contact: float, sheet_resistance: float) -> float:
    """Resistance in ohm from a disc electrode into the sheet around it, in closed form.

    ``R_s L_T / (2 pi a) * I0(a / L_T) / I1(a / L_T)`` with the transfer length
    ``L_T = sqrt(contact / R_s)``: the modified Bessel solution of ``laplace(u) = (u - U) / L_T^2``
    under the disc.  Radius in m, contact in ohm m^2, sheet resistance in ohm per square.
    """
    _positive(radius=radius, contact=contact, sheet_resistance=sheet_resistance)
    transfer = np.sqrt(contact / sheet_resistance)
    ratio = radius / transfer
    return float(sheet_resistance * transfer / (2 * np.pi * radius) * ive(0, ratio) / ive(1, ratio))
