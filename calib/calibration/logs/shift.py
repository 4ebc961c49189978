"""Recalibration of a log's calibration: what the sensor reads now, as a gain and an offset of its force.

With F the force and m what the calibration makes of the channels, m = g F + b with the gain g and the offset b, which
are 1 and 0 at the calibration. Both follow from a log with known force by least squares, weighted by the noise of the
calibration; their covariance comes from blocks of time, because samples that follow each other err together
(Liang and Zeger 1986, Biometrika 73). What may have drifted since the last time is the prior.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...fitting.gain_update import MAX_DETERMINED_RATIO, GainDrift
from ...fitting.logs import LogModel, LogPrediction
from ..recalibration.changes import (
    LARGE_MISFIT,
    NOTICEABLE_CHANGE,
    SIGNIFICANT_RATIO,
    Advice,
    days_between,
    health_line,
)

MIN_BLOCKS = 5  # of time, with which a standard error over them means something
MIN_GAIN = 0.1  # of what the sensor read before; a sensor below it does not follow the force, or has another unit


@dataclass(frozen=True, eq=False)
class LogShift:
    """How a sensor without EIT has moved since its calibration.

    | field          | meaning                                                      | shape  | unit |
    |----------------|--------------------------------------------------------------|--------|------|
    | gain           | what the sensor reads over what it read at the calibration   |        | 1    |
    | offset         | force that it reads without force                            |        | N    |
    | covariance     | of gain and offset                                           | (2, 2) |      |
    | before         | gain and offset before this recalibration                    | (2,)   |      |
    | full_scale     | largest force of the calibration                             |        | N    |
    | determined     | whether the log determines the gain                          |        |      |
    | misfit         | residuals over the stated ones                               |        | 1    |
    | scatter        | deviation that gain and offset leave; NaN: not recorded      |        | N    |
    | session        | name and SHA-256 of the log                                  |        |      |
    | since, until   | ISO times of the recordings between which the sensor moved   |        |      |
    | notes          | what was left out, and what the log does not determine       |        |      |
    """

    gain: float
    offset: float
    covariance: Float[np.ndarray, "2 2"]
    before: Float[np.ndarray, " 2"]
    full_scale: float
    determined: bool
    misfit: float
    scatter: float
    session: str
    since: str
    until: str
    notes: tuple[str, ...] = ()

    @property
    def errors(self) -> tuple[float, float]:
        """Standard errors of gain and offset (N)."""
        gain, offset = np.sqrt(np.diag(self.covariance)).tolist()
        return gain, offset

    @property
    def follows(self) -> bool:
        """Whether the sensor still follows the force, so that a gain can be taken off."""
        return self.gain >= MIN_GAIN * float(self.before[0])

    @property
    def advice(self) -> Advice:
        """What to do about the calibration as it was before this recalibration."""
        if not self.determined:
            return Advice.UNKNOWN_LOG
        if not self.follows:
            return Advice.CALIBRATE_LOG
        if self.misfit > LARGE_MISFIT and not self.scatter <= NOTICEABLE_CHANGE * self.full_scale:  # NaN: early files
            return Advice.CALIBRATE_LOG
        change = np.abs([self.gain / self.before[0] - 1, (self.offset - self.before[1]) / self.full_scale])
        errors = np.array([self.errors[0] / self.before[0], self.errors[1] / self.full_scale])
        moved = change > NOTICEABLE_CHANGE
        if (moved & (change > SIGNIFICANT_RATIO * errors)).any():
            return Advice.RECALIBRATE
        return Advice.UNSURE if moved.any() else Advice.KEEP

    @property
    def health(self) -> str:
        """How far off the calibration was, since when, and what to do, in one line."""
        days = days_between(self.since, self.until)
        return health_line(self.since, self.until, days, self.moves if self.determined else "the sensor", self.advice)

    @property
    def moves(self) -> str:
        """How far gain and offset have moved, in words."""
        change, (gain, offset) = 100 * (self.gain / self.before[0] - 1), self.errors
        moves = f"the sensor reads {change:+.1f} % +- {100 * gain / self.before[0]:.1f} %"
        return f"{moves} and {self.offset - self.before[1]:+.2g} N +- {offset:.2g} N without force"

    def applied(self, found: LogPrediction, multiple: float) -> LogPrediction:
        """Forces of the calibration with gain and offset taken off; `multiple`: half the interval in deviations."""
        force = (found.force - self.offset) / self.gain
        rows = np.stack([force, np.ones(len(force))])
        variance = np.einsum("in,ij,jn->n", rows, self.covariance, rows)
        deviation = np.sqrt(found.standard_error**2 + variance) / self.gain
        half = multiple * deviation
        return found._replace(force=force, standard_error=deviation, low=force - half, high=force + half)

    def to_json(self) -> str:
        """The recalibration as JSON."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
        error, offset = self.errors
        body = {"format": "log-recalibration", **plain, "gain_error": error, "offset_error": offset}
        body |= {"health": self.health, "advice": self.advice.name.lower()}
        return json.dumps({k: None if v != v else v for k, v in body.items()}, indent=1, sort_keys=True)

    def summary(self) -> str:
        """One line for the provenance of the calibration."""
        return f"{self.session}: recorded {self.until}: gain {self.gain:.4f}, offset {self.offset:.4g} N"

    # --- for the calibration file ------------------------------------------------------------------------------

    def arrays(self) -> dict[str, tuple[Any, str, str]]:
        """The numbers by their names in the file, each with unit and meaning."""
        return {f"shift/{name}": (np.asarray(getattr(self, name), float), *about) for name, about in _NUMBERS.items()}

    def attributes(self) -> dict[str, Any]:
        """What is no number, by its name in the file."""
        return {"shift": json.dumps({name: getattr(self, name) for name in _WORDS})}

    @staticmethod
    def restore(attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "LogShift | None":
        """The recalibration of a file; None if it has none. Raises KeyError or ValueError for what does not fit."""
        if "shift" not in attrs:
            return None
        words = json.loads(str(attrs["shift"]))
        held = {"shift/scatter": np.nan} | dict(arrays)
        numbers: dict[str, Any] = {name: np.asarray(held[f"shift/{name}"], float) for name in _NUMBERS}
        numbers |= {name: float(numbers[name]) for name in ("gain", "offset", "full_scale", "misfit", "scatter")}
        texts: dict[str, Any] = {name: str(words[name]) for name in ("session", "since", "until")}
        numbers["determined"] = bool(numbers["determined"])
        found = LogShift(**numbers, **texts, notes=tuple(map(str, words["notes"])))
        possible = found.covariance.shape == (2, 2) and found.before.shape == (2,) and found.before[0] > 0
        if not (possible and found.gain > 0 and found.full_scale > 0 and (np.diag(found.covariance) >= 0).all()):
            raise ValueError("shift: no gain above zero with a covariance")
        return found


_NUMBERS = {
    "gain": ("1", "what the sensor reads over what it read at the calibration"),
    "offset": ("N", "force that it reads without force"),
    "covariance": ("", "of gain and offset"),
    "before": ("", "gain and offset before the last recalibration"),
    "full_scale": ("N", "largest force of the calibration"),
    "determined": ("1", "1: the log determines the gain"),
    "misfit": ("1", "residuals over the stated ones"),
    "scatter": ("N", "deviation that gain and offset leave"),
}
_WORDS = ("session", "since", "until", "notes")


class ShiftFit(NamedTuple):
    """Gain and offset, their covariance, whether the gain is determined; residuals over the stated ones, and in N."""

    mean: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "2 2"]
    determined: bool
    misfit: float
    scatter: float


def shift_prior(last: LogShift | None, full_scale: float, drift: GainDrift) -> tuple[np.ndarray, np.ndarray]:
    """Mean (2,) and covariance (2, 2) of gain and offset, with what may have drifted since they were known last."""
    spread = math.hypot(drift.own, drift.common)
    moved = np.diag([spread**2, (spread * full_scale) ** 2])
    if last is None:
        return np.array([1.0, 0.0]), moved
    return np.array([last.gain, last.offset]), last.covariance + moved


def fit_shift(
    force: Float[np.ndarray, " n"],
    read: Float[np.ndarray, " n"],
    deviation: Float[np.ndarray, " n"],
    block: np.ndarray,
    prior: tuple[np.ndarray, np.ndarray],
) -> ShiftFit:
    """Gain and offset of what a sensor reads about known forces.

    Args:
        force: known, N.
        read: what the calibration makes of the channels, N.
        deviation: of a reading, as the calibration states it, N.
        block: number of the block of time of each sample.
        prior: mean (2,) and covariance (2, 2).

    Raises:
        ValueError: for fewer than `MIN_BLOCKS` blocks.
    """
    mean, covariance = prior
    count = len(np.unique(block))
    if count < MIN_BLOCKS:
        raise ValueError(f"{count} blocks of time with known force, and {MIN_BLOCKS} are needed; record a longer log")
    unit = np.sqrt(np.diag(covariance))  # both unknowns in deviations of the prior
    rows = np.stack([force, np.ones(len(force))], 1) * unit / deviation[:, None]
    left = (read - mean[0] * force - mean[1]) / deviation
    normal = rows.T @ rows
    residual = left - rows @ np.linalg.lstsq(rows, left, rcond=1e-10)[0]
    score = np.stack([rows[block == k].T @ residual[block == k] for k in np.unique(block)])
    meat = score.T @ score * count / (count - 2) + 1e-12 * np.trace(normal) * np.eye(2)
    weight = np.linalg.solve(meat, normal).T
    precision = weight @ normal + np.linalg.solve(covariance / np.outer(unit, unit), np.eye(2))
    found = np.linalg.solve(precision, weight @ (rows.T @ left))
    posterior = np.linalg.solve(precision, np.eye(2)) * np.outer(unit, unit)
    gain, offset = mean + found * unit
    remains = read - gain * force - offset
    misfit, scatter = (float(np.sqrt(np.mean(size**2))) for size in (remains / deviation, remains))
    determined = bool(posterior[0, 0] < MAX_DETERMINED_RATIO**2 * covariance[0, 0])
    return ShiftFit(np.array([gain, offset]), (posterior + posterior.T) / 2, determined, misfit, scatter)


def full_scale_of(model: LogModel) -> float:
    """Largest force (N) of the fitted curve over its range of signals."""
    low, high = np.asarray(model.curve.pressure_range, float).tolist()
    ends = np.linspace(low, high, 32)
    force = np.asarray(model.curve.predict(ends).force, float)
    return float(np.nanmax(np.abs(force), initial=0.0)) or 1.0


def render_shift(found: LogShift) -> str:
    """The recalibration as lines for a terminal."""
    gain, offset = found.errors
    lines = [
        f"{found.session.split('  ')[-1]}: presses of known force",
        f"  gain    {found.before[0]:.4f} -> {found.gain:.4f} +- {gain:.4f}",
        f"  offset  {found.before[1]:.4g} N -> {found.offset:.4g} N +- {offset:.2g} N",
    ]
    return "\n".join([*lines, *(f"  note: {note}" for note in found.notes), found.health])
