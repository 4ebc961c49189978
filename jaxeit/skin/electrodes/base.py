"""Electrode models: the contact between a terminal of the instrument and the sheet.

Every model states the outline that the mesh must follow (`footprint`), the pieces of the mesh that it touches
(`pieces`), its form in a skin file (`read`), and what pictures show of it (`drawing`).

A complete electrode has a contact conductance ``g`` per unit of its measure (area for a bolt, length for an edge
electrode) and obeys, with u the sheet potential and U its own,

    -div(sigma grad u) + sum_l chi_l g_l (u - U_l) = 0,      integral over E_l of g_l (U_l - u) = I_l

(area patch: current enters through the film from above; boundary patch: through its edge, which is
the complete electrode model of Somersalo, Cheney and Isaacson 1992).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from ...geometry.shapes import Domain
from ...meshing.elements import Space
from ...meshing.footprints import AbstractFootprint
from ...messages.kinds import is_number, shown
from ...registry import Registry
from ...toml import TomlTable


class ElectrodeError(ValueError):
    """An electrode that cannot be built on this sheet or mesh."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """The part of a function space that one electrode touches.

    | meaning                                         | shape  | unit   |
    |-------------------------------------------------|--------|--------|
    | dofs of each triangle or boundary edge touched  | (p, k) |        |
    | mass: integrals of phi_i phi_j over each        | (p, k, k) | m^2 or m |
    """

    dofs: np.ndarray
    mass: np.ndarray


class ElectrodeDrawing(NamedTuple):
    """What pictures show of an electrode, in the sheet's flat coordinates; without either, a mark at its centre.

    | meaning                                                            | shape        | unit |
    |--------------------------------------------------------------------|--------------|------|
    | outlines: closed polygons to scale, the rim and then each hole     | (corners, 2) | m    |
    | edge: the stretch of the sheet's edge that the electrode covers    | (points, 2)  | m    |
    """

    outlines: tuple[np.ndarray, ...] = ()
    edge: np.ndarray | None = None


class AbstractElectrode(ABC):
    """One terminal.  ``contact`` is its specific contact resistance; 0 means a perfect contact.

    ``name`` is the ``kind`` of such electrodes in a skin file.
    """

    name: ClassVar[str]
    contact: float

    @abstractmethod
    def footprint(self, segments: int) -> AbstractFootprint:
        """The outline that the mesh must follow, with ``segments`` sides for a disc."""

    @abstractmethod
    def pieces(self, space: Space, domain: Domain) -> Pieces:
        """The parts of the space that the electrode touches.

        Raises:
            ElectrodeError: if the mesh does not follow the electrode.
        """

    def elements(self, space: Space) -> np.ndarray:
        """Numbers of the triangles under the electrode, (triangles,); none for an electrode without area."""
        return np.zeros(0, int)

    def lumped_radius(self, space: Space, sheet_resistance: float) -> float:
        """Radius in m of the disc whose contact is taken in closed form because the mesh does not
        resolve it; 0 where the mesh does, or where there is no closed form."""
        return 0.0

    @abstractmethod
    def centre(self, domain: Domain) -> np.ndarray:
        """Middle of the electrode in the sheet's flat coordinates, (2,) m."""

    def drawing(self, domain: Domain) -> ElectrodeDrawing:
        """What pictures show: a mark at the centre, unless the class gives outlines or a stretch of the edge."""
        return ElectrodeDrawing()

    @classmethod
    @abstractmethod
    def read(cls, table: TomlTable, domain: Domain) -> tuple["AbstractElectrode", ...]:
        """The electrodes that the table ``[electrodes]`` of a skin file describes.

        Raises:
            TomlError: naming the key and the reason.
        """


class AbstractAreaElectrode(AbstractElectrode):
    """An electrode whose current enters the sheet under its whole area."""

    @abstractmethod
    def elements(self, space: Space) -> np.ndarray:
        """Numbers of the triangles under the electrode, (triangles,)."""

    def pieces(self, space: Space, domain: Domain) -> Pieces:
        inside = self.elements(space)
        return Pieces(space.dofs[inside], space.element_mass(inside))


ELECTRODES = Registry(AbstractElectrode, "electrode", "jaxeit.electrodes")
"""Electrodes by the names that skin files use as ``kind``."""


class DiscreteElectrode(NamedTuple):
    """One electrode on a function space.

    | meaning                                                      | shape | unit |
    |--------------------------------------------------------------|-------|------|
    | pieces that the electrode touches                            |       |      |
    | lumped: radius of the disc whose contact is in closed form, or 0 | () | m   |
    | elements: triangles under that disc                          | (n,)  |      |
    | contact: specific contact resistance                         | ()    | ohm m^2 or ohm m |
    """

    pieces: Pieces
    lumped: float
    elements: np.ndarray
    contact: float


def discrete_electrodes(
    electrodes: Sequence[AbstractElectrode], space: Space, domain: Domain, sheet_resistance: float
) -> list[DiscreteElectrode]:
    """Each of these electrodes on a function space.

    Raises:
        ElectrodeError: if the mesh does not follow an electrode.
    """
    out = []
    for electrode in electrodes:
        pieces, lumped = electrode.pieces(space, domain), electrode.lumped_radius(space, sheet_resistance)
        under = electrode.elements(space) if lumped else np.zeros(0, int)
        out.append(DiscreteElectrode(pieces, lumped, under, electrode.contact))
    return out


def require_positive(**values: float) -> None:
    """Raise ElectrodeError, with the name of the value, unless every value is a positive number."""
    for name, value in values.items():
        if not (is_number(value) and np.isfinite(value) and value > 0):
            raise ElectrodeError(f"an electrode's {name} is {shown(value)}; give a positive number")


def require_contact(value: float, unit: str) -> None:
    """Raise ElectrodeError for a contact resistance that is neither zero nor a positive number."""
    if not (is_number(value) and np.isfinite(value) and value >= 0):
        raise ElectrodeError(
            f"an electrode's contact is {shown(value)} {unit}; give zero (perfect) or a positive number"
        )


def require_covered(space: Space, elements: np.ndarray, area: float, what: str) -> None:
    """Raise ElectrodeError unless these triangles cover at least half of ``area``, m^2."""
    if not len(elements):
        raise ElectrodeError(f"the mesh has no triangle under {what}")
    covered = space.mesh.areas[elements].sum() / area
    if covered < 0.5:
        raise ElectrodeError(
            f"the mesh covers {100 * covered:.0f} % of {what}; move it inside the sheet, or make the mesh finer there"
        )
