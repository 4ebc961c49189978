"""The calibration procedure: from sessions to a calibration, and its evaluation on another session."""

import platform
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple, overload

import jax
import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import listed

from ..check.acceptance import accept
from ..fitting.cross_validation.neighbourhoods import with_error_scale
from ..fitting.fields import single_places
from ..fitting.fields.unpressed_walls import unpressed_note
from ..fitting.pads import PadModel
from ..fitting.response import (
    HeldOutForces,
    PadResponse,
    fit_response,
    fold_presses,
    hold_out_response,
    require_every_pad_pressed,
)
from ..presses.contradictions import drifting_pads, outlying_presses, place_errors
from ..presses.pooled import MEANS_PER_PRESS, PooledPresses, PressSeries, block_means, pool_presses, press_series
from ..presses.skins import differing_parts
from ..presses.table import PressMeasurements, Processing, measure
from ..session import Session, SessionError
from ..session.argument_checks import require_session, require_skin_or_none, sessions_of
from .archives.provenance import describe
from .argument_checks import are_logs, require_calibration, require_no_eit_choices
from .calibration import Calibration
from .evaluation import Evaluation, centre_of
from .fitted_sessions import FITTED_NOTE, holds_presses, is_fitted, require_each_once
from .hysteresis_loops import typical_loops
from .layer import learn_layer
from .localisation.electrode_places import PlacedElectrodes, place_electrodes
from .localisation.locators import ContactLocator
from .localisation.place_doubts import correction_that_harms, require_on_sheet, worse_than_baseline_note
from .localisation.press_images import Imager, PressImages, prepare_imager
from .logs.calibration import LogCalibration
from .logs.evaluation import LogEvaluation
from .logs.procedure import calibrate_logs, evaluate_log
from .press_examples import press_examples, press_probes
from .recalibration.agreement import agreement_of_presses
from .recipes.own_classes import import_note
from .recipes.recipe import Recipe, recipe_or_default

STAGES = ("reading", "model and images", "fitting", "holding out")
# Further stages, if the recipe asks for them.
PLACING, LEARNING = "placing the electrodes", "learning the contact layer"
FITTING_LOGS = "fitting the logs"  # the only stage of logs


@overload
def calibrate(
    sessions: Session | Iterable[Session],
    skin: je.Skin,
    *,
    recipe: Recipe | None = None,
    ignore_errors: bool = False,
    progress: Callable[[str], object] = ...,
) -> Calibration: ...


@overload
def calibrate(
    sessions: Session | Iterable[Session],
    skin: None = None,
    *,
    recipe: Recipe | None = None,
    ignore_errors: bool = False,
    progress: Callable[[str], object] = ...,
) -> Calibration | LogCalibration: ...


def calibrate(
    sessions: Session | Iterable[Session],
    skin: je.Skin | None = None,
    *,
    recipe: Recipe | None = None,
    ignore_errors: bool = False,
    progress: Callable[[str], object] = lambda stage: None,
) -> Calibration | LogCalibration:
    """Fit one pressure-force curve per pad, and a correction by location, and prepare the image reconstruction.

    Of logs, which are sessions without EIT, fit the channels of one sensor to the force, as
    `calib.calibration.calibrate_logs` does.

    Args:
        sessions: recorded on one skin, from `open_session`; one, or several. Or logs of one sensor.
        skin: default: the one described in the first session. Logs have none.
        recipe: all choices of the procedure; default: those of the paper.
        ignore_errors: calibrate also from sessions in which `check_session` finds an error; the errors are then kept in
            the calibration's notes and provenance.
        progress: called with the name of each of the `STAGES`, `PLACING` or `LEARNING`, when the stage begins; of logs
            with `FITTING_LOGS`.

    Raises:
        SessionError: a session cannot be used, is given twice, or was recorded on another skin or with another sensor;
            some sessions hold EIT and others none; or a skin is given for logs.
        RecordingError: `check_session` finds an error in a session.
        FitError: a pad was not pressed enough to fit its curve, there are too few presses for a field, or a class of
            your own returns what cannot be, such as places off the sheet.
        InverseError, HyperparameterError: no image can be made as the recipe asks.
    """
    sessions = sessions_of(sessions, "calibrate")
    require_skin_or_none(skin, "calibrate")
    recipe = recipe_or_default(recipe, "calibrate")
    if are_logs(sessions, "calibrate"):
        require_no_eit_choices("calibrate", "the sessions are logs", skin=skin)
        progress(FITTING_LOGS)
        return calibrate_logs(sessions, recipe, ignore_errors=ignore_errors)
    return _calibrate_skin(sessions, skin or _one_skin(sessions), recipe, ignore_errors, progress)


def _calibrate_skin(
    sessions: Sequence[Session],
    skin: je.Skin,
    recipe: Recipe,
    ignore_errors: bool,
    progress: Callable[[str], object],
) -> Calibration:
    """`calibrate` for sessions with EIT."""
    require_each_once(sessions)
    progress("reading")
    presses = pool_presses(sessions, skin, recipe.processing)
    accepted = accept(sessions, skin, ignore_errors=ignore_errors)
    noted = accepted.notes
    require_every_pad_pressed(skin, presses.data)
    found = _found(skin, presses, recipe, progress)
    calibration = _calibration(sessions, found, recipe, noted, accepted.ignored)
    if recipe.learn_layer:
        progress(LEARNING)
        for session in sessions:
            calibration = learn_layer(calibration, session, ignore_errors=ignore_errors)
    return calibration


def _one_skin(sessions: Sequence[Session]) -> je.Skin:
    """The skin that the first session describes; SessionError if another session describes another skin."""
    skin = je.skin.parse_skin(sessions[0].skin_toml, f"{sessions[0].name}: skin_toml")
    for session in sessions[1:]:
        if parts := differing_parts(session, skin):
            raise SessionError(
                f"{session.name}: another skin than that of {sessions[0].name}: its {' and '.join(parts)} "
                "differ; calibrate each skin by its own sessions, or give the skin of all (--skin FILE)"
            )
    return skin


class _Found(NamedTuple):
    """What the stages of a calibration find; the skin has its electrodes where the images found them, if `placed`.

    ``model`` is that of the response, with errors as large as those of held-out forces; ``gain`` that of each pad at
    each press, (presses, pads), None without a correction by location; ``unpressed`` a note on pads of which a part was
    never pressed, or "".
    """

    skin: je.Skin
    placed: PlacedElectrodes | None
    presses: PooledPresses
    imager: Imager
    images: PressImages
    response: PadResponse
    held_out: HeldOutForces
    model: PadModel
    gain: np.ndarray | None
    unpressed: str


def _found(skin: je.Skin, presses: PooledPresses, recipe: Recipe, progress: Callable[[str], object]) -> _Found:
    placed = None
    if recipe.fit_electrodes:
        progress(PLACING)
        skin, placed = place_electrodes(skin, presses)
    progress("model and images")
    imager = prepare_imager(skin, presses, recipe)
    images = imager.presses(presses.dv)
    require_on_sheet(skin, images.places, recipe.locator)
    progress("fitting")
    stage = presses.position if any(field is not None and field.steady for field in recipe.locations) else None
    folds = fold_presses(skin, presses.data, images.places, recipe.loss, recipe.folds, stage)
    response = fit_response(folds, skin, recipe.curves, recipe.locations)
    progress("holding out")
    true_position = presses.position if presses.true_place else None
    held_out = hold_out_response(folds, response, presses.groups, images.integral, true_position)
    model = with_error_scale(response.model, held_out.error_scale)
    gain, unpressed = _gains(model, images), unpressed_note(model.field, images.places, presses.data.share)
    return _Found(skin, placed, presses, imager, images, response, held_out, model, gain, unpressed)


def _calibration(
    sessions: Sequence[Session], found: _Found, recipe: Recipe, noted: Sequence[str], ignored: Sequence[str]
) -> Calibration:
    presses, imager, response, model = found.presses, found.imager, found.response, found.model
    evaluation = _held_out_evaluation(found)
    return Calibration(
        skin=found.skin,
        recon=imager.recon,
        masks=imager.masks,
        curves=model.curves,
        notes=(*noted, *_notes(found, evaluation)),
        evaluation=evaluation,
        simulated=any(s.simulated for s in sessions),
        field=model.field,
        crosstalk=presses.crosstalk,
        noise=found.held_out.noise,
        hold_noise=found.held_out.hold_noise,
        locator=imager.locator if model.field is not None else None,
        baseline=response.baseline,
        image_gain=float(presses.data.force.sum() / found.images.integral.sum()),
        loops=typical_loops(presses, found.gain),
        tried=response.choice.tried,
        examples=press_examples(presses, found.skin),
        probes=press_probes(presses),
        rest=np.mean([recording.rest.mean(0) for recording in presses.recordings], 0),
        electrodes=found.placed,
        sensor=presses.sensor_noise,
        provenance=_provenance(sessions, recipe, imager, response, ignored),
    )


def _notes(found: _Found, evaluation: Evaluation) -> tuple[str, ...]:
    """What the operator should know of the stages."""
    presses, choice = found.presses, found.response.choice
    harm = correction_that_harms(evaluation) if found.model.field is not None else ""
    needed = import_note(choice.curve, choice.field, found.imager.locator)
    return (
        *presses.notes,
        *([found.placed.note] if found.placed else []),
        *found.imager.notes,
        *([f"chosen: {choice.why}"] if choice.why else []),
        *_not_predicted(found.skin, found.held_out.pad_force),
        *_contradictions(found),
        *filter(None, [found.unpressed, harm, needed]),
    )


def _contradictions(found: _Found) -> tuple[str, ...]:
    """What presses contradict: single ones the others, pads that drift, and places of a stage that is off."""
    presses, held_out, seen = found.presses, found.held_out.pad_force, found.images.estimated.get("fitted")
    names, corrected = [pad.name for pad in found.skin.pads], found.response.model.field is not None
    guessed = worse_than_baseline_note(presses.position, seen)
    seen = None if guessed else seen  # places that tell nothing contradict nobody
    return (
        *filter(None, [guessed]),
        *outlying_presses(presses, held_out.sum(1), seen),
        *drifting_pads(presses, names, held_out, by_place=corrected),
        *(place_errors(presses, seen) if seen is not None and isinstance(found.imager.locator, ContactLocator) else ()),
    )


def _not_predicted(skin: je.Skin, pad_force: np.ndarray) -> tuple[str, ...]:
    """A line about presses without held-out forces (presses, pads): fits without their places failed."""
    lost = ~np.isfinite(pad_force)
    if not lost.any():
        return ()
    pads = listed(pad.name for pad, some in zip(skin.pads, lost.any(0), strict=True) if some)
    return (
        f"{lost.any(1).sum()} of {len(lost)} presses have no held-out force, so that errors of forces are not known: "
        f"the curves of {pads} could not be fitted without the places of these presses; press these pads at more "
        "places, or give a curve of fewer parameters (--curve linear)",
    )


def _held_out_evaluation(found: _Found) -> Evaluation:
    presses, held_out = found.presses, found.held_out
    return Evaluation(
        position=presses.position,
        estimated=found.images.estimated,
        force=presses.data.force,
        pressure=presses.data.pressure,
        pad_force=held_out.pad_force,
        half_width=held_out.half_width,
        image_sum=found.images.integral,
        recipe=found.response.choice.title,
        held_out_by="location",
        others=held_out.others,
        splits=held_out.splits,
        centre=centre_of(found.skin),
    )


def _gains(model: PadModel, images: PressImages) -> np.ndarray | None:
    """Gain of each pad at each press, (presses, pads); None without a correction by location."""
    if model.field is None or images.places is None:
        return None
    return np.asarray(np.exp(model.log_gains(images.places)))


def _provenance(
    sessions: Sequence[Session], recipe: Recipe, imager: Imager, response: PadResponse, ignored: Sequence[str]
) -> dict[str, str]:
    return {
        **({"ignored_errors": "\n".join(ignored)} if ignored else {}),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": f"jaxeit {je.__version__}, jax {jax.__version__}, Python {platform.python_version()}",
        "sessions": "\n".join(f"{s.hash}  {s.name}" for s in sessions),
        "recorded_utc": max(s.epoch for s in sessions),
        **describe(recipe, imager.recon, response.choice),
    }


@overload
def evaluate(
    calibration: Calibration, session: Session, processing: Processing | None = None, *, ignore_errors: bool = False
) -> Evaluation: ...


@overload
def evaluate(
    calibration: LogCalibration, session: Session, processing: None = None, *, ignore_errors: bool = False
) -> LogEvaluation: ...


def evaluate(
    calibration: Calibration | LogCalibration,
    session: Session,
    processing: Processing | None = None,
    *,
    ignore_errors: bool = False,
) -> Evaluation | LogEvaluation:
    """Evaluate a calibration on the presses of another session, or that of a log on another log.

    The notes tell what lies outside of what was calibrated. Where the pads disagree with the image, intervals are wider
    by as much.

    Args:
        processing: how the session is cut and corrected; default: as the sessions of the calibration.
        ignore_errors: evaluate also on a session in which `check_session` finds an error, and note it.

    Raises:
        SessionError: if the session was recorded on another skin or cannot be used.
        RecordingError: if `check_session` finds an error in the session.
    """
    require_session(session, "evaluate")
    if isinstance(calibration, LogCalibration):
        require_no_eit_choices("evaluate", processing=processing)
        return evaluate_log(calibration, session, ignore_errors=ignore_errors)
    require_calibration(calibration, "evaluate")
    return _evaluation(calibration, session, processing or calibration.processing, ignore_errors)


def _evaluation(calibration: Calibration, session: Session, processing: Processing, ignore_errors: bool) -> Evaluation:
    """`evaluate` for the calibration of a skin."""
    found = measure(session, calibration.skin, processing)
    fitted = is_fitted(calibration.provenance, session) or holds_presses(calibration, found.force, found.pressure)
    accepted = accept([session], calibration.skin, ignore_errors=ignore_errors)
    _require_channels(calibration, found)
    images = Imager(calibration.recon, calibration.masks, calibration.locator).presses(found.dv)
    agreement = agreement_of_presses(calibration, found, images)
    along = block_means(press_series([found]), MEANS_PER_PRESS)
    force, half_width = agreement.calibration.pads.hold_forces(found.pressure, images.places, along)
    return Evaluation(
        position=found.position,
        estimated=images.estimated,
        force=found.force,
        pressure=calibration.own_pressures(found.pressure),
        pad_force=force,
        half_width=half_width,
        image_sum=images.integral,
        centre=centre_of(calibration.skin),
        held_out_by="" if fitted else "session",
        notes=(*([FITTED_NOTE] if fitted else []), *accepted.notes, *found.notes, *agreement.notes),
        others=_compared_forces(calibration, found, images.integral, along),
        recipe=calibration.evaluation.recipe,
    )


def _require_channels(calibration: Calibration, found: PressMeasurements) -> None:
    lost = np.asarray(calibration.recon.channels) & ~found.channels
    if lost.any():
        raise SessionError(
            f"{found.session.name}: /streams/eit: channels {np.flatnonzero(lost)[:8].tolist()} hold no finite "
            "value but the calibration uses them; calibrate again with this session's channels"
        )


def _compared_forces(
    calibration: Calibration, found: PressMeasurements, image_sum: np.ndarray, along: PressSeries
) -> dict[str, np.ndarray]:
    """Total force by the methods of comparison, (presses,) N each; empty for a file of an early version."""
    if calibration.baseline is None:
        return {}
    papers = PadModel(calibration.baseline, crosstalk=calibration.pads.crosstalk).pad_forces(found.pressure)[0].sum(1)
    others = {"eit": calibration.image_gain * image_sum, "hybrid": papers}
    if calibration.field is not None and "contact_position" in found.session.truth:
        true = single_places(found.position, len(calibration.skin.pads))
        others["true_place"] = calibration.pads.hold_forces(found.pressure, true, along)[0].sum(1)
    return others
