"""What a recalibration changed: offsets, gains and drift of the pads, with standard errors and their origin."""

import enum
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxeit.messages.kinds import listed

from ...fitting.gain_update import relative_covariance
from ...fitting.pad_gains import PadGains
from ...session.errors import printable

NOTICEABLE_CHANGE = 0.02  # change of a gain below which a recalibration is not worth it
# Of a change over its standard error: the largest move of several pads is looked at, and while live again and again.
SIGNIFICANT_RATIO = 3.0
MAX_DRIFTS = 3.0  # standard deviations of what may have drifted, beyond which a unit or a pad is wrong
ANYWAY = "or move it all the same (--force, ignore_errors=True)"
LARGE_MISFIT = 2.0  # residuals over the stated ones: a gain does not explain the readings


class Evidence(enum.StrEnum):
    """What a recalibration rests on."""

    KNOWN_FORCE = "presses of known force"
    ORDINARY_USE = "ordinary use"


class Advice(enum.StrEnum):
    """What to do about a calibration."""

    KEEP = "no need to recalibrate"
    UNSURE = "not significant; more presses or contacts would tell"
    RECALIBRATE = "recalibrate"
    CALIBRATE = "calibrate again: a gain of each pad does not explain what it reads"
    UNKNOWN = "not determined; press every pad three times or more with a load cell"
    CALIBRATE_LOG = "calibrate again: a gain and an offset do not explain what the sensor reads"
    UNKNOWN_LOG = "not determined; press with several forces over a longer time"


def days_between(since: str, until: str) -> float:
    """Days between two ISO times; NaN if one is not known."""
    try:
        span = datetime.fromisoformat(until) - datetime.fromisoformat(since)
    except (ValueError, TypeError):  # no time, or only one of both has a time zone
        return math.nan
    return span.total_seconds() / 86_400


def health_line(since: str, until: str, days: float, moves: str, advice: Advice) -> str:
    """How far off a calibration was, since when, and what to do."""
    when = f"{_day(until)} against {_day(since)}"
    when += f" ({days:.1f} days)" if math.isfinite(days) and days > 0 else ""
    return f"calibration health, {when}: {moves}: {advice}"


def beyond_drift(expected: float) -> str:
    """Words for a move of more than `MAX_DRIFTS` times what may have drifted, a part of the gain."""
    todo = "check the units and gains of force and pressures, or expect more drift (--drift, GainDrift)"
    return f"far beyond the drift of {100 * expected:.0f} % that is expected; {todo}"


@dataclass(frozen=True, eq=False)
class Recalibration:
    """The last recalibration of a calibration. Logarithms are natural; a gain multiplies what a pad reads.

    | field         | meaning                                                                | shape        | unit |
    |---------------|------------------------------------------------------------------------|--------------|------|
    | log_gain      | of each pad since the calibration, which `apply` takes off             | (pads,)      | 1    |
    | covariance    | of `log_gain`                                                          | (pads, pads) | 1    |
    | before        | log gain before this recalibration                                     | (pads,)      | 1    |
    | determined    | whether the session determines the gain                                | (pads,)      |      |
    | count         | presses or contacts on the pad, in parts                               | (pads,)      |      |
    | offset        | level at rest now, which each recording's own zero takes off           | (pads,)      | Pa   |
    | offset_change | since the calibration; NaN where it kept no level                      | (pads,)      | Pa   |
    | offset_error  | standard deviation of the level over the session                       | (pads,)      | Pa   |
    | drift         | of the level at rest during the session; NaN for fewer than 3 rests    | (pads,)      | Pa/h |
    | drift_error   | its standard error                                                     | (pads,)      | Pa/h |
    | misfit        | residuals over the stated ones                                         |              | 1    |
    | scatter       | deviation of the forces that gains do not explain; NaN: not recorded   |              | 1    |
    | evidence      | known force or ordinary use, which determines gains up to a common one |              |      |
    | pads          | their names                                                            |              |      |
    | session       | name and SHA-256 of the session                                        |              |      |
    | since, until  | ISO times of the recordings between which the pads moved               |              |      |
    | notes         | what was left out, and what the session does not determine             |              |      |
    """

    log_gain: np.ndarray
    covariance: np.ndarray
    before: np.ndarray
    determined: np.ndarray
    count: np.ndarray
    offset: np.ndarray
    offset_change: np.ndarray
    offset_error: np.ndarray
    drift: np.ndarray
    drift_error: np.ndarray
    misfit: float
    scatter: float
    evidence: Evidence
    pads: tuple[str, ...]
    session: str
    since: str
    until: str
    notes: tuple[str, ...] = ()

    @property
    def gains(self) -> PadGains:
        """Gains as the force laws apply them."""
        return PadGains(jnp.asarray(self.log_gain), jnp.asarray(self.covariance))

    @property
    def change(self) -> np.ndarray:
        """Change of each log gain by this recalibration, (pads,)."""
        return np.asarray(self.log_gain - self.before)

    @property
    def change_error(self) -> np.ndarray:
        """Standard error (pads,) of `change`; without known force, of the change relative to the other pads."""
        known = self.evidence is Evidence.KNOWN_FORCE
        return np.asarray(np.sqrt(np.diag(self.covariance if known else relative_covariance(self.covariance))))

    @property
    def significant(self) -> np.ndarray:
        """Whether each gain moved noticeably and by more than its error allows, (pads,)."""
        size = np.abs(self.change)
        return np.asarray(self.determined & (size > NOTICEABLE_CHANGE) & (size > SIGNIFICANT_RATIO * self.change_error))

    @property
    def days(self) -> float:
        """Days between the recordings; NaN if a time is not known."""
        return days_between(self.since, self.until)

    @property
    def advice(self) -> Advice:
        """What to do about the calibration as it was before this recalibration."""
        if not self.determined.any():
            return Advice.UNKNOWN
        if self.misfit > LARGE_MISFIT and not self.scatter <= NOTICEABLE_CHANGE:  # NaN: files of an early version
            return Advice.CALIBRATE
        if self.significant.any():
            return Advice.RECALIBRATE
        return Advice.UNSURE if (np.abs(self.change) > NOTICEABLE_CHANGE)[self.determined].any() else Advice.KEEP

    @property
    def health(self) -> str:
        """How far off the calibration was, since when, and what to do, in one line."""
        return health_line(self.since, self.until, self.days, self.moves, self.advice)

    @property
    def moves(self) -> str:
        """How far the pads have moved, in words."""
        known = np.flatnonzero(self.determined)
        if not len(known):
            return "the gains of the pads"
        change, error = 100 * np.expm1(self.change[known]), 100 * float(self.change_error[known].max())
        low, high = int(np.argmin(change)), int(np.argmax(change))
        spans = f"{change[low]:+.1f} % ({printable(self.pads[known[low]])})"
        spans += "" if low == high else f" to {change[high]:+.1f} % ({printable(self.pads[known[high]])})"
        against = "" if self.evidence is Evidence.KNOWN_FORCE else " relative to each other"
        return f"pads read {spans}{against}, +- {error:.1f} %"

    def rows(self) -> list[dict[str, Any]]:
        """One row for each pad, in SI, as for JSON; None where not known."""
        columns = {
            "offset_pa": self.offset,
            "offset_change_pa": self.offset_change,
            "offset_error_pa": self.offset_error,
            "drift_pa_per_hour": self.drift,
            "drift_error_pa_per_hour": self.drift_error,
            "gain_before": np.exp(self.before),
            "gain": np.exp(self.log_gain),
            "gain_error": np.exp(self.log_gain) * np.sqrt(np.diag(self.covariance)),
            "change": np.expm1(self.change),
            "change_error": np.exp(self.change) * self.change_error,
            "count": self.count,
        }
        return [
            {
                "pad": name,
                **{key: _finite(column[i]) for key, column in columns.items()},
                "determined": bool(self.determined[i]),
                "significant": bool(self.significant[i]),
            }
            for i, name in enumerate(self.pads)
        ]

    def to_json(self) -> str:
        """The recalibration as JSON."""
        body = {
            "format": "skin-recalibration",
            "evidence": str(self.evidence),
            "session": self.session,
            "since": self.since,
            "until": self.until,
            "days": _finite(self.days),
            "misfit": _finite(self.misfit),
            "scatter": _finite(self.scatter),
            "covariance_log_gain": self.covariance.tolist(),
            "pads": self.rows(),
            "health": self.health,
            "advice": self.advice.name.lower(),
            "notes": list(self.notes),
        }
        return json.dumps(body, indent=1, sort_keys=True, allow_nan=False)

    def summary(self) -> str:
        """One line for the provenance of the calibration."""
        gains = listed(
            f"{printable(pad)} {gain:.4f}" for pad, gain in zip(self.pads, np.exp(self.log_gain), strict=True)
        )
        return f"{self.session}: {self.evidence}, recorded {self.until}: gains {gains}"

    # --- for the calibration file ------------------------------------------------------------------------------

    def attributes(self) -> dict[str, Any]:
        """What is no array, by its name in the file."""
        return {"recalibration": json.dumps({name: getattr(self, name) for name in _WORDS})}

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """The arrays by their names in the file, each with unit and meaning."""
        values = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        return {
            f"recalibration/{name}": (value.astype("u1") if value.dtype == bool else value, *_ARRAYS[name])
            for name, value in values.items()
        }

    @staticmethod
    def restore(attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray], pads: int) -> "Recalibration | None":
        """The recalibration of a file; None if it has none. Raises KeyError or ValueError for what does not fit."""
        if "recalibration" not in attrs:
            return None
        words = json.loads(str(attrs["recalibration"]))
        found: dict[str, Any] = {name: np.asarray(arrays[f"recalibration/{name}"]) for name in _ARRAYS}
        for name, array in found.items():
            shape = (pads, pads) if name == "covariance" else (pads,)
            if array.shape != shape or array.dtype.kind not in "fu":
                raise ValueError(f"recalibration/{name} is {array.dtype} of shape {array.shape}, not {shape}")
        found["determined"] = found["determined"].astype(bool)
        found |= {name: str(words[name]) for name in ("session", "since", "until")}
        found |= {name: tuple(map(str, words[name])) for name in ("pads", "notes")}
        found |= {"misfit": float(words["misfit"]), "scatter": float(words.get("scatter", math.nan))}
        return Recalibration(**found, evidence=Evidence(words["evidence"]))


_ARRAYS = {
    "log_gain": ("1", "log of what a pad reads over what it read at the calibration"),
    "covariance": ("1", "of log_gain"),
    "before": ("1", "log_gain before the last recalibration"),
    "determined": ("1", "1: by the session"),
    "count": ("1", "presses or contacts on the pad"),
    "offset": ("Pa", "level at rest"),
    "offset_change": ("Pa", "since the calibration"),
    "offset_error": ("Pa", "standard deviation of the level"),
    "drift": ("Pa/h", "of the level at rest"),
    "drift_error": ("Pa/h", "standard error"),
}
_WORDS = tuple(f.name for f in fields(Recalibration) if f.name not in _ARRAYS)


def render(found: Recalibration) -> str:
    """The recalibration as a table for a terminal."""
    head = ("pad", "offset Pa", "change Pa", "drift Pa/h", "gain before", "gain", "+-", "moved %", "+-", "")
    rows = [_cells(row) for row in found.rows()]
    widths = [max(len(r[i]) for r in (head, *rows)) for i in range(len(head))]
    lines = [f"{found.session.split('  ')[-1]}: {found.evidence}"]
    for row in (head, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append(("  " + "  ".join([row[0].ljust(widths[0]), *cells[1:]])).rstrip())
    return "\n".join([*lines, *(f"  note: {note}" for note in found.notes), found.health])


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    words = "significant" if row["significant"] else "" if row["determined"] else "not determined"
    return (
        printable(row["pad"]),
        _number(row["offset_pa"], ".1f"),
        _number(row["offset_change_pa"], "+.1f"),
        _number(row["drift_pa_per_hour"], "+.2g"),
        f"{row['gain_before']:.4f}",
        f"{row['gain']:.4f}",
        f"{row['gain_error']:.4f}",
        f"{100 * row['change']:+.2f}",
        f"{100 * row['change_error']:.2f}",
        words,
    )


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _day(text: str) -> str:
    return text[:10] or "an unknown date"
