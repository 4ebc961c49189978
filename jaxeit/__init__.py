"""jaxeit: from what an EIT-pneumatic robot skin records to force maps in newtons.

Nouns are frozen pytrees, verbs are pure jitted functions, choices are objects, and physics that is
not in the scene is not in the program.
"""

from importlib import metadata

from .basis import BasisMap, Bumps, Elements, Picture, Pixels
from .contacts import ContactFinder, ContactResult, Contacts, prepare_contacts, refine_contacts, strongest
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
from .hyperparameter import (
    Discrepancy,
    GeneralisedCrossValidation,
    HyperparameterError,
    LCurve,
    NoiseFigure,
)
from .inverse import InverseError, IterativeReconstructor, Reconstructor, noise_covariance, prepare
from .jacobian import jacobian
from .mesh import Mesh, MeshError, Pattern, structured, triangulate
from .methods import BackProjection, Greit, NonNegative, OneStep, Reweighted, SparseBayes, TruncatedSvd
from .metrics import (
    ESTIMATORS,
    GreitFigures,
    LevelCentroid,
    MetricError,
    Peak,
    Pictured,
    PositiveCentroid,
    coefficient_of_variation,
    greit_figures,
    image_correlation,
    image_sum,
    inward_bias,
    ktc_score,
    localisation_error,
    otsu_thresholds,
    structural_similarity,
)
from .nonlinear import IsotropicVariation, LogConductivity, Quadratic, gauss_newton
from .pneumatics import pad_response
from .priors import GaussianSmooth, Laplace, Noser, Tikhonov, TotalVariation
from .protocol import Protocol, adjacent, reciprocal_rows
from .regions import RegionError, Regions, find_regions
from .scene import Scene, read_effects
from .skin import Pad, PressureSensor, Skin, load_skin, parse_skin, shipped_skins
from .solvers import ConjugateGradient, Dense, NestedDissection, Single
from .store import NUMBERS, StoreError, from_numbers, load_reconstructor, save_reconstructor, to_numbers
from .surface import AbstractSurface, Cylinder, Sphere
from .toml import TomlError, TomlTable, parse_toml, read_text
from .verbs import compiler_options

__version__ = metadata.version("jaxeit")

__all__ = [
    "EFFECTS",
    "ESTIMATORS",
    "NUMBERS",
    "AbstractEffect",
    "AbstractPadEffect",
    "AbstractReadoutEffect",
    "AbstractSurface",
    "AreaPatch",
    "BackProjection",
    "BaselineDrift",
    "BasisMap",
    "BoundaryPatch",
    "Bumps",
    "CoatingNonUniformity",
    "ConjugateGradient",
    "ContactFinder",
    "ContactGain",
    "ContactPiezoresistance",
    "ContactResult",
    "Contacts",
    "Cylinder",
    "Dense",
    "Disc",
    "Discrepancy",
    "ElectrodeError",
    "Elements",
    "Fidelity",
    "FidelityError",
    "ForceMap",
    "FusionError",
    "GaussianSmooth",
    "GeneralisedCrossValidation",
    "Greit",
    "GreitFigures",
    "HyperparameterError",
    "InverseError",
    "IsotropicVariation",
    "IterativeReconstructor",
    "LCurve",
    "Laplace",
    "LevelCentroid",
    "LoadSpreading",
    "LogConductivity",
    "Mesh",
    "MeshError",
    "MetricError",
    "Model",
    "NestedDissection",
    "Noise",
    "NoiseFigure",
    "NonNegative",
    "Noser",
    "OneStep",
    "Pad",
    "PadEdgeDip",
    "PadMasks",
    "Pattern",
    "Peak",
    "Picture",
    "Pictured",
    "Pixels",
    "PointElectrode",
    "Polygon",
    "PolygonPatch",
    "PositiveCentroid",
    "PressureSensor",
    "Protocol",
    "Quadratic",
    "Quantisation",
    "Reconstructor",
    "Rectangle",
    "RegionError",
    "Regions",
    "Reweighted",
    "Scene",
    "Single",
    "Skin",
    "SparseBayes",
    "Sphere",
    "StoreError",
    "Stream",
    "Tikhonov",
    "TomlError",
    "TomlTable",
    "TotalVariation",
    "TruncatedSvd",
    "adjacent",
    "coefficient_of_variation",
    "compiler_options",
    "conductivity",
    "disc_resistance",
    "discretise",
    "find_regions",
    "fold",
    "forward",
    "from_numbers",
    "fuse",
    "gauss_newton",
    "greit_figures",
    "image_correlation",
    "image_sum",
    "inward_bias",
    "jacobian",
    "ktc_score",
    "load_reconstructor",
    "load_skin",
    "load_spread",
    "localisation_error",
    "make_mesh",
    "noise_covariance",
    "otsu_thresholds",
    "pad_masks",
    "pad_response",
    "parse_skin",
    "parse_toml",
    "prepare",
    "prepare_contacts",
    "read_effects",
    "read_text",
    "reciprocal_rows",
    "refine_contacts",
    "save_reconstructor",
    "shipped_skins",
    "strongest",
    "structural_similarity",
    "structured",
    "to_numbers",
    "triangulate",
]
