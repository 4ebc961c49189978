"""jaxeit: from what an EIT-pneumatic robot skin records to force maps in newtons.

Nouns are frozen pytrees, verbs are pure jitted functions, choices are objects, and physics that is
not in the scene is not in the program.
"""

from importlib import metadata

from .basis import BasisMap, Elements, Pixels
from .discretise import Model, discretise, make_mesh
from .domain import Disc, Polygon, Rectangle
from .effects import (
    EFFECTS,
    AbstractEffect,
    AbstractPadEffect,
    AbstractReadoutEffect,
    BaselineDrift,
    CoatingNonUniformity,
    ContactGain,
    ContactPiezoresistance,
    LoadSpreading,
    Noise,
    PadEdgeDip,
    Quantisation,
    Stream,
    fold,
)
from .electrodes import AreaPatch, BoundaryPatch, ElectrodeError, PointElectrode, PolygonPatch, disc_resistance
from .fidelity import Fidelity, FidelityError
from .forward import conductivity, forward, load_spread
from .fusion import ForceMap, FusionError, PadMasks, fuse, pad_masks
from .inverse import InverseError, OneStep, Reconstructor, prepare
from .jacobian import jacobian
from .mesh import Mesh, MeshError, Pattern, structured, triangulate
from .metrics import (
    ESTIMATORS,
    LevelCentroid,
    Peak,
    PositiveCentroid,
    coefficient_of_variation,
    image_sum,
    inward_bias,
    localisation_error,
)
from .pneumatics import pad_response
from .priors import Noser, Tikhonov
from .protocol import Protocol, adjacent, reciprocal_rows
from .scene import Scene, read_effects
from .skin import Pad, PressureSensor, Skin, load_skin, parse_skin, shipped_skins
from .solvers import ConjugateGradient, Dense, NestedDissection, Single
from .surface import AbstractSurface, Cylinder, Sphere
from .toml import TomlError, TomlTable, parse_toml, read_text
from .verbs import compiler_options

__version__ = metadata.version("jaxeit")

__all__ = [
    "EFFECTS",
    "ESTIMATORS",
    "AbstractEffect",
    "AbstractPadEffect",
    "AbstractReadoutEffect",
    "AbstractSurface",
    "AreaPatch",
    "BaselineDrift",
    "BasisMap",
    "BoundaryPatch",
    "CoatingNonUniformity",
    "ConjugateGradient",
    "ContactGain",
    "ContactPiezoresistance",
    "Cylinder",
    "Dense",
    "Disc",
    "ElectrodeError",
    "Elements",
    "Fidelity",
    "FidelityError",
    "ForceMap",
    "FusionError",
    "InverseError",
    "LevelCentroid",
    "LoadSpreading",
    "Mesh",
    "MeshError",
    "Model",
    "NestedDissection",
    "Noise",
    "Noser",
    "OneStep",
    "Pad",
    "PadEdgeDip",
    "PadMasks",
    "Pattern",
    "Peak",
    "Pixels",
    "PointElectrode",
    "Polygon",
    "PolygonPatch",
    "PositiveCentroid",
    "PressureSensor",
    "Protocol",
    "Quantisation",
    "Reconstructor",
    "Rectangle",
    "Scene",
    "Single",
    "Skin",
    "Sphere",
    "Stream",
    "Tikhonov",
    "TomlError",
    "TomlTable",
    "adjacent",
    "coefficient_of_variation",
    "compiler_options",
    "conductivity",
    "disc_resistance",
    "discretise",
    "fold",
    "forward",
    "fuse",
    "image_sum",
    "inward_bias",
    "jacobian",
    "load_skin",
    "load_spread",
    "localisation_error",
    "make_mesh",
    "pad_masks",
    "pad_response",
    "parse_skin",
    "parse_toml",
    "prepare",
    "read_effects",
    "read_text",
    "reciprocal_rows",
    "shipped_skins",
    "structured",
    "triangulate",
]
