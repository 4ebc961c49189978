"""The accuracy of a computation; `jaxeit.accuracy` tabulates its cost in time."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..linalg import AbstractLinearSolver
from ..meshing.elements import BY_ORDER
from ..messages.kinds import is_number, require_kind, shown, stated


class FidelityError(ValueError):
    """A fidelity that is not possible; the message names the field and says what to give."""


@dataclass(frozen=True)
class Fidelity:
    """All settings that trade accuracy for time, independent of the physics.

    | meaning                                                                | unit             |
    |------------------------------------------------------------------------|------------------|
    | edge_length: longest triangle edge aimed at, away from electrodes      | sqrt(sheet area) |
    | order: 1 (linear) or 2 (quadratic) elements                            |                  |
    | dtype: float64 or float32                                              |                  |
    | electrode_segments: sides of the polygon that stands for a bolt        |                  |
    | growth: largest ratio of edge lengths from one ring to the next        |                  |
    | solver: a linear solver, or None to choose by the number of unknowns   |                  |
    | interpolation: error of simulated frames joined from few solves, over  |                  |
    |   the largest change of their press; 0: every frame is solved          |                  |

    ``edge_length`` is relative so that one fidelity means the same on a 60 mm tank and a 280 mm
    chest: 0.025 is 5 mm on the 200 mm testbed.

    Raises:
        FidelityError: for a value outside its range.
    """

    edge_length: float = 0.03
    order: int = 1
    dtype: Any = np.float64
    electrode_segments: int = 16
    growth: float = 1.3
    solver: AbstractLinearSolver | None = field(default=None)
    interpolation: float = 1e-4

    def __post_init__(self) -> None:
        object.__setattr__(self, "dtype", _float(self.dtype))
        self._require("edge_length", lambda length: 0 < length <= 0.25, "0.001 to 0.25")
        self._require("order", lambda order: order in BY_ORDER, f"one of {sorted(BY_ORDER)}")
        self._require("electrode_segments", lambda sides: 6 <= sides <= 4096, "6 to 4096")
        self._require("growth", lambda ratio: 1.05 <= ratio <= 2, "1.05 to 2")
        self._require("interpolation", lambda error: 0 <= error <= 0.1, "0 to 0.1")
        if self.solver is not None:
            give = "None, or an object, such as solver=jaxeit.linalg.Dense()"
            require_kind(self.solver, AbstractLinearSolver, FidelityError, "a linear solver", give, "solver")

    def _require(self, name: str, holds: Callable[[Any], bool], give: str) -> None:
        """Refuse a field that is no number, or one out of its range."""
        value = getattr(self, name)
        if not is_number(value) or not holds(value):
            raise FidelityError(f"{name} is {shown(value)}; give {give}")

    @classmethod
    def draft(cls, **changes: Any) -> "Fidelity":
        """A coarse, linear fidelity for first results; ``changes`` replace fields."""
        return replace(cls(edge_length=0.06, electrode_segments=8, growth=1.6), **changes)

    @classmethod
    def standard(cls, **changes: Any) -> "Fidelity":
        """The fidelity for calibration and images; ``changes`` replace fields."""
        return replace(cls(), **changes)

    @classmethod
    def reference(cls, **changes: Any) -> "Fidelity":
        """A fine, quadratic fidelity that shows the errors of the others; ``changes`` replace fields."""
        return replace(cls(edge_length=0.015, order=2, electrode_segments=32), **changes)


def _float(dtype: Any) -> np.dtype:
    try:
        wanted: np.dtype = np.dtype(dtype)
    except TypeError:
        raise FidelityError(f"dtype is {stated(dtype)}; give float64 or float32") from None
    if wanted not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise FidelityError(f"dtype is {wanted}; give float64 or float32")
    return wanted


def require_dtype(dtype: np.dtype, what: str = "float64 is asked for") -> None:
    """Raise an error for a precision that JAX would silently lower; ``what`` begins the message.

    Raises:
        FidelityError: for float64 while JAX's x64 mode is off.
    """
    if dtype == np.float64 and jnp.result_type(float) != np.float64:
        raise FidelityError(
            f"{what}, but JAX is in 32-bit mode; before making any array call "
            'jax.config.update("jax_enable_x64", True), or ask for Fidelity(dtype="float32")'
        )
