"""Choice among candidates by their error on held-out samples, with the reason in words.

Candidates are compared in pairs over the same places, because the difference of two errors at one place varies far
less than the errors do from place to place. Of the candidates that are not worse than the best by more than the
standard error of the paired difference, the one with the fewest effective coefficients is chosen (the
one-standard-error rule, Breiman et al. 1984, 3.4.3, on paired differences).
"""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ..curves import CURVES, AbstractCurve
from ..fields import FIELDS, AbstractField
from ..pads import PadModel
from .held_out import Folds

MAX_LISTED = 12  # candidates in the reason in words; the table of the report has all
NO_FOLDS: frozenset[int] = frozenset()


class Candidate(NamedTuple):
    """A candidate and its error at held-out places (of a log: in held-out stretches of time).

    | meaning                                                                           | unit |
    |-----------------------------------------------------------------------------------|------|
    | part: what was chosen, such as "curve", "location" or "channels"                  |      |
    | name                                                                              |      |
    | size: number of effective coefficients                                            |      |
    | rmse: root mean square over places of the held-out error; None: not determined    | N    |
    | low, high: the same for the mean square minus and plus the standard error of its  | N    |
    |            difference from the best, over places                                  |      |
    | chosen: whether it was chosen                                                     |      |
    """

    part: str
    name: str
    size: float
    rmse: float | None
    low: float | None
    high: float | None
    chosen: bool


class Option(NamedTuple):
    """A candidate with its name and number of effective coefficients."""

    choice: Any
    name: str
    size: float


def simplest(
    part: str, options: Sequence[Option], score: Callable[[Any], np.ndarray], over: str
) -> tuple[Any, str, tuple[Candidate, ...]]:
    """The smallest candidate that is not worse than the best by more than the standard error of their difference.

    Args:
        part: what is chosen; see `Candidate`.
        options: the candidates; a single one is not scored.
        score: mean square errors of a `choice`, (n,) N^2 over places; a value that is not finite: not determined.
        over: what n counts, in words.

    Returns: the choice, the reason in words, and all candidates (none if there was only one).
    """
    if len(options) == 1:
        return options[0].choice, "", ()
    options = sorted(options, key=lambda option: option.size)
    errors = [score(option.choice) for option in options]
    means = np.array([np.mean(e) if np.isfinite(e).all() else np.inf for e in errors])
    least = int(np.argmin(means))
    spread = np.array([_standard_error(e - errors[least]) for e in errors])
    chosen = int(np.argmax(means <= means[least] + np.nan_to_num(spread)))
    table = tuple(
        Candidate(part, option.name, round(option.size, 1), *_root_mean_squares(mean, error), chosen=k == chosen)
        for k, (option, mean, error) in enumerate(zip(options, means, spread, strict=True))
    )
    why = f"{options[chosen].name}, the simplest within one standard error of the paired difference from the best"
    return (
        options[chosen].choice,
        f"{why} ({options[least].name}); held-out RMSE over {over} in N: {_listed(table)}",
        table,
    )


def _listed(table: Sequence[Candidate]) -> str:
    """All candidates with their errors; of many the best few, and all that were refused because a fit failed."""
    limit = sorted(np.inf if c.rmse is None else c.rmse for c in table)[min(MAX_LISTED, len(table)) - 1]
    listed = [c for c in table if c.rmse is None or c.rmse <= limit]
    words = ", ".join(f"{c.name} {'not determined' if c.rmse is None else f'{c.rmse:.2f}'}" for c in listed)
    return words + (f" and {len(table) - len(listed)} more" if len(listed) < len(table) else "")


def _standard_error(difference: np.ndarray) -> float:
    if len(difference) < 2 or not np.isfinite(difference).all():
        return 0.0
    return float(np.std(difference, ddof=1) / np.sqrt(len(difference)))


def _root_mean_squares(mean: float, error: float) -> tuple[float | None, float | None, float | None]:
    """Roots (N) of a mean square (N^2), and of it minus and plus its standard error."""
    if not np.isfinite(mean):
        return None, None, None
    return float(np.sqrt(mean)), float(np.sqrt(max(mean - error, 0))), float(np.sqrt(mean + error))


class ModelChoice(NamedTuple):
    """The chosen curve and field, the reason in words, and all candidates (none if there was only one)."""

    curve: AbstractCurve
    field: AbstractField | None
    why: str
    tried: tuple[Candidate, ...] = ()

    @property
    def title(self) -> str:
        """The names of curve and field, for a table."""
        return _title(self.curve, self.field)


def _title(curve: AbstractCurve, field: AbstractField | None) -> str:
    return ", ".join([CURVES.name_of(curve)] + ([FIELDS.name_of(field)] if field is not None else []))


def _name(curve: AbstractCurve, field: AbstractField | None, parts: Sequence[str]) -> str:
    """The names of those parts that are chosen."""
    names = {"curve": CURVES.name_of(curve), "location": "none" if field is None else FIELDS.name_of(field)}
    return ", ".join(names[part] for part in parts)


def choose(
    curves: Sequence[AbstractCurve],
    fields: Sequence[AbstractField | None],
    folds: Folds,
    without: frozenset[int] = NO_FOLDS,
) -> ModelChoice:
    """The simplest pair of curve and field whose held-out error is not worse than the least; see `simplest`.

    The error is the mean over places of the mean square over the samples of the presses, so that all loads of a ramp
    count; fits do not use the place.

    Args:
        without: folds of which nothing is used, neither for fits nor for errors.
    """
    pairs = list(product(curves, fields))
    if len(pairs) == 1:
        return ModelChoice(*pairs[0], "")
    parts = [part for part, choices in (("curve", curves), ("location", fields)) if len(choices) > 1]
    options = [Option(pair, _name(*pair, parts), folds.fit(*pair, without).coefficients) for pair in pairs]
    (curve, field), why, table = simplest(
        " and ".join(parts), options, lambda pair: folds.place_errors(pair[0], pair[1], without), "places"
    )
    return ModelChoice(curve, field, why, table)


def nested_selection(
    curves: Sequence[AbstractCurve], fields: Sequence[AbstractField | None], folds: Folds
) -> dict[int, PadModel]:
    """The fit without each fold, by its number; curve and field are chosen without the fold as well (nested)."""
    models = {}
    for k in folds.indices:
        choice = choose(curves, fields, folds, frozenset({k}))
        models[k] = folds.fit(choice.curve, choice.field, frozenset({k}))
    return models
