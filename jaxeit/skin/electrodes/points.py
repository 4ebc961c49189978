"""The ideal point electrode."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...geometry.shapes import Domain
from ...meshing.elements import Space
from ...meshing.outlines import PointFootprint
from ...toml import TomlTable
from .base import AbstractElectrode, ElectrodeError, Pieces
from .places import read_positions_inside


@dataclass(frozen=True)
class PointElectrode(AbstractElectrode):
    """A node of the mesh, as the limit of a small electrode.  Its drive resistance has no limit for fine
    meshes, since the potential is logarithmic there; four-terminal readings are not affected.

    | meaning  | shape | unit |
    |----------|-------|------|
    | position | (2,)  | m    |
    """

    name: ClassVar[str] = "point"

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

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["PointElectrode", ...]:
        return tuple(map(cls, read_positions_inside(table, domain)))
