"""Evaluation of a calibration: errors of place and force, and evenness of sensitivity, over the presses of a session.

The quantities are those of the paper: true and estimated positions (figure 5); sensitivity, which is estimated over
true force (up to a constant for the image alone), at every place, and its coefficient of variation (figure 6).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

import jaxeit as je

from ..fitting.cross_validation.held_out import LeaveOutErrors, bootstrap_interval, place_draws

CALIBRATED = "calibrated"
FORCE_THIRDS = ("small", "middle", "large")
"""Thirds of the range of force, up to the largest of the presses."""
FORCE_METHODS = {
    "eit": "EIT only",
    "hybrid": "hybrid",
    CALIBRATED: "calibrated",
    "true_place": "true place",
}
"""Methods of estimating the total force, and their names in reports: the integral of the image alone, the paper's
recipe (one slope per pad), the calibration itself, and the calibration given the true place, for comparison."""


class MethodErrors(NamedTuple):
    """Evenness and errors of one method of estimating the total force; NaN where not known.

    | meaning                                                              | unit |
    |----------------------------------------------------------------------|------|
    | label: the method in words, the calibration's with its recipe        |      |
    | cv: coefficient of variation of the sensitivity, ddof 1              | 1    |
    | cv_error: standard error of cv                                       | 1    |
    | rmse, mean_absolute, worst: errors of the total force                | N    |
    | percent: rmse of the largest force                                   | %    |
    """

    label: str
    cv: float
    cv_error: float
    rmse: float
    percent: float
    mean_absolute: float
    worst: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of an evaluation, press by press.

    | meaning                                                            | shape           | unit |
    |--------------------------------------------------------------------|-----------------|------|
    | position of the tip, true                                          | (presses, 2)    | m    |
    | estimated positions, by each named estimator                       | (presses, 2)    | m    |
    | force: true, from the load cell                                    | (presses,)      | N    |
    | pressure: change of each pad's pressure over the hold              | (presses, pads) | Pa   |
    | pad_force: estimated for each pad, by a fit that had not seen it   | (presses, pads) | N    |
    | half_width: half the 90 % interval of the total force; None: old  | (presses,)      | N    |
    | image_sum: integral of the image                                   | (presses,)      | S m^2|
    | centre of the sheet                                                | (2,)            | m    |
    | held_out_by: what the fit had not seen, "location" or "session";   |                 |      |
    |   empty if it had seen all                                         |                 |      |
    | others: total force by other `FORCE_METHODS`, held out alike       | (presses,) each | N    |
    | recipe: curve and location of the calibration, in words            |                 |      |
    | splits: errors with pads, indenters or sessions held out           |                 |      |
    | notes: remarks for the reader of the results                       |                 |      |

    Example:
        print(mine.evaluation.held_out)  # what the fits had not seen
        for method in mine.evaluation.by_method():
            print(method)
        print(mine.evaluation.summary()["force_rmse"])  # N
    """

    position: np.ndarray
    estimated: dict[str, np.ndarray]
    force: np.ndarray
    pressure: np.ndarray
    pad_force: np.ndarray
    image_sum: np.ndarray
    centre: np.ndarray
    held_out_by: str
    half_width: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    others: Mapping[str, np.ndarray] = field(default_factory=dict)
    recipe: str = ""
    splits: tuple[LeaveOutErrors, ...] = ()

    @property
    def total_force(self) -> np.ndarray:
        """Sum of the pads' forces, (presses,) N."""
        return np.asarray(self.pad_force.sum(1))

    @property
    def sensitivity_eit(self) -> np.ndarray:
        """Image sum per newton, divided by its mean over the presses, (presses,)."""
        ratio = self.image_sum / self.force
        return np.asarray(ratio / ratio.mean())

    @property
    def held_out(self) -> str:
        """What the fit had not seen, in words."""
        return f"held out by {self.held_out_by}" if self.held_out_by else "not held out"

    @property
    def sensitivity_hybrid(self) -> np.ndarray:
        """Estimated over true force of the paper's recipe, (presses,)."""
        return self.sensitivity("hybrid" if "hybrid" in self.others else CALIBRATED)

    @property
    def forces(self) -> dict[str, np.ndarray]:
        """Total force by method, (presses,) N each; the calibration's own is last, or followed by `true_place`."""
        last = {k: v for k, v in self.others.items() if k == "true_place"}
        return {k: v for k, v in self.others.items() if k not in last} | {CALIBRATED: self.total_force} | last

    def sensitivity(self, method: str) -> np.ndarray:
        """Estimated over true force by one of the methods in `forces`, (presses,)."""
        return np.asarray(self.forces[method] / self.force)

    def summary(self) -> dict[str, float]:
        """Summary statistics by name: lengths in m, forces in N, each CV with its ddof."""
        out: dict[str, float] = {"presses": len(self.force)}
        for name, estimate in self.estimated.items():
            out |= {f"localisation_{name}_{k}": v for k, v in self._localisation(estimate).items()}
        spreads = {"eit": self.sensitivity_eit, "hybrid": self.sensitivity_hybrid}
        spreads |= {name: self.sensitivity(name) for name in self.forces if name not in spreads}
        for name, values in spreads.items():
            if len(values) > 1:
                for ddof in (0, 1):
                    cv = je.metrics.coefficient_of_variation(values, ddof=ddof)
                    out[f"cv_{name}_ddof{ddof}"] = float(cv)
                out |= {f"cv_{name}_{k}": v for k, v in self._spread(values, _cv).items()}
        out |= {f"force_{k}": v for k, v in self._errors(self.total_force).items()}
        out |= self._coverage()
        for name, total in self.others.items():
            out |= {f"force_{name}_{k}": v for k, v in self._errors(total).items()}
        for split in self.splits:
            if not split.note:
                out[f"force_left_out_{split.by}_rmse"] = split.rmse
        return out

    def _coverage(self) -> dict[str, float]:
        """Parts of the presses whose force lies in its 90 % interval: of all, and of each third of the force."""
        if self.half_width is None or not np.isfinite(self.half_width).any():
            return {}
        known = np.isfinite(self.half_width)
        inside = np.abs(self.total_force - self.force) <= self.half_width
        third = np.minimum((3 * self.force / self.force.max()).astype(int), 2)
        parts = {name: known & (third == k) for k, name in enumerate(FORCE_THIRDS)}
        out = {"coverage": float(inside[known].mean())}
        return out | {f"coverage_{name}": float(inside[part].mean()) for name, part in parts.items() if part.any()}

    @cached_property
    def _places(self) -> np.ndarray:
        """Number of the place of each press, (presses,)."""
        return np.asarray(np.unique(np.round(self.position, 6), axis=0, return_inverse=True)[1].ravel())

    @cached_property
    def _draws(self) -> np.ndarray:
        """How often each press is drawn when places are drawn with replacement, (draws, presses)."""
        return place_draws(self._places)

    def _spread(
        self, values: np.ndarray, statistic: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> dict[str, float]:
        """Standard error and 90 % interval of a statistic, by the bootstrap over places; nothing from one place."""
        if not self._places.any():
            return {}
        drawn = statistic(values, self._draws)
        low, high = bootstrap_interval(drawn)
        return {"se": float(drawn.std(ddof=1)), "low": low, "high": high}

    def by_method(self) -> list[MethodErrors]:
        """Evenness and errors of each method: EIT only, then the methods in the order of `forces`."""
        s = self.summary()
        return [self._method_errors(name, s) for name in dict.fromkeys(["eit", *self.forces])]

    def _method_errors(self, name: str, s: Mapping[str, float]) -> MethodErrors:
        recipe = f" ({self.recipe})" if name == CALIBRATED and self.recipe else ""
        mark = "" if name == CALIBRATED else f"{name}_"
        keys = [f"cv_{name}_ddof1", f"cv_{name}_se"]
        keys += [f"force_{mark}{k}" for k in ("rmse", "rmse_percent_full_scale", "mean_absolute", "worst")]
        return MethodErrors(FORCE_METHODS[name] + recipe, *(float(s.get(key, np.nan)) for key in keys))

    def _errors(self, total: np.ndarray) -> dict[str, float]:
        error = total - self.force
        size = float(np.sqrt(np.mean(error**2)))
        return {
            "rmse": size,
            **{f"rmse_{k}": v for k, v in self._spread(error, _rms).items()},
            "mean_absolute": float(np.abs(error).mean()),
            "worst": float(np.abs(error).max()),
            "rmse_percent_full_scale": 100 * size / float(self.force.max()),
        }

    def _localisation(self, estimate: np.ndarray) -> dict[str, float]:
        error = np.asarray(je.localisation_error(estimate, self.position))
        inward = np.asarray(je.metrics.inward_bias(estimate, self.position, self.centre))
        spread = self._spread(error, _mean)
        return {
            "mean": float(error.mean()),
            **({"mean_se": spread["se"]} if spread else {}),
            "median": float(np.median(error)),
            "p95": float(np.percentile(error, 95)),
            "inward_bias": float(inward.mean()),
        }

    def attributes(self) -> dict[str, str]:
        """Attributes of the file that `restore` needs beside the arrays."""
        splits = json.dumps([split._asdict() for split in self.splits])
        return {
            "held_out_by": self.held_out_by,
            "notes": "\n".join(self.notes),
            "recipe": self.recipe,
            "splits": splits,
        }

    def arrays(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Arrays of the file: name to values, unit and meaning."""
        out = {
            "position": (self.position, "m", "true position of the tip"),
            "force": (self.force, "N", "load cell"),
            "pressure": (self.pressure, "Pa", "change of each pad's pressure over the hold"),
            "pad_force": (self.pad_force, "N", f"estimated, {self.held_out}"),
            "image_sum": (self.image_sum, "S m2", "integral of the image"),
            "centre": (self.centre, "m", "centre of the sheet"),
        }
        if self.half_width is not None:
            out["half_width"] = (self.half_width, "N", "half the 90 % interval of the total force")
        for name, estimate in self.estimated.items():
            out[f"estimated_{name}"] = (estimate, "m", f"position estimated by {name}")
        for name, total in self.others.items():
            out[f"force_{name}"] = (total, "N", f"total force by {FORCE_METHODS[name]}, {self.held_out}")
        return out

    @classmethod
    def restore(
        cls, attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray], attribute: str, array: str
    ) -> "Evaluation":
        """The evaluation that `attributes` and `arrays` described, found under these prefixes."""

        def named(mark: str) -> dict[str, np.ndarray]:
            return {k.removeprefix(array + mark): v for k, v in arrays.items() if k.startswith(array + mark)}

        names = ("position", "force", "pressure", "pad_force", "image_sum", "centre")
        return cls(
            **{name: arrays[array + name] for name in names},
            estimated=named("estimated_"),
            half_width=arrays.get(array + "half_width"),
            others={name: total for name, total in named("force_").items() if name in FORCE_METHODS},
            recipe=str(attrs.get(f"{attribute}recipe", "")),
            splits=tuple(LeaveOutErrors(**split) for split in json.loads(str(attrs.get(f"{attribute}splits", "[]")))),
            held_out_by=str(attrs[f"{attribute}held_out_by"]),
            notes=tuple(filter(None, str(attrs[f"{attribute}notes"]).split("\n"))),
        )


def centre_of(skin: je.Skin) -> np.ndarray:
    """Centre of a sheet's bounding box, (2,) m: what the inward bias is measured towards."""
    return np.asarray(np.mean(skin.domain.bounds, 0))


def _mean(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means (draws,) of values (presses,) with weights (draws, presses)."""
    return np.asarray(weight @ values / weight.sum(1))


def _rms(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(_mean(values**2, weight)))


def _cv(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients of variation (draws,) with ddof 1 of values (presses,) with weights (draws, presses)."""
    mean, count = _mean(values, weight), weight.sum(1)
    # The variance is taken about the mean of all presses, because the difference of raw moments would cancel.
    about = np.maximum(_mean((values - values.mean()) ** 2, weight) - (mean - values.mean()) ** 2, 0)
    return np.asarray(np.sqrt(about * count / np.maximum(count - 1, 1)) / mean)


def localisation_errors(summary: Mapping[str, float], estimator: str) -> list[float]:
    """Mean, its standard error, median, 95th percentile and inward bias of an estimator, m; NaN: not known."""
    parts = ("mean", "mean_se", "median", "p95", "inward_bias")
    return [summary.get(f"localisation_{estimator}_{part}", np.nan) for part in parts]


def _bracketed(error: float, form: str) -> str:
    """A standard error as tables show it; blank where one place does not tell it."""
    return " " * 7 if np.isnan(error) else f"({error:{form}})"


def render_table(evaluation: Evaluation, title: str) -> str:
    """The results as a table for a terminal; CV with ddof 1."""
    s = evaluation.summary()
    lines = [
        f"{title}: {s['presses']:.0f} presses, forces {evaluation.held_out}",
        "",
    ]
    lines.append("  localisation, mm        mean  (+- SE)  median     p95   inward bias")
    for name in evaluation.estimated:
        mean, error, median, p95, inward = (1e3 * value for value in localisation_errors(s, name))
        lines.append(f"    {name:<16}{mean:12.1f}  {_bracketed(error, '5.2f')} {median:7.1f} {p95:7.1f} {inward:13.1f}")
    lines += ["", *_force_lines(evaluation), *_split_lines(evaluation)]
    return "\n".join(lines + [f"  note: {note}" for note in evaluation.notes])


def _force_lines(evaluation: Evaluation) -> list[str]:
    """One row per method: evenness, and errors of the total force."""
    width = max(28, *(len(row[0]) + 1 for row in evaluation.by_method()))
    out = [f"  {'total force':<{width}}      CV    (+- SE)   RMSE, N  % of largest  mean abs., N  worst, N"]
    for label, cv, error, *errors in evaluation.by_method():
        spread = " " * 15 if np.isnan(cv) else f"{cv:6.3f}  {_bracketed(error, '.3f')}"
        shown = ["" if np.isnan(e) else f"{e:.2f}" for e in errors]
        numbers = "".join(f"{text:>{size}}" for text, size in zip(shown, (10, 14, 14, 10), strict=True))
        out.append(f"    {label:<{width}}{spread}{numbers}")
    return out + _coverage_lines(evaluation.summary())


def _coverage_lines(s: Mapping[str, float]) -> list[str]:
    """How many presses lie in their interval; none without intervals."""
    if "coverage" not in s:
        return []
    thirds = ", ".join(
        f"{name} {100 * s[f'coverage_{name}']:.0f} %" for name in FORCE_THIRDS if f"coverage_{name}" in s
    )
    return [f"    in their 90 % interval: {100 * s['coverage']:.0f} % of the presses (forces in thirds: {thirds})"]


def _split_lines(evaluation: Evaluation) -> list[str]:
    """One row per split: errors with one pad, indenter or session left out at a time."""
    if not evaluation.splits:
        return []
    out = ["", "  one left out at a time    parts  presses   RMSE, N   (90 % interval)   worst part, N"]
    for split in evaluation.splits:
        if split.note:
            out.append(f"    {split.by:<20}{split.parts:9}  {split.note}")
        else:
            ends = f"({split.low:.2f} to {split.high:.2f})"
            out.append(
                f"    {split.by:<20}{split.parts:9}{split.presses:9}{split.rmse:10.2f}   {ends:<17}{split.worst:12.2f}"
            )
    return out
