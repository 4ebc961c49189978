"""What a recalibration records: the update of the gains, the levels at rest and their drift, and notes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...fitting.gain_update import GainUpdate
from ..calibration import Calibration
from .changes import Evidence, Recalibration


class RestLevels(NamedTuple):
    """Mean and standard deviation (pads,) Pa of the levels at rest; their drift and its standard error, Pa/h."""

    mean: np.ndarray
    deviation: np.ndarray
    drift: np.ndarray
    drift_error: np.ndarray


def recorded(
    calibration: Calibration,
    kind: Evidence,
    update: GainUpdate,
    count: np.ndarray,
    levels: RestLevels,
    origin: tuple[str, str],
    notes: Sequence[str] = (),
) -> Recalibration:
    """The record of an update; `origin`: time and name of what it rests on."""
    pads = tuple(pad.name for pad in calibration.skin.pads)
    before = np.zeros(len(pads)) if calibration.recalibration is None else calibration.recalibration.log_gain
    rest = np.full(len(pads), np.nan) if calibration.rest is None else np.asarray(calibration.rest)
    return Recalibration(
        log_gain=update.mean,
        covariance=update.covariance,
        before=before,
        determined=update.determined,
        count=count,
        offset=levels.mean,
        offset_change=levels.mean - rest,
        offset_error=levels.deviation,
        drift=levels.drift,
        drift_error=levels.drift_error,
        misfit=float(update.misfit),
        scatter=float(update.scatter),
        evidence=kind,
        pads=pads,
        session=origin[1],
        since=_recorded(calibration),
        until=origin[0],
        notes=(*notes, *_undetermined_notes(kind, update, pads, np.sqrt(np.diag(update.covariance)))),
    )


def _undetermined_notes(kind: Evidence, update: GainUpdate, pads: tuple[str, ...], error: np.ndarray) -> list[str]:
    """What the data do not determine."""
    unknown = [
        f"{name} (+- {100 * e:.0f} %)" for name, ok, e in zip(pads, update.determined, error, strict=True) if not ok
    ]
    notes = [f"hardly determines the gain of {', '.join(unknown)}"] if unknown else []
    if kind is Evidence.ORDINARY_USE:
        notes.append(
            "a gain common to all pads cannot be told from one of the image without known force: left as it was, "
            "with the uncertainty of what may have drifted"
        )
    outliers = int((update.weight < 0.3).sum())
    return notes + ([f"{outliers} of {len(update.weight)} are outliers and weigh little"] if outliers else [])


def rest_levels(levels: np.ndarray, time: np.ndarray) -> RestLevels:
    """Summary of levels (m, pads) Pa at times (m,) ns; the drift is NaN for fewer than three levels."""
    hours, mean = np.asarray(time, float) / 3.6e12, levels.mean(0)
    unknown = np.full(levels.shape[1], np.nan)
    if len(levels) < 3 or not np.ptp(hours) > 0:
        return RestLevels(mean, levels.std(0), unknown, unknown)
    lever = hours - hours.mean()
    slope = lever @ (levels - mean) / (lever @ lever)
    left = levels - mean - np.outer(lever, slope)
    error = np.sqrt((left**2).sum(0) / (len(levels) - 2) / (lever @ lever))
    return RestLevels(mean, levels.std(0, ddof=1), slope, error)


def _recorded(calibration: Calibration) -> str:
    known = calibration.provenance
    names = ("recalibrated_utc", "recorded_utc", "created_utc")
    return next((known[name] for name in names if name in known), "")
