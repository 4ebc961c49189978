"""Bolts and other discs that are pressed on the film."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...geometry.shapes import Domain
from ...meshing.elements import Space
from ...meshing.outlines import DiscFootprint
from ...toml import TomlTable
from .base import AbstractAreaElectrode, require_contact, require_covered, require_positive
from .places import read_area_contact, read_positions_inside, read_radius

LEAST_TRANSFER = 0.1
"""Transfer length, over the distance between unknowns under a bolt, below which its contact is in closed form."""


@dataclass(frozen=True)
class AreaPatch(AbstractAreaElectrode):
    """A bolt head or disc pressed on the film: current spreads into the sheet under its whole area.

    | meaning                                 | shape | unit    |
    |-----------------------------------------|-------|---------|
    | position of the centre                  | (2,)  | m       |
    | radius                                  | ()    | m       |
    | contact: specific contact resistance    | ()    | ohm m^2 |

    The current passes within the transfer length t of the rim, ``t = sqrt(contact / sheet resistance)``,
    0.08 mm for the default.  The area integral over ``(u - U) / contact`` is resolved by the mesh, except
    where t is below a tenth of the distance between unknowns: there the bolt is a perfect contact in series
    with the closed form of `series_resistance`.

    Four-terminal readings depend on the contact of bolts that carry no current too, as if these were smaller
    by t.  The closed form leaves that out: on the testbed its error is 7 % of t over the radius, which the
    limit keeps near the error of the mesh with perfect contacts.  An integral that the mesh hardly resolves
    gives four-terminal readings that are as good or better, and too small a resistance of the contact itself.

    The mesh generator needs the bolt wholly inside the sheet.  On a mesh of your own the rim may cut off less
    than half of it; the part on the sheet conducts.
    """

    name: ClassVar[str] = "bolt"

    position: tuple[float, float]
    radius: float
    contact: float = 1e-6

    def __post_init__(self) -> None:
        require_positive(radius=self.radius)
        require_contact(self.contact, "ohm m^2")

    def footprint(self, segments: int) -> DiscFootprint:
        return DiscFootprint(self.position, self.radius, segments)

    def elements(self, space: Space) -> np.ndarray:
        offset = space.mesh.chart_centroids - np.asarray(self.position)
        inside = np.flatnonzero(np.linalg.norm(offset, axis=1) < self.radius)
        what = f"the bolt of radius {self.radius} m at {self.position}"
        require_covered(space, inside, np.pi * self.radius**2, what)
        return inside

    def lumped_radius(self, space: Space, sheet_resistance: float) -> float:
        inside = self.elements(space)
        distance = np.linalg.norm(space.mesh.chart_centroids[inside] - np.asarray(self.position), axis=1)
        rim = inside[distance >= np.quantile(distance, 0.75)]  # the outer quarter, where the current passes
        edge = np.sqrt(4 / np.sqrt(3) * space.mesh.areas[rim].mean())  # edge of an equilateral triangle
        transfer = np.sqrt(self.contact / sheet_resistance)
        return self.radius if 0 < transfer < LEAST_TRANSFER * edge / space.element.order else 0.0

    def centre(self, domain: Domain) -> np.ndarray:
        return np.asarray(self.position, float)

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["AreaPatch", ...]:
        positions = read_positions_inside(table, domain)
        radius = read_radius(table, "radius", "the contact radius in m", domain)
        contact = read_area_contact(table)
        return tuple(cls(position, radius, contact) for position in positions)
