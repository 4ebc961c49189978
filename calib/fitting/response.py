"""The response of a skin to presses: choice and fit of curves and field, and their predictions of held-out presses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import jaxeit as je

from ..presses.pooled import PressData
from .curves.base import AbstractCurve
from .curves.elementary import Linear
from .curves.fitted import FittedCurve
from .fields.base import AbstractField
from .fields.geometry import geometry_of
from .fields.places import Places, single_places
from .held_out import Split, folds_by_place, hold_out, hold_out_image, leave_out
from .losses import AbstractLoss
from .pads import Hybrid, LocatedPresses, fit_hybrid
from .results import FitError, FitResult
from .selection import Choice, choose


class FittingProblem(NamedTuple):
    """The presses to fit, and how to fit and divide them.

    | meaning                                                     | shape      |
    |-------------------------------------------------------------|------------|
    | presses: the presses with their places                      |            |
    | loss: robust loss of the curve fits                         |            |
    | fold: fold of each press, the same for all at one place     | (presses,) |
    """

    presses: LocatedPresses
    loss: AbstractLoss
    fold: np.ndarray


@dataclass(frozen=True, eq=False)
class PadResponse:
    """The curve and field that were chosen, fitted to all presses.

    ``baseline`` holds the curves of the paper's recipe beside them: `Linear`, without a field.
    """

    choice: Choice
    hybrid: Hybrid
    baseline: FittedCurve


class HeldOutForces(NamedTuple):
    """Forces over the holds, predicted by fits without the place of the press.

    | meaning                                                              | shape           | unit |
    |----------------------------------------------------------------------|-----------------|------|
    | pad_force: of each pad, by the response                              | (presses, pads) | N    |
    | others: total force by each method of comparison, by name            | (presses,) each | N    |
    | splits: errors when a whole pad, indenter or session is left out     |                 |      |
    """

    pad_force: np.ndarray
    others: dict[str, np.ndarray]
    splits: tuple[Split, ...]


def fitting_problem(
    skin: je.Skin, data: PressData, places: Places | None, loss: AbstractLoss, folds: int
) -> FittingProblem:
    """The fitting problem of the presses on a skin, whose places are divided into `folds` folds."""
    geometry = geometry_of(skin, places.position.dtype if places else None)
    return FittingProblem(LocatedPresses(data, geometry, places), loss, folds_by_place(data.place, folds))


def fit_response(
    problem: FittingProblem, skin: je.Skin, curves: Sequence[AbstractCurve], fields: Sequence[AbstractField | None]
) -> PadResponse:
    """Choose one of the curves and one of the fields, as `choose` does, and fit them to all presses.

    Raises:
        FitError: if the presses do not determine the curve of some pad, or the field.
    """
    presses, loss, fold = problem
    choice = choose(curves, fields, presses, loss, fold)
    hybrid = fit_hybrid(choice.curve, choice.field, presses, loss)
    _require_fits(skin, hybrid)
    baseline = hybrid if _is_baseline(choice) else fit_hybrid(Linear(), None, presses, loss)
    return PadResponse(choice, hybrid, baseline.curves)


def require_every_pad_pressed(skin: je.Skin, data: PressData) -> None:
    """Check that every pad has a press that it carries alone, because only such presses determine its curve.

    Raises:
        FitError: naming the first pad without one.
    """
    for number, pad in enumerate(skin.pads):
        if not data.mask[number].any():
            raise FitError(
                f"pad {number} ({pad.name}): the curve could not be fitted: no press rests on it alone; press it "
                "away from its neighbours"
            )


def _is_baseline(choice: Choice) -> bool:
    return isinstance(choice.curve, Linear) and choice.field is None


def _require_fits(skin: je.Skin, hybrid: Hybrid) -> None:
    curves = hybrid.curves
    for number, pad in enumerate(skin.pads):
        if int(curves.result[number]) != FitResult.SUCCESS:
            raise FitError(f"pad {number} ({pad.name}): the curve could not be fitted: {curves.pad(number).message()}")
    if hybrid.field is not None and int(hybrid.field.result) != FitResult.SUCCESS:
        raise FitError(
            f"location: the field could not be fitted to {float(hybrid.field.n):.3g} places that the images find: "
            "press at more places, or calibrate without a correction by location"
        )


def hold_out_response(
    problem: FittingProblem,
    response: PadResponse,
    groups: Mapping[str, np.ndarray],
    image_sum: np.ndarray,
    true_position: np.ndarray | None = None,
) -> HeldOutForces:
    """Predict each press by fits without its place: by the response and by the methods of comparison.

    Args:
        groups: number of each press's part, (presses,), for each kind of part to leave out; see `leave_out`.
        image_sum: integral of each press's image, (presses,) S m^2.
        true_position: exact positions of the presses, (presses, 2) m, if a simulation made them.
    """
    presses, loss, fold = problem
    curve, field = response.choice.curve, response.choice.field
    pad_force = hold_out(curve, field, presses, loss, fold)
    others = {"eit": hold_out_image(image_sum, presses.data.force, fold)}
    others["hybrid"] = (
        pad_force if _is_baseline(response.choice) else hold_out(Linear(), None, presses, loss, fold)
    ).sum(1)
    if field is not None and true_position is not None:
        true = presses._replace(places=single_places(true_position, presses.geometry.pads))
        others["true_place"] = hold_out(curve, field, true, loss, fold).sum(1)
    return HeldOutForces(pad_force, others, leave_out(curve, field, presses, loss, groups))
