"""Logs of force and a signal, without EIT: calibrated, evaluated, and mapped to forces.

The model of a log is chosen and fitted on the first half of each log and evaluated on the second half, which has no
influence on the choice. The calibration that is kept is the chosen kind of model, fitted to the whole logs.
"""

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np

import jaxeit as je
from jaxeit.budget import current_budget
from jaxeit.messages.kinds import require_kind

from ...check.acceptance import accept
from ...check.logs.blocks import NOT_SIGNALS, signal_name
from ...fitting.curves import CURVES, AbstractCurve
from ...fitting.fields import FIELDS, AbstractField, PadEdge
from ...fitting.logs import (
    MIN_PLACES,
    FittedLog,
    LogPrediction,
    LogSeries,
    fit_series,
    missing_direction,
    series_of,
    travel_of,
    unseen_direction,
    ways_of,
)
from ...fitting.results import FitError
from ...presses.channel_faults import MIN_ARRAY_CHANNELS, faults
from ...presses.streams import resample
from ...session import Session, SessionError, Stream, write_archive
from ...session.argument_checks import call_on, require_session, sessions_of
from ..fitted_sessions import FITTED_NOTE, is_fitted, require_each_once
from ..recipes.recipe import Recipe, recipe_or_default
from ..recipes.text import AUTO_CURVES, SWITCHES
from .calibration import LogCalibration
from .evaluation import LogEvaluation, log_evaluation
from .storage import location_name

FORCE_FORMAT = "log-forces"
Log = tuple[np.ndarray, np.ndarray, np.ndarray]  # times (n,) ns, values (n, channels), force (n,) N


def calibrate_logs(
    sessions: Session | Iterable[Session], recipe: Recipe | None = None, *, ignore_errors: bool = False
) -> LogCalibration:
    """Fit one model to the logs of one sensor.

    The signal is the stream "pressure", or the only stream besides force, stage, temperature and barometer. It is
    interpolated to the times of the force. Channels of a wide array that are dead, stuck or silent on the first halves
    are left out. How several channels become one signal (the best channel, a blend, a Gaussian process that models
    creep) and which of several curves is fitted are chosen by stretches of time that the fits have not seen. With a
    correction by location, the place of contact is that of the stream "stage", and places are held out instead.

    Args:
        recipe: curves, locations and loss; its other choices do not concern logs. "auto" stands for all shipped curves.
            Several locations stand also for the place as an input beside the channels.
        ignore_errors: fit also a session in which `check_session` finds an error, and note it.

    Raises:
        SessionError: if a stream is missing, a session is given twice, or the sessions differ in the sensor.
        FitError: if nothing can be fitted.
        RecordingError: if `check_session` finds an error in a session, unless errors are ignored.

    Example:
        with calib.open_session("log.h5") as log:  # a stream of force and one of a sensor's channels
            sensor = calibration.calibrate_logs([log], calib.Recipe(calib.Affine()))
            print(calibration.evaluate_log(sensor, log).summary())
            forces = calibration.apply_log(sensor, log, "forces.h5")
            print(forces.force[-1], forces.low[-1], forces.high[-1])  # N
    """
    sessions = sessions_of(sessions, "calibrate_logs")
    if not sessions:
        raise SessionError("calibrate_logs: no session given; give one or more logs")
    require_each_once(sessions)
    recipe = recipe_or_default(recipe, "calibrate_logs")
    accepted = accept(sessions, None, ignore_errors=ignore_errors, uninformative=False)  # `_informative` notes them
    signal = _same_signal(sessions)
    series, locations, placed = _with_places(_series(sessions, recipe), recipe, sessions)
    where = f"{sessions[0].name}: /streams/{signal.name}"
    kept, note = _informative(series, where)
    series = series.channels(kept)
    try:
        half, whole = _fitted(series, curves_of(recipe), recipe, locations)
    except FitError as error:
        raise FitError(f"{', '.join(s.name for s in sessions)}: {error}") from None
    thin = _thinning(sessions, series)
    return LogCalibration(
        model=whole.model,
        kept=kept,
        columns=signal.channels,
        stream=signal.name,
        unit=_unit(signal),
        evaluation=_second_halves(sessions, series, half, thin),
        provenance=_provenance(sessions, recipe, half, accepted.ignored),
        simulated=any(s.simulated for s in sessions),
        notes=tuple(
            filter(
                None,
                [
                    *accepted.notes,
                    note,
                    placed,
                    thin,
                    missing_direction(whole.model.travel),
                    _of_images(recipe),
                ],
            )
        ),
        why=half.why,
        tried=half.tried,
    )


def _of_images(recipe: Recipe) -> str:
    """A note of what the recipe asks for and logs do not have; empty: nothing."""
    asked = [name for name in SWITCHES if getattr(recipe, name)]
    return f"the recipe's {', '.join(asked)}: for sessions with EIT, left out" if asked else ""


def curves_of(recipe: Recipe) -> tuple[AbstractCurve, ...]:
    """The curves of the recipe; for "auto" all shipped curves, because a log has enough samples to choose."""
    automatic = [type(CURVES.make(name)) for name in AUTO_CURVES]
    if [type(curve) for curve in recipe.curves] == automatic:
        return tuple(CURVES.make(name) for name in CURVES.shipped)
    return recipe.curves


def _series(sessions: Sequence[Session], recipe: Recipe) -> LogSeries:
    """The samples of the sessions, with the places of the stage if the recipe asks for them."""
    logs = [log_of(session) for session in sessions]
    if not recipe.locates:
        return series_of(logs)
    return series_of(logs, places=[place_of(session, session.stream("force").time) for session in sessions])


def place_of(session: Session, time: np.ndarray) -> np.ndarray:
    """The place of contact (n, 2) m at times (n,) ns by the stream "stage"; NaN where the stage says nothing.

    Raises:
        SessionError: if there is no stage that tells x and y.
    """
    if "stage" not in session.streams or session.stream("stage").channels < 2:
        raise SessionError(
            f"{session.name}: /streams/stage: no x and y of the stage, on which a correction by location depends; "
            "record the stage, or calibrate with --location none"
        )
    stage = session.stream("stage")
    return resample(stage.time, stage.read()[:, :2], time)


def _with_places(
    series: LogSeries, recipe: Recipe, sessions: Sequence[Session]
) -> tuple[LogSeries, Sequence[AbstractField | None], str]:
    """The series with its places told apart, the fields to choose from, and a note where there are too few places."""
    fields = recipe.locations
    if not recipe.locates:
        return series, fields, ""
    if len(fields) > 1:  # a log has no outline of a pad, from which distances to walls would count
        fields = tuple(field for field in fields if not isinstance(field, PadEdge))
    elif isinstance(fields[0], PadEdge):
        raise FitError(f"--location {FIELDS.name_of(fields[0])}: a log has no walls of a pad; give rbf, gp or auto")
    found = series.at_places()
    count = len(np.unique(found.sites[found.loaded]))
    if count >= MIN_PLACES:
        return found, fields, ""
    names = ", ".join(session.name for session in sessions)
    about = (
        f"{count} place{'s' * (count != 1)} of contact by the stage, and a correction by location needs {MIN_PLACES}"
    )
    if None not in fields:
        raise FitError(f"{names}: {about}; press more places, or calibrate with --location none")
    return replace(series, place=None), (None,), f"no correction by location: {about}"


def _fitted(
    series: LogSeries, curves: Sequence[AbstractCurve], recipe: Recipe, locations: Sequence[AbstractField | None]
) -> tuple[FittedLog, FittedLog]:
    """The model chosen on a part of the logs (`LogSeries.fitted_part`), and the same kind fitted to all samples.

    A curve that converges on the part but not on all samples is chosen by none; the others are tried again.
    """
    ways = ways_of(series.values.shape[1], current_budget().blend_channels, len(locations) > 1)
    half = fit_series(series, series.fitted_part, curves, ways, recipe.loss, fields=locations)
    chosen = {"chosen": half.way}
    try:
        return half, fit_series(series, series.complete, [half.curve], chosen, recipe.loss, fields=[half.field])
    except FitError:
        others = [curve for curve in curves if CURVES.name_of(curve) != CURVES.name_of(half.curve)]
        if not others:
            raise
        return _fitted(series, others, recipe, locations)


def _same_signal(sessions: Sequence[Session]) -> Stream:
    """The signal of the first session; all sessions must have one of the same name, width and unit."""
    first, *others = [(session, _signal(session)) for session in sessions]
    own = first[1]
    for session, signal in others:
        if (signal.name, signal.channels, _unit(signal)) != (own.name, own.channels, _unit(own)):
            raise SessionError(
                f"{session.name}: /streams/{signal.name}: {signal.channels} channels in {_unit(signal)}, but "
                f"{first[0].name} has /streams/{own.name} of {own.channels} in {_unit(own)}; calibrate logs of one "
                "sensor together, others separately (--jobs)"
            )
    return own


def _signal(session: Session) -> Stream:
    name = signal_name(session.streams)
    if not name:
        left = [stream for stream in session.streams if stream not in NOT_SIGNALS]
        raise FitError(
            f"{session.name}: which stream is the signal? found {', '.join(left) or 'none'}; import "
            "it under the name pressure"
        )
    return session.streams[name]


def _unit(signal: Stream) -> str:
    return "count" if signal.variable == "counts" else signal.unit


def log_of(session: Session) -> Log:
    """Times, values and force of a session, at the times of the force."""
    force, signal = session.stream("force"), _signal(session)
    return force.time, resample(signal.time, signal.read(), force.time), force.read()[:, 0]


def _informative(series: LogSeries, where: str) -> tuple[np.ndarray, str]:
    """Numbers of the channels that are used, and a note that names those of a wide array without information."""
    channels = series.values.shape[1]
    if channels < MIN_ARRAY_CHANNELS:
        return np.arange(channels), ""
    half = series.fitted_part  # the rest is held out, and must not decide which channels are used
    found = faults(series.values[half], series.force[half])
    if found.uninformative.all():
        raise FitError(f"{where}: none of {channels} channels follows the force; see jaxeit check")
    flags = {"dead": found.dead, "stuck": found.stuck, "silent": found.silent}
    named = [f"{name} {', '.join(map(str, np.flatnonzero(flag)))}" for name, flag in flags.items() if flag.any()]
    note = f"channels left out: {'; '.join(named)}" if named else ""
    return np.flatnonzero(~found.uninformative), note


def _thinning(sessions: Sequence[Session], series: LogSeries) -> str:
    total = sum(len(session.stream("force")) for session in sessions)
    factor = round(total / len(series.time))
    return f"fitted to means of {factor} samples" if factor > 1 else ""


def _second_halves(sessions: Sequence[Session], series: LogSeries, half: FittedLog, thin: str) -> LogEvaluation:
    rows = ~series.fitted_part
    found = LogPrediction(*(part[rows] for part in half.predicted))
    which = "second half" if len(sessions) == 1 else "second half of each log"
    title = f"{which}, by the model of the first" if series.site is None else "a third of the places, by the others"
    unseen = unseen_direction(half.model.travel, travel_of(series.force[rows], series.log[rows]))
    return log_evaluation(title, series.time[rows], series.force[rows], found, tuple(filter(None, (thin, unseen))))


def _provenance(
    sessions: Sequence[Session], recipe: Recipe, fitted: FittedLog, ignored: Sequence[str]
) -> dict[str, str]:
    return {
        **({"ignored_errors": "\n".join(ignored)} if ignored else {}),
        "recorded_utc": max((s.epoch for s in sessions), default=""),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": f"jaxeit {je.__version__}, jax {jax.__version__}, Python {platform.python_version()}",
        "sessions": "\n".join(f"{s.hash}  {s.name}" for s in sessions),
        "curve": CURVES.name_of(fitted.curve),
        "channels": fitted.model.words,
        "location": location_name(fitted.model.location),
        "choice": fitted.why,
        "recipe": recipe.to_toml(),
    }


def stream_of(calibration: LogCalibration, session: Session, call: str) -> Stream:
    """The stream of a session that a calibration takes, in a ``call``.

    Raises:
        SessionError: for what is no calibration of a log or no session, and for another sensor.
    """
    require_session(session, call)
    give = f"{call_on('calib.load_calibration', calibration)} of a log"
    require_kind(calibration, LogCalibration, SessionError, "the calibration of a log", give, call)
    signal = session.stream(calibration.stream)
    if signal.channels != calibration.columns or _unit(signal) != calibration.unit:
        raise SessionError(
            f"{session.name}: /streams/{signal.name}: {signal.channels} channels in {_unit(signal)}, but the "
            f"calibration is of {calibration.columns} in {calibration.unit}; give the calibration of this sensor"
        )
    return signal


def evaluate_log(calibration: LogCalibration, session: Session, *, ignore_errors: bool = False) -> LogEvaluation:
    """Evaluate a calibration on another log.

    Raises:
        SessionError: if a stream is missing, or the sensor is another.
        RecordingError: if `check_session` finds an error in the session, unless errors are ignored.
    """
    signal = stream_of(calibration, session, "evaluate_log")
    accepted = accept([session], None, ignore_errors=ignore_errors)
    found = _predicted(calibration, session, signal)
    force = session.stream("force")
    numbers = (found.force, found.standard_error, found.low, found.high)
    predicted, error, low, high = resample(signal.time, np.stack(numbers, 1), force.time).T
    nearest = np.clip(np.searchsorted(signal.time, force.time), 0, len(signal.time) - 1)
    at_force = LogPrediction(predicted, error, low, high, found.valid[nearest] & np.isfinite(predicted))
    recorded = force.read()[:, 0]
    fitted = FITTED_NOTE if is_fitted(calibration.provenance, session) else ""
    notes = tuple(filter(None, [fitted, *accepted.notes, calibration.unseen(recorded)]))
    return log_evaluation(session.name, force.time, recorded, at_force, notes)


def _predicted(calibration: LogCalibration, session: Session, signal: Stream) -> LogPrediction:
    place = place_of(session, signal.time) if calibration.needs_place else None
    return calibration.predict(signal.time, signal.read(), place)


def apply_log(
    calibration: LogCalibration,
    session: Session,
    path: str | Path,
    *,
    ignore_errors: bool = False,
    tell: Callable[[str], object] = lambda line: None,
) -> LogPrediction:
    """Write force, standard error, interval and validity at the times of the signal, in the format log-forces.

    Args:
        tell: called with a line about each warning of `check_session` about that stream, and about forces that the
            calibration has not seen; both stand in the file's attributes "warnings" and "note".

    Raises:
        SessionError: if the stream of the signal is missing, or the sensor is another.
        RecordingError: if `check_session` finds an error in that stream, unless errors are ignored.
    """
    signal = stream_of(calibration, session, "apply_log")
    accepted = accept([session], None, ignore_errors=ignore_errors, where=(f"/streams/{signal.name}",))
    found = _predicted(calibration, session, signal)
    attrs: dict[str, str | int] = {
        "session": session.name,
        "session_sha256": session.hash,
        "simulated": int(session.simulated or calibration.simulated),
        "time_epoch_utc": session.epoch,
        "calibration_created_utc": calibration.provenance["created_utc"],
    }
    told = {"ignored_errors": accepted.ignored, "warnings": accepted.warnings}
    attrs |= {name: "\n".join(lines) for name, lines in told.items() if lines}
    attrs["note"] = unseen = calibration.unseen(found.force)
    arrays = _force_arrays(signal.time, session.epoch, found)
    write_archive(path, FORCE_FORMAT, attrs, arrays, dict.fromkeys(arrays, ("time",)))
    for line in filter(None, (*accepted.warnings, unseen)):
        tell(f"note: {line}")
    return found


def _force_arrays(time: np.ndarray, epoch: str, found: LogPrediction) -> Mapping[str, tuple[np.ndarray, str, str]]:
    return {
        "time": (np.asarray(time), f"nanoseconds since {epoch}", "time of the sample"),
        "force": (found.force, "N", "NaN where a channel is missing"),
        "standard_error": (found.standard_error, "N", "of a reading"),
        "low": (found.low, "N", "lower end of the 90 % interval of a reading"),
        "high": (found.high, "N", "upper end of the 90 % interval of a reading"),
        "valid": (found.valid, "", "whether channels and place lie within the calibrated ranges"),
    }


def render_log(name: str, calibration: LogCalibration) -> str:
    """The calibration as lines for a terminal."""
    fitted = calibration.model.curve
    numbers = zip(fitted.curve.names, np.asarray(fitted.parameters), np.asarray(fitted.standard_errors),
                  calibration.units, strict=True)  # fmt: skip
    terms = ", ".join(f"{n} {v:.4g} +- {e:.2g} {u}" for n, v, e, u in numbers)
    why = f"\n  chosen: {calibration.why}" if calibration.why else ""
    notes = "".join(f"\n  note: {note}" for note in calibration.notes)
    place = "" if calibration.location_name in ("none", "inputs") else f", gain by place {calibration.location_name}"
    return (
        f"{name}: {calibration.curve_name} curve of {calibration.model.words}{place}, fitted to the whole "
        f"recording{why}\n  {terms} (standard errors over {int(fitted.n_groups)} {calibration.groups})\n"
        f"  {int(fitted.n)} samples fitted, {int(fitted.n_missing)} samples without a force or a signal left out{notes}"
    )
