"""Electrodes of straight sides, such as the pads of a flexible circuit."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ...geometry.shapes import Domain, Polygon
from ...meshing.elements import Space
from ...meshing.outlines import PolygonFootprint
from ...meshing.smoothing import doubled_areas
from ...toml import TomlTable
from .base import AbstractAreaElectrode, ElectrodeDrawing, ElectrodeError, require_contact
from .places import read_area_contact, read_positions


@dataclass(frozen=True)
class PolygonPatch(AbstractAreaElectrode):
    """An area electrode of straight sides, such as a rectangular pad of a flexible circuit: current
    spreads into the sheet under its whole area, as under an `AreaPatch`.

    | meaning                                 | shape        | unit    |
    |-----------------------------------------|--------------|---------|
    | outline: its shape on the flat sheet    | `Polygon`    | m       |
    | contact: specific contact resistance    | ()           | ohm m^2 |

    The mesh generator needs the electrode wholly inside the sheet; on a mesh of your own whose edges follow
    the electrode, it may reach the rim or run from rim to rim.  There is no closed form: the mesh must resolve the
    transfer length along the sides if the resistance of the electrode matters.

    Example:
        copper = je.Polygon([(0.05, 0.01), (0.07, 0.01), (0.06, 0.02)])  # m
        electrodes = (*bolts, je.PolygonPatch(copper, contact=1e-6))
    """

    name: ClassVar[str] = "polygon"

    outline: Polygon
    contact: float = 1e-6

    def __post_init__(self) -> None:
        require_contact(self.contact, "ohm m^2")

    def footprint(self, segments: int) -> PolygonFootprint:
        return PolygonFootprint(self.outline, segments)

    def elements(self, space: Space) -> np.ndarray:
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

    def centre(self, domain: Domain) -> np.ndarray:
        return self.outline.centroid

    def drawing(self, domain: Domain) -> ElectrodeDrawing:
        return ElectrodeDrawing((self.outline.corner_points,))

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["PolygonPatch", ...]:
        meaning = "[[[x, y], ...], ...], the corners of each electrode in m"
        given = table.get("outlines", lambda v: isinstance(v, list) and v != [] and all(map(_is_outline, v)), meaning)
        outlines = [_outline(table, number, corners) for number, corners in enumerate(given)]
        return cls._inside(table, "outlines", outlines, domain)

    @classmethod
    def _inside(cls, table: TomlTable, key: str, outlines: list[Polygon], domain: Domain) -> tuple["PolygonPatch", ...]:
        """Electrodes with these outlines; raises TomlError for a corner outside the sheet."""
        for number, outline in enumerate(outlines):
            outside = ~domain.contains(outline.corner_points)
            if outside.any():
                corner = outline.corner_points[np.argmax(outside)].round(9).tolist()
                raise table.error(key, f"electrode {number} has a corner at {corner} m, outside the sheet")
        contact = read_area_contact(table)
        return tuple(cls(outline, contact) for outline in outlines)


class RectanglePatch(PolygonPatch):
    """A `PolygonPatch` that a skin file describes by its centre, its size and its angle.

    Example:
        pad = je.skin.RectanglePatch(je.Polygon([(0.05, 0.01), (0.07, 0.01), (0.07, 0.02), (0.05, 0.02)]))
        print(pad.outline.area, "m^2; kind of a file:", je.skin.ELECTRODES.name_of(pad))
    """

    name: ClassVar[str] = "rectangle"

    @classmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["PolygonPatch", ...]:
        positions = read_positions(table)
        size = table.vector("size", 2, "[width, height] in m")
        if min(size) <= 0:
            raise table.error("size", f"is {list(size)}; give a width and a height in m, above zero")
        turn = 2 * math.pi
        angle = table.number("angle", "the turn counter-clockwise in rad, at most a whole one", 0.0, -turn, turn)
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
        along, across = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        turned = corners[:, :1] * along + corners[:, 1:] * across
        return cls._inside(table, "positions", [Polygon(turned + position) for position in positions], domain)


def _is_outline(value: Any) -> bool:
    """Whether a value of a TOML file is a list of rows of two numbers; `Polygon` checks the numbers."""
    rows = value if isinstance(value, list) else [None]
    return all(isinstance(row, list) and len(row) == 2 and all(type(x) in (int, float) for x in row) for row in rows)


def _outline(table: TomlTable, number: int, corners: list[list[float]]) -> Polygon:
    try:
        return Polygon(corners)
    except ValueError as error:
        raise table.error("outlines", f"electrode {number}: {error}") from None
