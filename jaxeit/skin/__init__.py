"""The hardware of a skin: electrodes, protocol, pads and pressure sensors, read from one TOML file."""

from .bolts import AreaPatch
from .description import (
    Pad,
    PressureSensor,
    Skin,
    SkinError,
    load_skin,
    pad_overlap,
    parse_skin,
    shipped_skins,
)
from .edges import BoundaryPatch
from .electrodes import ELECTRODES, AbstractAreaElectrode, AbstractElectrode, ElectrodeError, Pieces
from .identity import skin_hash
from .patterns import adjacent, all_pairs, eidors_adjacent, named_pattern, named_protocol, opposite, skip, trigonometric
from .points import PointElectrode
from .polygons import PolygonPatch, RectanglePatch
from .protocol import Protocol, ProtocolError, reciprocal_rows
from .rewriting import with_positions, with_rows
from .rims import rim_electrodes
from .rings import RingPatch

__all__ = [
    "ELECTRODES",
    "AbstractAreaElectrode",
    "AbstractElectrode",
    "AreaPatch",
    "BoundaryPatch",
    "ElectrodeError",
    "Pad",
    "Pieces",
    "PointElectrode",
    "PolygonPatch",
    "PressureSensor",
    "Protocol",
    "ProtocolError",
    "RectanglePatch",
    "RingPatch",
    "Skin",
    "SkinError",
    "adjacent",
    "all_pairs",
    "eidors_adjacent",
    "load_skin",
    "named_pattern",
    "named_protocol",
    "opposite",
    "pad_overlap",
    "parse_skin",
    "reciprocal_rows",
    "rim_electrodes",
    "shipped_skins",
    "skin_hash",
    "skip",
    "trigonometric",
    "with_positions",
    "with_rows",
]
