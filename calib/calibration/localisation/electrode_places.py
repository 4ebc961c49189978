"""Electrodes put where the presses of a session tell that they sit."""

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.imaging import ElectrodeFit, InverseError, KnownPresses, fit_electrodes

from ...presses.pooled import PooledPresses
from .spread import farthest_first

# The errors of a mesh of first order would be taken for shifts of electrodes.
FIDELITY = je.Fidelity(order=2, edge_length=je.Fidelity.draft().edge_length)
MOST_PRESSES = 16  # more tell little more, and each costs as long
# Of the root mean square misfit in stated errors: beyond it, the skin is another one than its file says.
LARGEST_MISFIT = 3.0


def place_electrodes(skin: je.Skin, presses: PooledPresses) -> tuple[je.Skin, str]:
    """The skin with its electrodes where untouched frames and presses tell that they sit, and a note for the operator.

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
    model = je.discretise(je.Scene(skin), FIDELITY)
    fit = fit_electrodes(model, np.where(presses.channels, presses.untouched, np.nan), known)
    if not float(fit.misfit) < LARGEST_MISFIT:
        raise InverseError(
            f"no places of the electrodes explain the presses: what is left is {float(fit.misfit):.2g} times the "
            "stated errors; check the skin's file and the places of the presses, or leave out fit_electrodes"
        )
    there = je.skin.with_positions(skin, skin.electrode_positions + np.asarray(fit.shift, float))
    return there, _note(fit, len(chosen))


def spread_presses(position: np.ndarray) -> np.ndarray:
    """Rows (n,) of at most `MOST_PRESSES` presses with a place, each far from those taken before."""
    placed = np.flatnonzero(np.isfinite(position).all(1))
    if not len(placed):
        return placed
    taken, gaps = farthest_first(position[placed], MOST_PRESSES)
    rows: np.ndarray = placed[taken[gaps > 0]]
    return rows


def _note(fit: ElectrodeFit, presses: int) -> str:
    far = np.linalg.norm(np.asarray(fit.shift), axis=1)
    worst = int(np.argmax(far))
    typical, error = (1e3 * float(jnp.sqrt(jnp.mean(jnp.square(v)))) for v in (fit.shift, fit.standard_error))
    return (
        f"electrodes: moved by {typical:.2g} mm in each direction (root mean square), electrode {worst} by "
        f"{1e3 * far[worst]:.2g} mm; known to {error:.2g} mm, from {presses} presses"
    )
