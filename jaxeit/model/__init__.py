"""From a scene and a fidelity to voltages, and their derivatives with respect to the sheet conductivity.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    effects = (je.effects.LoadSpreading(), je.effects.ContactPiezoresistance())
    fidelity = je.Fidelity.draft()
    je.model.require_dtype(fidelity.dtype)  # float64, for which JAX must be in 64-bit mode
    print(je.model.expected_mesh_nodes(skin, fidelity), "nodes")
    model = je.discretise(je.Scene(skin, effects), fidelity)

    # Pa: 10 N under a tip of 20 mm
    pressure = 10.0 * je.model.load_spread(model, jnp.array([0.06, 0.13]), 0.02)
    dv = je.forward(model, je.conductivity(model, pressure)) - je.forward(model)  # V
    gage = je.pad_response(skin, model) @ pressure  # Pa in each pad
    J = je.jacobian(model, basis=je.Bumps(20))  # V/S, (readings, bumps)
    lost = je.model.rounding(model)  # V
    print(f"{1e3 * jnp.abs(dv).max():.2f} mV, {gage.max():.0f} Pa; rounding {lost.max():.1e} V")
"""

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
from .fidelity import Fidelity, FidelityError, require_dtype
from .forward_model import DerivativeError, forward, rounding
from .matrix.system import System
from .motion import Motion, MotionError, electrode_motion, moved, shift_jacobian
from .pneumatics import pad_response
from .scene import Scene, SceneError, read_effects
from .sensitivity import jacobian
from .sheet_conductivity import CoatedSheet, conductivity, load_spread

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
    "require_dtype",
    "rounding",
    "shift_jacobian",
]
