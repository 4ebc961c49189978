"""The response of a skin to presses: choice and fit of curves and field, and their predictions of held-out presses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import jaxeit as je

from ..presses.pooled import PressData
from .cross_validation.held_out import Folds, LeaveOutErrors, folds_by_place, hold_out_image, leave_groups_out
from .cross_validation.neighbourhoods import error_scale, hold_out_scaled
from .cross_validation.selection import ModelChoice, choose, nested_selection
from .curves.base import AbstractCurve
from .curves.elementary import Linear
from .curves.fitted import FittedCurve
from .fields.base import AbstractField
from .fields.geometry import geometry_of
from .fields.places import Places, single_places
from .fields.steady_places import steady_places
from .intervals import NoiseLaw
from .losses import AbstractLoss
from .pads import LocatedPresses, PadModel
from .results import FitError, FitResult


@dataclass(frozen=True, eq=False)
class PadResponse:
    """The curve and field that were chosen, fitted to all presses.

    ``without`` holds, by the number of each fold, the fit that did not use the fold, nor did the choice.
    ``baseline`` holds the curves of the paper's recipe beside them: `Linear`, without a field.
    """

    choice: ModelChoice
    model: PadModel
    baseline: FittedCurve
    without: Mapping[int, PadModel]


class HeldOutForces(NamedTuple):
    """Forces over the holds, predicted by fits without the place of the press.

    | meaning                                                              | shape           | unit |
    |----------------------------------------------------------------------|-----------------|------|
    | pad_force: of each pad, by the response                              | (presses, pads) | N    |
    | half_width: half the 90 % interval of the total, by other places     | (presses,)      | N    |
    | noise: deviation of new readings about the response                  |                 |      |
    | hold_noise: deviation of means over holds about the response         |                 |      |
    | error_scale: factor of the standard errors of the field              |                 |      |
    | others: total force by each method of comparison, by name            | (presses,) each | N    |
    | splits: errors when a whole pad, indenter or session is left out     |                 |      |
    """

    pad_force: np.ndarray
    half_width: np.ndarray
    noise: NoiseLaw
    hold_noise: NoiseLaw
    error_scale: float
    others: dict[str, np.ndarray]
    splits: tuple[LeaveOutErrors, ...]


def fold_presses(
    skin: je.Skin,
    data: PressData,
    places: Places | None,
    loss: AbstractLoss,
    folds: int,
    stage: np.ndarray | None = None,
) -> Folds:
    """The presses on a skin, whose places are divided into `folds` folds.

    Args:
        places: of the presses, by their images.
        stage: the same by the stage, (presses, 2) m, for fields that are fitted to `steady_places`; None: for others.
    """
    geometry = geometry_of(skin, places.position.dtype if places else None)
    steady = None if places is None or stage is None else steady_places(geometry, places, stage)
    return Folds(LocatedPresses(data, geometry, places, steady), loss, folds_by_place(data.place, folds))


def fit_response(
    folds: Folds, skin: je.Skin, curves: Sequence[AbstractCurve], fields: Sequence[AbstractField | None]
) -> PadResponse:
    """Choose one of the curves and one of the fields, as `choose` does, and fit them to all presses.

    Raises:
        FitError: if the presses do not determine the curve of some pad, or the field.
    """
    choice = choose(curves, fields, folds)
    model = folds.fit(choice.curve, choice.field, frozenset())
    _require_fits(skin, model)
    without = nested_selection(curves, fields, folds)
    return PadResponse(choice, model, folds.fit(*_baseline(choice), frozenset()).curves, without)


def require_every_pad_pressed(skin: je.Skin, data: PressData) -> None:
    """Check that every pad carries at least a third of some press, because such presses determine its curve.

    Raises:
        FitError: naming the first pad without one.
    """
    for number, pad in enumerate(skin.pads):
        if not data.mask[number].any():
            raise FitError(
                f"pad {number} ({pad.name}): the curve could not be fitted: no press rests on it, or a third of one; "
                "press it at more places"
            )


def _baseline(choice: ModelChoice) -> tuple[AbstractCurve, AbstractField | None]:
    """Curve and field of the paper: a straight line, and none."""
    return (choice.curve, None) if isinstance(choice.curve, Linear) else (Linear(), None)


def _require_fits(skin: je.Skin, model: PadModel) -> None:
    curves = model.curves
    for number, (pad, result) in enumerate(zip(skin.pads, np.asarray(curves.result), strict=True)):
        if result != FitResult.SUCCESS:
            raise FitError(f"pad {number} ({pad.name}): the curve could not be fitted: {curves.pad(number).message()}")
    if model.field is not None and int(model.field.result) != FitResult.SUCCESS:
        raise FitError(
            f"location: the field could not be fitted to {float(model.field.n):.3g} places that the images find: "
            "press at more places, or calibrate without a correction by location"
        )


def hold_out_response(
    folds: Folds,
    response: PadResponse,
    groups: Mapping[str, np.ndarray],
    image_sum: np.ndarray,
    true_position: np.ndarray | None = None,
) -> HeldOutForces:
    """Predict each press by fits without its place: by the response and by the methods of comparison.

    Args:
        groups: number of each press's part, (presses,), for each kind of part to leave out; see `leave_groups_out`.
        image_sum: integral of each press's image, (presses,) S m^2.
        true_position: exact positions of the presses, (presses, 2) m, if a simulation made them.
    """
    presses, data = folds.presses, folds.presses.data
    curve, field = response.choice.curve, response.choice.field
    others = {
        "eit": hold_out_image(image_sum, data.force, folds.fold),
        "hybrid": folds.hold_out(*_baseline(response.choice)).hold.force.sum(1),
    }
    if field is not None and true_position is not None:
        true = presses._replace(places=single_places(true_position, presses.geometry.pads), steady=None)
        others["true_place"] = Folds(true, folds.loss, folds.fold).hold_out(curve, field).hold.force.sum(1)
    held = hold_out_scaled(folds, response.without, 1.0)
    hold_noise = held.hold_noise(data)
    scale = error_scale(folds, curve, response.model, hold_noise)
    scaled = hold_out_scaled(folds, response.without, scale) if scale > 1 else held
    return HeldOutForces(
        held.hold.force,
        held.half_widths(data, scaled.hold.total_variance),
        held.noise(data),
        hold_noise,
        scale,
        others,
        leave_groups_out(curve, field, presses, folds.loss, groups),
    )
