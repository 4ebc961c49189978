"""Recalibration of a log's calibration from a log with known force; see `shift`."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...check.acceptance import accept
from ...fitting.gain_update import GainDrift
from ...fitting.logs import series_of
from ...session import Session, SessionError
from ..fitted_sessions import SAME_NOTE, is_fitted, require_not_moved_by
from ..recalibration.changes import ANYWAY, MAX_DRIFTS, beyond_drift
from .calibration import LogCalibration
from .procedure import log_of, place_of, stream_of
from .shift import LogShift, fit_shift, full_scale_of, shift_prior


def assess_log(
    calibration: LogCalibration, session: Session, drift: GainDrift | None = None, *, ignore_errors: bool = False
) -> LogShift:
    """How far a log with known force is off a calibration; arguments and errors as for `recalibrate_log`."""
    signal = stream_of(calibration, session, "assess_log")
    accepted = accept([session], None, ignore_errors=ignore_errors)
    places = [place_of(session, session.stream("force").time)] if calibration.needs_place else None
    series = series_of([log_of(session)], places=places)
    found = replace(calibration, shift=None).predict(series.time, series.values, series.place)
    used = series.complete & found.valid
    scale = full_scale_of(calibration.model)
    moved = shift_prior(calibration.shift, scale, drift or GainDrift())
    try:
        fit = fit_shift(
            series.force[used], found.force[used], found.standard_error[used], series.blocks(used)[used], moved
        )
    except ValueError as error:
        raise SessionError(f"{session.name}: /streams/{signal.name}: {error}") from None
    before = np.array([1.0, 0.0]) if calibration.shift is None else moved[0]
    return LogShift(
        gain=float(fit.mean[0]),
        offset=float(fit.mean[1]),
        covariance=fit.covariance,
        before=before,
        full_scale=scale,
        determined=fit.determined,
        misfit=fit.misfit,
        scatter=fit.scatter,
        session=f"{session.hash}  {session.name}",
        since=calibration.recorded,
        until=session.epoch,
        notes=(
            *([SAME_NOTE] if is_fitted(calibration.provenance, session) else []),
            *accepted.notes,
            *_left_out(series.complete, found.valid),
        ),
    )


def _left_out(complete: np.ndarray, valid: np.ndarray) -> Iterator[str]:
    """A note on the samples (n,) outside the calibrated range, if there are any."""
    outside = int((complete & ~valid).sum())
    if outside:
        yield f"{outside} of {int(complete.sum())} samples left out: outside the calibrated range"


def recalibrate_log(
    calibration: LogCalibration, session: Session, drift: GainDrift | None = None, *, ignore_errors: bool = False
) -> LogCalibration:
    """The same calibration, moved to what the sensor reads in a log with known force: its gain and its offset.

    Args:
        drift: how far the gain may have moved; the offset by the same part of the largest calibrated force.
        ignore_errors: use also a session in which `check_session` finds an error, or that does not tell the gain.

    Raises:
        SessionError: if a stream is missing, the sensor is another, the log does not determine the gain, or
            has moved the calibration before, or the gain has moved by more than three standard deviations of what
            may have drifted; also with ignored errors, if the sensor does not follow the force.
        RecordingError: if `check_session` finds an error in the session, unless errors are ignored.

    Example:
        with calib.open_session("later.h5") as log:
            print(calibration.assess_log(sensor, log))
            sensor = calibration.recalibrate_log(sensor, log)
    """
    require_not_moved_by(calibration.provenance, session)
    found = assess_log(calibration, session, drift, ignore_errors=ignore_errors)
    if not found.determined and not ignore_errors:
        raise SessionError(f"{session.name}: {found.health}; {ANYWAY}")
    if not found.follows:
        raise SessionError(
            f"{session.name}: /streams/{calibration.stream}: does not follow the force: by the calibration it reads "
            f"{found.gain:.3g} N +- {found.errors[0]:.2g} N per newton; check the sensor, its tube and the order of "
            "the columns at import, and calibrate again if they are right"
        )
    spread = math.sqrt(shift_prior(calibration.shift, found.full_scale, drift or GainDrift())[1][0, 0])
    if not ignore_errors and abs(math.log(found.gain / found.before[0])) > MAX_DRIFTS * spread:
        raise SessionError(f"{session.name}: {found.moves}, {beyond_drift(spread)}; {ANYWAY}")
    history = [calibration.provenance.get("recalibrations", ""), found.summary()]
    return replace(
        calibration,
        shift=found,
        provenance=calibration.provenance
        | {"recalibrations": "\n".join(filter(None, history)), "recalibrated_utc": found.until},
        simulated=calibration.simulated or session.simulated,
        notes=(*calibration.notes, found.health, *found.notes),
    )
