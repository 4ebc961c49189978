"""Errors of a log's calibration over the samples of a recording: size, intervals, and samples outside its range."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ...fitting.logs import LogPrediction

# Share of the range of forces above which relative errors count; below it they say nothing.
RELATIVE_FROM = 0.1
# RMSE over the standard deviation of the force: from here on the mean force would be as good a guess as the sensor.
USELESS = 0.9
LOG_THIRDS = ("low", "middle", "high")


@dataclass(frozen=True, eq=False)
class LogEvaluation:
    """Predicted and recorded forces of a log.

    | meaning                                                                  | shape | unit |
    |--------------------------------------------------------------------------|-------|------|
    | title: the recording, in words                                           |       |      |
    | time, from the start                                                     | (n,)  | s    |
    | force: recorded; NaN where missing                                       | (n,)  | N    |
    | predicted; NaN where a channel is missing                                | (n,)  | N    |
    | low, high: the interval that 90 % of new readings fall into              | (n,)  | N    |
    | standard_error of a reading                                              | (n,)  | N    |
    | valid: within the calibrated range                                       | (n,)  |      |
    | notes: remarks for the reader of the results                             |       |      |
    """

    title: str
    time: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    predicted: Float[np.ndarray, " n"]
    standard_error: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]
    notes: tuple[str, ...] = ()

    @property
    def known(self) -> np.ndarray:
        """Flags (n,) of the samples with a recorded and a predicted force."""
        return np.asarray(np.isfinite(self.force) & np.isfinite(self.predicted))

    @property
    def missing(self) -> str:
        """Why no error is known, in words; empty: some sample has both a recorded and a predicted force."""
        if self.known.any():
            return ""
        if not np.isfinite(self.force).any():
            return "no sample has a recorded force; record the load cell to the end"
        if not np.isfinite(self.predicted).any():
            return "no sample has all channels, which tell the force; record the sensor to the end"
        return "no sample has both a recorded force and all channels; record both to the end"

    def summary(self) -> dict[str, float]:
        """Summary statistics by name; forces in N, shares from 0 to 1, NaN where no sample tells.

        Errors are over all samples. The coverage of the interval is over samples within the calibrated range: of all
        of these, and of each third of the range of recorded forces.
        """
        rows = self.known
        error, force = (self.predicted - self.force)[rows], self.force[rows]
        size = float(np.sqrt(_mean(error**2)))
        top = float(np.abs(force).max(initial=0.0))
        heavy = np.abs(force) > RELATIVE_FROM * top
        return {
            "samples": float(len(force)),
            "force_rmse": size,
            "force_rmse_percent_full_scale": 100 * size / top if top else float("nan"),
            "force_mape": 100 * _mean(np.abs(error[heavy] / force[heavy])),
            "force_bias": _mean(error),
            "force_mean_absolute": _mean(np.abs(error)),
            "force_worst": float(np.abs(error).max(initial=0.0)),
            "outside_share": _mean(~self.valid[np.isfinite(self.predicted)]),
            **self._coverage(rows & self.valid),
        }

    def _coverage(self, rows: np.ndarray) -> dict[str, float]:
        inside = ((self.force >= self.low) & (self.force <= self.high))[rows]
        third = thirds(self.force[rows])
        each = {f"coverage_{name}": _mean(inside[third == k]) for k, name in enumerate(LOG_THIRDS)}
        return {"coverage": _mean(inside), **each}

    def attributes(self) -> dict[str, str]:
        """Attributes of the file that `restore` needs beside the arrays."""
        return {"title": self.title, "notes": "\n".join(self.notes)}

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Arrays of the file: name to values, unit and meaning."""
        return {name: (getattr(self, name), *about) for name, about in ARRAYS.items()}

    @classmethod
    def restore(
        cls, attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray], attribute: str, array: str
    ) -> "LogEvaluation":
        """The evaluation that `attributes` and `arrays` described, found under these prefixes."""
        notes = tuple(filter(None, str(attrs[f"{attribute}notes"]).split("\n")))
        return cls(str(attrs[f"{attribute}title"]), **{name: arrays[array + name] for name in ARRAYS}, notes=notes)


ARRAYS: Mapping[str, tuple[str, str]] = {
    "time": ("s", "from the start of the recording"),
    "force": ("N", "recorded; NaN where missing"),
    "predicted": ("N", "force by the calibration"),
    "standard_error": ("N", "of a reading"),
    "low": ("N", "lower end of the 90 % interval of a reading"),
    "high": ("N", "upper end of the 90 % interval of a reading"),
    "valid": ("", "whether channels and place lie within the calibrated ranges"),
}


def log_evaluation(
    title: str, time: np.ndarray, force: np.ndarray, found: LogPrediction, notes: tuple[str, ...] = ()
) -> LogEvaluation:
    """The evaluation of predictions at times (n,) ns, for recorded forces (n,) N."""
    seconds = (np.asarray(time, float) - float(time[0])) / 1e9 if len(time) else np.empty(0)
    notes = (*notes, *_uselessness(found.force, force))
    return LogEvaluation(
        title, seconds, force, found.force, found.standard_error, found.low, found.high, found.valid, notes
    )


def _uselessness(predicted: np.ndarray, force: np.ndarray) -> Iterator[str]:
    """A note where predicted forces are no better than the mean of the recorded ones."""
    rows = np.isfinite(predicted) & np.isfinite(force)
    error, varies = np.sqrt(_mean((predicted - force)[rows] ** 2)), float(np.std(force[rows])) if rows.any() else 0.0
    if varies > 0 and error > USELESS * varies:
        yield (
            f"the errors are as large as the forces vary (RMSE {error:.3g} N, standard deviation of the force "
            f"{varies:.3g} N): the sensor does not tell this force"
        )


def thirds(force: Float[np.ndarray, " n"]) -> np.ndarray:
    """Third (n,) of the range of the forces in which each lies: 0, 1 or 2."""
    low, high = force.min(initial=np.inf), force.max(initial=-np.inf)
    return np.asarray(np.digitize(force, np.linspace(low, high, 4)[1:-1]) if high > low else np.zeros(len(force), int))


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def render_evaluation(evaluation: LogEvaluation, title: str = "") -> str:
    """The results as lines for a terminal."""
    s = evaluation.summary()
    each = ", ".join(f"{name} {_percent(s[f'coverage_{name}'])}" for name in LOG_THIRDS)
    relative = (
        f" = {s['force_rmse_percent_full_scale']:.1f} % of the largest force, MAPE {s['force_mape']:.1f} % "
        f"(forces above {RELATIVE_FROM:.0%} of the largest)"
    )
    known = np.isfinite(s["force_mape"])  # of forces that are all zero there is no percentage
    errors = (
        f"  force RMSE {s['force_rmse']:.3f} N{relative if known else ''}, bias {s['force_bias']:+.3f} N",
        f"  within the 90 % interval: {_percent(s['coverage'])} of samples; by third of force: {each}",
        f"  outside the calibrated range: {_percent(s['outside_share'])} of samples",
    )
    lines = [f"  errors not known: {evaluation.missing}"] if evaluation.missing else errors
    heading = f"{title or evaluation.title}: {s['samples']:.0f} samples"
    return "\n".join([heading, *lines, *(f"  note: {note}" for note in evaluation.notes)])


def _percent(share: float) -> str:
    return "none" if np.isnan(share) else f"{100 * share:.1f} %"
