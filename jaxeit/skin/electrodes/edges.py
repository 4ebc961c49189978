"""Electrodes along the edge of the sheet."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...budget import require
from ...geometry.shapes import Domain
from ...meshing.elements import Space
from ...meshing.outlines import ArcFootprint
from ...toml import TomlError, TomlTable
from .base import AbstractElectrode, ElectrodeDrawing, ElectrodeError, Pieces, require_contact, require_positive
from .places import read_contact

DRAWN_POINTS = 33  # along an electrode in pictures


@dataclass(frozen=True)
class BoundaryPatch(AbstractElectrode):
    """An electrode along the edge of the sheet: the complete electrode model.

    | meaning                                              | shape | unit  |
    |------------------------------------------------------|-------|-------|
    | start, stop: arc length along the domain's boundary  | ()    | m     |
    | contact: contact impedance z in  u + z sigma du/dn = U | ()  | ohm m |

    Example:
        strip = je.BoundaryPatch(start=0.03, stop=0.05, contact=1e-3)  # along the bottom, from 30 to 50 mm
        print(strip.centre(sheet))  # m
    """

    name: ClassVar[str] = "edge"

    start: float
    stop: float
    contact: float = 1e-3

    def __post_init__(self) -> None:
        require_positive(length=self.stop - self.start)
        require_contact(self.contact, "ohm m")

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

    def drawing(self, domain: Domain) -> ElectrodeDrawing:
        return ElectrodeDrawing(edge=domain.boundary_point(np.linspace(self.start, self.stop, DRAWN_POINTS)))

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["BoundaryPatch", ...]:
        count = table.count("count")
        require("electrodes", count, table.where, TomlError)
        width = table.positive("width", "a length in m")
        first = table.number("first", "arc length of electrode 0's centre in m", 0.0)
        direction = table.choice("direction", "counter-clockwise", "clockwise", default="counter-clockwise")
        contact = read_contact(table, "ohm m")
        if count * width > domain.perimeter:
            fits = f"do not fit along the edge of {domain.perimeter:g} m; give fewer or narrower ones"
            raise table.error("width", f"{count} electrodes of {width} m {fits}")
        step = domain.perimeter / count * (1 if direction == "counter-clockwise" else -1)
        starts = (first - 0.5 * width + step * np.arange(count)) % domain.perimeter
        return tuple(cls(float(start), float(start + width), contact) for start in starts)


def _on_the_rim(ends: np.ndarray, domain: Domain) -> np.ndarray:
    """Which of these edges (e, 2, 2) are of the sheet's own rim and not of a hole in the mesh; (e,) bool."""
    away = domain.boundary_distance(ends.reshape(-1, 2)).reshape(-1, 2).max(1)
    return np.asarray(away < 0.1 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
