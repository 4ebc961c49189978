"""The accuracy of a computation; `jaxeit.accuracy` tabulates its cost in time."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..linalg import AbstractLinearSolver
from ..meshing.elements import BY_ORDER


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
        if not 0 < self.edge_length <= 0.25:
            raise FidelityError(f"edge_length is {self.edge_length}; give 0.001 to 0.25")
        if self.order not in BY_ORDER:
            raise FidelityError(f"order is {self.order}; give one of {sorted(BY_ORDER)}")
        if not 6 <= self.electrode_segments <= 4096:
            raise FidelityError(f"electrode_segments is {self.electrode_segments}; give 6 to 4096")
        if not 1.05 <= self.growth <= 2:
            raise FidelityError(f"growth is {self.growth}; give 1.05 to 2")
        if not 0 <= self.interpolation <= 0.1:
            raise FidelityError(f"interpolation is {self.interpolation}; give 0 to 0.1")

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
    wanted: np.dtype = np.dtype(dtype)
    if wanted not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise FidelityError(f"dtype is {wanted}; give float64 or float32")
    return wanted


def require_dtype(dtype: np.dtype) -> None:
    """Raise an error for a precision that JAX would silently lower.

    Raises:
        FidelityError: for float64 while JAX's x64 mode is off.
    """
    if dtype == np.float64 and jnp.result_type(float) != np.float64:
        raise FidelityError(
            "float64 is asked for, but JAX is in 32-bit mode; before making any array call "
            'jax.config.update("jax_enable_x64", True), or ask for Fidelity(dtype="float32")'
        )
