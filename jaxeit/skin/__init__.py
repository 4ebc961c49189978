"""The hardware of a skin: electrodes, protocol, pads and pressure sensors, read from one TOML file.

Example:
    import numpy as np

    import jaxeit as je

    print(je.skin.shipped_skins())  # names for je.load_skin

    sheet = je.Rectangle(0.12, 0.08)  # m
    bolts = tuple(je.AreaPatch((x, y), radius=0.003) for y in (0.02, 0.06) for x in (0.02, 0.06, 0.1))
    scan = je.Protocol(je.skin.adjacent(6), current=1e-3, reading_time=1e-5)
    square = np.array([[0, 0], [0.06, 0], [0.06, 0.08], [0, 0.08]])  # m
    pads = (je.Pad("left", square), je.Pad("right", square + np.array([0.06, 0])))
    skin = je.Skin("patch", sheet, 150.0, bolts, scan, pads, je.skin.PressureSensor(maximum=34474.0))
    print(f"{scan.readings} readings in {1e3 * scan.frame_time:.2f} ms; {len(skin.pads)} pads")
"""

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
from .electrodes.base import (
    ELECTRODES,
    AbstractAreaElectrode,
    AbstractElectrode,
    ElectrodeDrawing,
    ElectrodeError,
    Pieces,
)
from .electrodes.bolts import AreaPatch
from .electrodes.edges import BoundaryPatch
from .electrodes.points import PointElectrode
from .electrodes.polygons import PolygonPatch, RectanglePatch
from .electrodes.rims import rim_electrodes
from .electrodes.rings import RingPatch
from .identity import skin_hash
from .patterns import adjacent, all_pairs, eidors_adjacent, named_pattern, named_protocol, opposite, skip, trigonometric
from .protocol import Protocol, ProtocolError, reciprocal_rows
from .rewriting import with_positions, with_rows

__all__ = [
    "ELECTRODES",
    "AbstractAreaElectrode",
    "AbstractElectrode",
    "AreaPatch",
    "BoundaryPatch",
    "ElectrodeDrawing",
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
