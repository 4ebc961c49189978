"""Electrodes put where the presses of a session tell that they sit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.imaging import InverseError, KnownPresses, fit_electrodes

from ...check.electrodes import ELECTRODE_FIDELITY, LARGEST_MISFIT
from ...presses.pooled import PooledPresses
from ..archives.arrays import shaped
from .farthest_points import farthest_first

MOST_PRESSES = 16  # more tell little more, and each costs as long


@dataclass(frozen=True, eq=False)
class PlacedElectrodes:
    """How far the electrodes sit from where the skin's file said, as a calibration found.

    | meaning                                                                 | shape                        | unit |
    |-------------------------------------------------------------------------|------------------------------|------|
    | shift: from the place in the skin's file to that in the calibration     | (electrodes, 2)              | m    |
    | covariance: of all shifts, those of an electrode side by side           | (2 electrodes, 2 electrodes) | m^2  |
    | misfit: root mean square of what is left of the readings, in their errors | ()                         | 1    |
    | presses: number of presses that told it                                 | ()                           | 1    |
    """

    shift: np.ndarray
    covariance: np.ndarray
    misfit: float
    presses: int

    @property
    def standard_error(self) -> np.ndarray:
        """Of each shift, (electrodes, 2) m."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)).reshape(self.shift.shape))

    @property
    def note(self) -> str:
        """What the operator is told."""
        far = np.linalg.norm(self.shift, axis=1)
        worst = int(np.argmax(far))
        typical, error = (1e3 * float(np.sqrt(np.mean(np.square(v)))) for v in (self.shift, self.standard_error))
        return (
            f"electrodes: moved by {typical:.2g} mm in each direction (root mean square), electrode {worst} by "
            f"{1e3 * far[worst]:.2g} mm; known to {error:.2g} mm, from {self.presses} presses"
        )

    def arrays(self) -> dict[str, tuple[Any, str, str]]:
        """The arrays by their names in the file, each with unit and meaning."""
        return {f"electrodes/{name}": (getattr(self, name), *about) for name, about in _ARRAYS.items()}

    @staticmethod
    def restore(arrays: Mapping[str, np.ndarray], electrodes: int) -> "PlacedElectrodes | None":
        """The electrodes of a file; None if it places none. Raises KeyError or ValueError for what does not fit."""
        if "electrodes/shift" not in arrays:
            return None
        both = 2 * electrodes
        shapes = {"shift": (electrodes, 2), "covariance": (both, both), "misfit": ()}
        found = {name: shaped(arrays, f"electrodes/{name}", shape, "f") for name, shape in shapes.items()}
        for name, array in found.items():
            if not np.isfinite(array).all():
                raise ValueError(f"electrodes/{name} holds a number that is not finite")
        presses = int(shaped(arrays, "electrodes/presses", (), "iu"))
        return PlacedElectrodes(found["shift"], found["covariance"], float(found["misfit"]), presses)


_ARRAYS = {
    "shift": ("m", "of each electrode from its place in the skin's file to that in the calibration"),
    "covariance": ("m2", "of all shifts, those of an electrode side by side"),
    "misfit": ("1", "root mean square of what is left of the readings, in their errors"),
    "presses": ("1", "number of presses that told the shifts"),
}


def place_electrodes(skin: je.Skin, presses: PooledPresses) -> tuple[je.Skin, PlacedElectrodes]:
    """The skin with its electrodes where untouched frames and presses tell that they sit, and how far that is.

    The presses' places must be right: a stage that is off as a whole moves all electrodes with it.

    Raises:
        InverseError: if no places of the electrodes explain what was read.
        MotionError: if the electrodes cannot be moved.
        TomlError: if the text of the skin gives no positions of electrodes.
    """
    chosen = spread_presses(presses.position)
    change = np.where(presses.channels, presses.dv[chosen], np.nan)
    noise = np.where(np.isfinite(presses.noise), presses.noise, 1.0)  # of readings that were never finite: any
    known = KnownPresses(jnp.asarray(change), jnp.asarray(presses.position[chosen]), jnp.asarray(noise))
    model = je.discretise(je.Scene(skin), ELECTRODE_FIDELITY)
    fit = fit_electrodes(model, np.where(presses.channels, presses.untouched, np.nan), known)
    if not float(fit.misfit) < LARGEST_MISFIT:
        raise InverseError(
            f"no places of the electrodes explain the presses: what is left is {float(fit.misfit):.2g} times the "
            "stated errors; check the skin's file and the places of the presses, or leave out fit_electrodes"
        )
    there = je.skin.with_positions(skin, skin.electrode_positions + np.asarray(fit.shift, float))
    shift, covariance = np.asarray(fit.shift, float), np.asarray(fit.covariance, float)
    return there, PlacedElectrodes(shift, covariance, float(fit.misfit), len(chosen))


def spread_presses(position: np.ndarray) -> np.ndarray:
    """Rows (n,) of at most `MOST_PRESSES` presses with a place, each far from those taken before."""
    placed = np.flatnonzero(np.isfinite(position).all(1))
    if not len(placed):
        return placed
    taken, gaps = farthest_first(position[placed], MOST_PRESSES)
    rows: np.ndarray = placed[taken[gaps > 0]]
    return rows
