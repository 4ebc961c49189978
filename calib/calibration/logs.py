"""Logs of force and a signal, without EIT: calibrated, evaluated, and mapped to forces.

The model of a log is chosen and fitted on the first half of each log and evaluated on the second half, which has no
influence on the choice. The calibration that is kept is the chosen kind of model, fitted to the whole logs.
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np

import jaxeit as je
from jaxeit.budget import current_budget

from ..check.acceptance import accept
from ..fitting.channel_faults import MIN_ARRAY_CHANNELS, faults
from ..fitting.curves import CURVES, AbstractCurve
from ..fitting.logs import FittedLog, LogPrediction, LogSeries, fit_series, series_of, ways_of
from ..fitting.results import FitError
from ..presses.streams import resample
from ..session import Session, SessionError, Stream, write_archive
from .log_calibration import LogCalibration
from .log_evaluation import LogEvaluation, log_evaluation
from .recipe import Recipe
from .recipe_text import AUTO_CURVES

FORCE_FORMAT = "log-forces"
_NOT_SIGNALS = ("force", "stage", "temperature", "barometer")
Log = tuple[np.ndarray, np.ndarray, np.ndarray]  # times (n,) ns, values (n, channels), force (n,) N


def calibrate_logs(
    sessions: Sequence[Session], recipe: Recipe | None = None, *, ignore_errors: bool = False
) -> LogCalibration:
    """Fit one model to the logs of one sensor.

    The signal is the stream "pressure", or the only stream besides force, stage, temperature and barometer. It is
    interpolated to the times of the force. Channels of a wide array that are dead, stuck or silent on the first halves
    are left out. How several channels become one signal (the best channel, a blend, a Gaussian process that models
    creep) and which of several curves is fitted are chosen by stretches of time that the fits have not seen.

    Args:
        recipe: curves and loss; its other choices do not concern logs. "auto" stands for all shipped curves.
        ignore_errors: fit also a session in which `check_session` finds an error, and note it.

    Raises:
        SessionError: if a stream is missing, or the sessions differ in the sensor.
        FitError: if nothing can be fitted.
        RecordingError: if `check_session` finds an error in a session, unless errors are ignored.
    """
    recipe = recipe or Recipe()
    ignored = accept(sessions, None, ignore_errors=ignore_errors)
    signal = _same_signal(sessions)
    series = series_of([_log(session) for session in sessions])
    where = f"{sessions[0].name}: /streams/{signal.name}"
    kept, note = _informative(series, where)
    series = series.channels(kept)
    try:
        half, whole = _fitted(series, curves_of(recipe), recipe)
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
        provenance=_provenance(sessions, recipe, half, ignored),
        simulated=any(s.simulated for s in sessions),
        notes=tuple(filter(None, [*ignored, note, thin])),
        why=half.why,
        tried=half.tried,
    )


def curves_of(recipe: Recipe) -> tuple[AbstractCurve, ...]:
    """The curves of the recipe; for "auto" all shipped curves, because a log has enough samples to choose."""
    automatic = [type(CURVES.make(name)) for name in AUTO_CURVES]
    if [type(curve) for curve in recipe.curves] == automatic:
        return tuple(CURVES.make(name) for name in CURVES.shipped)
    return recipe.curves


def _fitted(series: LogSeries, curves: Sequence[AbstractCurve], recipe: Recipe) -> tuple[FittedLog, FittedLog]:
    """The model chosen on the first halves of the logs, and the same kind of model fitted to all samples.

    A curve that converges on the halves but not on all samples is chosen by none; the others are tried again.
    """
    ways = ways_of(series.values.shape[1], current_budget().blend_channels)
    half = fit_series(series, series.first_half, curves, ways, recipe.loss)
    try:
        return half, fit_series(series, series.complete, [half.curve], {"chosen": half.way}, recipe.loss)
    except FitError:
        others = [curve for curve in curves if CURVES.name_of(curve) != CURVES.name_of(half.curve)]
        if not others:
            raise
        return _fitted(series, others, recipe)


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
    if "pressure" in session.streams:
        return session.streams["pressure"]
    left = [name for name in session.streams if name not in _NOT_SIGNALS]
    if len(left) != 1:
        raise FitError(
            f"{session.name}: which stream is the signal? found {', '.join(left) or 'none'}; import "
            "it under the name pressure"
        )
    return session.streams[left[0]]


def _unit(signal: Stream) -> str:
    return "count" if signal.variable == "counts" else signal.unit


def _log(session: Session) -> Log:
    """Times, values and force of a session, at the times of the force."""
    force, signal = session.stream("force"), _signal(session)
    return force.time, resample(signal.time, signal.read(), force.time), force.read()[:, 0]


def _informative(series: LogSeries, where: str) -> tuple[np.ndarray, str]:
    """Numbers of the channels that are used, and a note that names those of a wide array without information."""
    channels = series.values.shape[1]
    if channels < MIN_ARRAY_CHANNELS:
        return np.arange(channels), ""
    half = series.first_half  # the second half is held out, and must not decide which channels are used
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
    rows = ~series.first_half
    found = LogPrediction(*(part[rows] for part in half.predicted))
    which = "second half" if len(sessions) == 1 else "second half of each log"
    title = f"{which}, by the model of the first"
    return log_evaluation(title, series.time[rows], series.force[rows], found, (thin,) if thin else ())


def _provenance(
    sessions: Sequence[Session], recipe: Recipe, fitted: FittedLog, ignored: Sequence[str]
) -> dict[str, str]:
    return {
        **({"ignored_errors": "\n".join(ignored)} if ignored else {}),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": f"jaxeit {je.__version__}, jax {jax.__version__}, Python {platform.python_version()}",
        "sessions": "\n".join(f"{s.hash}  {s.name}" for s in sessions),
        "curve": CURVES.name_of(fitted.curve),
        "channels": fitted.model.combination.words,
        "choice": fitted.why,
        "recipe": recipe.to_toml(),
    }


def _stream_of(calibration: LogCalibration, session: Session) -> Stream:
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
    signal = _stream_of(calibration, session)
    ignored = accept([session], None, ignore_errors=ignore_errors)
    found = calibration.predict(signal.time, signal.read())
    force = session.stream("force")
    at = resample(signal.time, np.stack(found[:4], 1), force.time)
    nearest = np.clip(np.searchsorted(signal.time, force.time), 0, len(signal.time) - 1)
    predicted, error, low, high = at.T
    at_force = LogPrediction(predicted, error, low, high, found.valid[nearest] & np.isfinite(predicted))
    return log_evaluation(session.name, force.time, force.read()[:, 0], at_force, ignored)


def apply_log(
    calibration: LogCalibration, session: Session, path: str | Path, *, ignore_errors: bool = False
) -> LogPrediction:
    """Write force, standard error, interval and validity at the times of the signal, in the format log-forces.

    Raises:
        SessionError: if the stream of the signal is missing, or the sensor is another.
        RecordingError: if `check_session` finds an error in that stream, unless errors are ignored.
    """
    signal = _stream_of(calibration, session)
    ignored = accept([session], None, ignore_errors=ignore_errors, where=(f"/streams/{signal.name}",))
    found = calibration.predict(signal.time, signal.read())
    attrs: dict[str, str | int] = {
        "session": session.name,
        "session_sha256": session.hash,
        "simulated": int(session.simulated or calibration.simulated),
        "time_epoch_utc": session.epoch,
        "calibration_created_utc": calibration.provenance["created_utc"],
    }
    attrs |= {"ignored_errors": "\n".join(ignored)} if ignored else {}
    write_archive(path, FORCE_FORMAT, attrs, _force_arrays(signal.time, found))
    return found


def _force_arrays(time: np.ndarray, found: LogPrediction) -> Mapping[str, tuple[np.ndarray, str, str]]:
    return {
        "time": (np.asarray(time), "ns", "since the epoch"),
        "force": (found.force, "N", "NaN where a channel is missing"),
        "standard_error": (found.standard_error, "N", "of a reading"),
        "low": (found.low, "N", "lower end of the 90 % interval of a reading"),
        "high": (found.high, "N", "upper end of the 90 % interval of a reading"),
        "valid": (found.valid, "", "whether all channels lie within the calibrated ranges"),
    }


def with_batch_mark(calibration: LogCalibration, mark: str) -> LogCalibration:
    """The calibration with the mark of a batch in its provenance."""
    return replace(calibration, provenance=calibration.provenance | {"batch": mark})


def render_log(name: str, calibration: LogCalibration) -> str:
    """The calibration as lines for a terminal."""
    fitted = calibration.model.curve
    numbers = zip(fitted.curve.names, np.asarray(fitted.parameters), np.asarray(fitted.standard_errors),
                  calibration.units, strict=True)  # fmt: skip
    terms = ", ".join(f"{n} {v:.4g} +- {e:.2g} {u}" for n, v, e, u in numbers)
    why = f"\n  chosen: {calibration.why}" if calibration.why else ""
    notes = "".join(f"\n  note: {note}" for note in calibration.notes)
    return (
        f"{name}: {calibration.curve_name} curve of {calibration.model.combination.words}, fitted to the whole "
        f"recording{why}\n  {terms} (standard errors over {int(fitted.n_groups)} blocks of time)\n"
        f"  {int(fitted.n)} samples fitted, {int(fitted.n_missing)} samples without a force or a signal left out{notes}"
    )
