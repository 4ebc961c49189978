"""Choice among candidates by their error on held-out samples, with the reason in words."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .curves import CURVES, AbstractCurve
from .fields import FIELDS, AbstractField
from .losses import AbstractLoss
from .pads import LocatedPresses, fit_hybrid, sample_forces


class Candidate(NamedTuple):
    """A candidate and its error at held-out places (of a log: in held-out stretches of time).

    | meaning                                                                        | unit |
    |--------------------------------------------------------------------------------|------|
    | part: "curve", "location" or "channels"                                        |      |
    | name                                                                           |      |
    | size: number of coefficients (for a curve, of one pad)                         |      |
    | rmse: root mean square over places of the held-out error; None: not determined | N    |
    | low, high: roots of the mean square minus and plus its standard error          | N    |
    | chosen: whether it was chosen                                                  |      |
    """

    part: str
    name: str
    size: int
    rmse: float | None
    low: float | None
    high: float | None
    chosen: bool


class Tried(NamedTuple):
    """A candidate with its name and number of coefficients."""

    choice: Any
    name: str
    size: int


def simplest(
    part: str, tried: Sequence[Tried], score: Callable[[Any], np.ndarray], over: str
) -> tuple[Any, str, tuple[Candidate, ...]]:
    """The smallest candidate whose mean square error is at most the least one plus its standard error.

    This is the one-standard-error rule (Breiman et al. 1984, 3.4.3).

    Args:
        part: "curve", "location" or "channels"; see `Candidate`.
        tried: the candidates; a single one is not scored.
        score: mean square errors of a `choice`, (n,) N^2 over places; a value that is not finite: not determined.
        over: what n counts, in words.

    Returns: the choice, the reason in words, and all candidates (none if there was only one).
    """
    if len(tried) == 1:
        return tried[0].choice, "", ()
    tried = sorted(tried, key=lambda one: one.size)
    errors = [score(one.choice) for one in tried]
    means = np.array([np.mean(e) if np.isfinite(e).all() else np.inf for e in errors])
    spread = np.array([np.std(e, ddof=1) / np.sqrt(len(e)) for e in errors])
    least = int(np.argmin(means))
    limit = means[least] + spread[least]
    chosen = int(np.argmax(means <= limit))
    table = tuple(
        Candidate(part, one.name, one.size, *_roots(mean, error), chosen=k == chosen)
        for k, (one, mean, error) in enumerate(zip(tried, means, spread, strict=True))
    )
    said = ", ".join(f"{c.name} {'not determined' if c.rmse is None else f'{c.rmse:.2f}'}" for c in table)
    why = f"{tried[chosen].name}, the simplest within one standard error ({np.sqrt(limit):.2f} N) of the best"
    return tried[chosen].choice, f"{why}; held-out RMSE over {over} in N: {said}", table


def _roots(mean: float, error: float) -> tuple[float | None, float | None, float | None]:
    """Roots (N) of a mean square (N^2), and of it minus and plus its standard error."""
    if not np.isfinite(mean):
        return None, None, None
    return float(np.sqrt(mean)), float(np.sqrt(max(mean - error, 0))), float(np.sqrt(mean + error))


class Choice(NamedTuple):
    """The chosen curve and field, the reason in words, and all candidates (none if there was only one)."""

    curve: AbstractCurve
    field: AbstractField | None
    why: str
    tried: tuple[Candidate, ...] = ()

    @property
    def title(self) -> str:
        """The names of curve and field, for a table."""
        return ", ".join(
            [CURVES.name_of(self.curve)] + ([FIELDS.name_of(self.field)] if self.field is not None else [])
        )


def choose(
    curves: Sequence[AbstractCurve],
    fields: Sequence[AbstractField | None],
    presses: LocatedPresses,
    loss: AbstractLoss,
    fold: np.ndarray,
) -> Choice:
    """The simplest field, then the simplest curve, whose held-out error is within one standard error of the least.

    The error is the mean over places of the mean square over the samples of the presses, so that all loads of a ramp
    count; fits do not use the place (see `simplest`). The simplest has the fewest coefficients. The field is chosen
    with the first curve, then the curve with that field.
    """
    pads = presses.geometry.pads
    by_field = [Tried(f, "none" if f is None else FIELDS.name_of(f), 0 if f is None else f.size(pads)) for f in fields]
    field, why, first = simplest(
        "location", by_field, lambda f: place_errors(curves[0], f, presses, loss, fold), "places"
    )
    by_curve = [Tried(c, CURVES.name_of(c), c.size) for c in curves]
    curve, more, second = simplest("curve", by_curve, lambda c: place_errors(c, field, presses, loss, fold), "places")
    return Choice(curve, field, "; ".join(filter(None, [why, more])), first + second)


def place_errors(
    curve: AbstractCurve, field: AbstractField | None, presses: LocatedPresses, loss: AbstractLoss, fold: np.ndarray
) -> np.ndarray:
    """Mean square error of the total force at each place, (places,) N^2, by fits without the fold of the place."""
    data = presses.data
    total = np.full(data.sample_force.shape, np.nan)
    for k in np.unique(fold):
        hybrid = fit_hybrid(curve, field, presses, loss, use=fold != k)
        held = fold[data.sample_press] == k
        total[held] = sample_forces(hybrid, presses).sum(0)[held]
    square = (total - data.sample_force) ** 2
    square = np.where(np.isfinite(data.sample_force) & np.isfinite(data.sample_pressure).all(0), square, 0)
    count = np.bincount(data.sample_place, minlength=data.place.max() + 1)
    return np.bincount(data.sample_place, square, len(count)) / np.maximum(count, 1)
