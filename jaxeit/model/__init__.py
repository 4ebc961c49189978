"""From a scene and a fidelity to voltages, and their derivatives with respect to the sheet conductivity."""

from .bases import (
    BASES,
    AbstractBasis,
    AbstractPictured,
    BasisError,
    BasisMap,
    Bumps,
    Elements,
    Picture,
    Pixels,
)
from .discretisation import Model, discretise, expected_mesh_nodes, make_mesh
from .fidelity import Fidelity, FidelityError
from .forward_model import CoatedSheet, DerivativeError, conductivity, forward, load_spread, rounding
from .motion import Motion, MotionError, electrode_motion, moved, shift_jacobian
from .pneumatics import pad_response
from .scene import Scene, SceneError, read_effects
from .sensitivity import jacobian
from .system import System

__all__ = [
    "BASES",
    "AbstractBasis",
    "AbstractPictured",
    "BasisError",
    "BasisMap",
    "Bumps",
    "CoatedSheet",
    "DerivativeError",
    "Elements",
    "Fidelity",
    "FidelityError",
    "Model",
    "Motion",
    "MotionError",
    "Picture",
    "Pixels",
    "Scene",
    "SceneError",
    "System",
    "conductivity",
    "discretise",
    "electrode_motion",
    "expected_mesh_nodes",
    "forward",
    "jacobian",
    "load_spread",
    "make_mesh",
    "moved",
    "pad_response",
    "read_effects",
    "rounding",
    "shift_jacobian",
]
