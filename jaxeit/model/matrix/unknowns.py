"""The numbering of the unknowns, which are potentials of sheet and electrodes.

The potentials are ``u`` of the sheet and ``U`` of the complete electrodes.  Solving for u and U
directly fails for extreme contacts: at small contact resistance u and U differ by less than rounding,
and at large resistance the reverse substitution subtracts.  Under each electrode we substitute

    u = w + s U chi,        s = G_c / (G_c + G_s)

and solve for ``w`` and ``U``, where chi is one on the nodes under the electrode, G_c its contact
conductance and G_s = chi^T K chi that of the sheet around it.  The diagonal entry of U becomes the
conductance of the two in series, no entry is formed by subtraction, and after diagonal scaling the
matrix is well conditioned from a perfect contact to none.  (Derived here; a congruence, so the
matrix stays symmetric positive definite.)

Potentials are determined up to a constant, so one unknown is grounded, through a conductance as large as
its own, which affects the constant only.  The conductivities determine which one, since all potentials are
then relative to that place (`forward_model.assemble`): from a ground in a tear of the sheet, which hardly
conducts, readings would be the last digits of far larger numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...meshing.elements import Space
from ...skin.electrodes.base import DiscreteElectrode, ElectrodeError

RIM_PENALTY = 10.0
"""Sets the fall of the ground weight with the distance from the middle of the sheet: the resistance to the rest of the
sheet grows with it."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The numbering of the unknowns.

    | meaning                                                       | shape                  |
    |---------------------------------------------------------------|------------------------|
    | index: unknown of each dof of the space, then of each electrode | (dofs + electrodes,) |
    | count of unknowns                                             | ()                     |
    | coords: places of the unknowns, m; NaN for electrodes         | (unknowns, 2)          |
    | electrode: unknown that is each electrode's potential         | (electrodes,)          |
    | ground: unknowns that may be grounded                         | (g,)                   |
    | ground_weight: suitability of each                            | (g,)                   |
    | complete: electrodes with unknown contact, by their numbers   |                        |
    """

    index: np.ndarray
    count: int
    coords: np.ndarray
    electrode: np.ndarray
    ground: np.ndarray
    ground_weight: np.ndarray
    complete: list[int]


def number_unknowns(space: Space, touched: Sequence[DiscreteElectrode], ground: int | None) -> Unknowns:
    """The numbering for a space under these electrodes.

    Args:
        ground: the mesh node held at zero volts; None: chosen by the conductivities.

    Raises:
        ElectrodeError: for electrodes that share a node, or a ground that is under an electrode.
    """
    dofs = len(space.points)
    alias, owner = np.arange(dofs + len(touched)), np.full(dofs, -1)
    complete = []
    for number, electrode in enumerate(touched):
        patch = np.unique(electrode.pieces.dofs)
        _assign_nodes(owner, patch, number)
        if electrode.contact > 0 and not electrode.lumped:
            complete.append(number)
        else:  # a perfect contact, or one in series: the whole electrode has one potential
            alias[patch] = alias[dofs + number] = patch[0]
    names, index = np.unique(alias, return_inverse=True)
    places = np.concatenate([space.chart, np.full((len(touched), 2), np.nan)])
    grounded, weight = _grounds(space, np.isin(owner, complete), len(touched), ground)
    return Unknowns(index, len(names), places[names], index[dofs:], index[grounded], weight, complete)


def _assign_nodes(owner: np.ndarray, patch: np.ndarray, number: int) -> None:
    taken = owner[patch] >= 0
    if taken.any():
        other = int(owner[patch][taken][0])
        raise ElectrodeError(
            f"electrodes {other} and {number} touch the same mesh node; move them apart or make the mesh finer"
        )
    owner[patch] = number


def _grounds(space: Space, covered: np.ndarray, electrodes: int, ground: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Unknowns that may be grounded, and the suitability of each: dofs that no complete electrode covers, best in the
    middle of the sheet; if electrodes cover all dofs, the electrodes."""
    if ground is None:
        if covered.all():
            return len(covered) + np.arange(electrodes), np.ones(electrodes)
        away = np.linalg.norm(space.chart - space.chart.mean(0), axis=1) / np.ptp(space.chart)
        return np.flatnonzero(~covered), 1 / (1 + RIM_PENALTY * away[~covered] ** 2)
    if not (0 <= ground < len(covered)) or covered[ground]:
        raise ElectrodeError(f"node {ground} cannot be the ground: it is under an electrode")
    return np.array([ground]), np.ones(1)
