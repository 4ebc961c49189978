"""Forces predicted by fits that did not use the press: one place, pad, indenter or session is left out at a time.

Cross-validation over places gives the error of presses between known places. The other splits give the error of
extrapolation: to a pad that was never pressed, another tip, another day. Intervals come from a bootstrap over places:
all presses of a place are drawn together, because they share the error of the place.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .curves.base import AbstractCurve
from .curves.fit import fit_curves
from .fields.base import AbstractField
from .fields.fitted import FittedField
from .losses import AbstractLoss
from .pads import Hybrid, LocatedPresses, fit_hybrid
from .results import FitResult
from .validation import assign_folds

DRAWS = 2000  # draws of the bootstrap; the ends of an interval then vary by about 2 % of its length
COVERAGE = 0.9  # probability that an interval covers the true value


class Split(NamedTuple):
    """Errors of the total force over the holds, each part predicted by a fit to the others.

    | meaning                                                             | unit |
    |---------------------------------------------------------------------|------|
    | by: kind of part left out, in the singular, such as "pad"           |      |
    | parts: number of parts                                              |      |
    | presses: number of presses that were predicted                      |      |
    | rmse: root mean square error of all presses                         | N    |
    | low, high: ends of the 90 % interval of rmse over places            | N    |
    | worst: root mean square error of the worst part                     | N    |
    | note: why there are no errors; empty if there are                   |      |
    """

    by: str
    parts: int
    presses: int = 0
    rmse: float = float("nan")
    low: float = float("nan")
    high: float = float("nan")
    worst: float = float("nan")
    note: str = ""


def place_draws(place: np.ndarray) -> np.ndarray:
    """How often each press is drawn, (draws, presses), when places are drawn with replacement. Fixed seed."""
    _, first, index = np.unique(place, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[index.ravel()]  # of each place, in the order of appearance
    count = len(first)
    drawn = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    return np.stack([np.bincount(draw, minlength=count) for draw in drawn])[:, number]


def interval(draws: np.ndarray) -> tuple[float, float]:
    """Ends of the 90 % interval of the draws of a statistic."""
    low, high = np.quantile(draws, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return float(low), float(high)


def folds_by_place(place: np.ndarray, folds: int) -> np.ndarray:
    """Fold of each press, (presses,); all presses at one place have the same fold."""
    return assign_folds(place, min(folds, len(np.unique(place))))


def hold_out(
    curve: AbstractCurve, field: AbstractField | None, presses: LocatedPresses, loss: AbstractLoss, fold: np.ndarray
) -> np.ndarray:
    """Pad forces over the hold of every press, (presses, pads) N, by fits without the press's fold (presses,)."""
    pressure = presses.data.pressure
    out = np.full(pressure.shape, np.nan)
    for k in np.unique(fold):
        held = fold == k
        hybrid = fit_hybrid(curve, field, presses, loss, use=~held)
        force, _, _ = hybrid.pad_forces(pressure, presses.places)
        good = np.asarray(hybrid.curves.result) == FitResult.SUCCESS
        out[held] = np.where(good, force, np.nan)[held]
    return out


def hold_out_image(image_sum: np.ndarray, force: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Total force by the image alone, (presses,) N: integral (presses,) S m^2 times a gain fitted without the fold."""
    out = np.empty(len(image_sum))
    for k in np.unique(fold):
        held = fold == k
        gain = force[~held].sum() / image_sum[~held].sum() if (~held).any() else np.nan
        out[held] = gain * image_sum[held]
    return out


def leave_out(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    groups: Mapping[str, np.ndarray],
) -> tuple[Split, ...]:
    """A `Split` for every grouping of the presses.

    Args:
        groups: number of each press's part, (presses,), for each kind of part; -1: in none, and never left out.
            A left-out "pad" is predicted by one curve of all other pads, and by the field that it shares with them.
    """
    return tuple(
        _split(by, part, presses, partial(_by_other_pads if by == "pad" else fit_hybrid, curve, field, presses, loss))
        for by, part in groups.items()
    )


def _split(by: str, part: np.ndarray, presses: LocatedPresses, fit: Callable[..., Hybrid]) -> Split:
    data, parts = presses.data, np.unique(part[part >= 0])
    if len(parts) < 2:
        return Split(by, len(parts), note=f"the presses are of one {by} only: record presses of another too")
    error = np.full(len(data.force), np.nan)
    for k in parts:
        held = part == k
        force, _, _ = fit(use=~held).pad_forces(data.pressure, presses.places)
        error[held] = (force.sum(1) - data.force)[held]
    if not np.isfinite(error[part >= 0]).all():
        return Split(by, len(parts), note=f"without one {by} the rest does not determine the fit: record more presses")
    return _errors(by, error, part, data.place)


def _errors(by: str, error: np.ndarray, part: np.ndarray, place: np.ndarray) -> Split:
    seen = part >= 0
    square, part = error[seen] ** 2, part[seen]
    weight = place_draws(place[seen])
    draws = np.sqrt(weight @ square / weight.sum(1))
    worst = max(np.sqrt(square[part == k].mean()) for k in np.unique(part))
    return Split(by, len(np.unique(part)), len(square), float(np.sqrt(square.mean())), *interval(draws), float(worst))


def _by_other_pads(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    *,
    use: np.ndarray,
) -> Hybrid:
    """As `fit_hybrid`; a pad without presses in `use` gets one curve fitted to the samples of all other pads."""
    found = fit_hybrid(curve, field, presses, loss, use=use)
    data, places = presses.data, presses.places
    mine = data.mask & use[data.sample_press]
    gain = 0.0 if found.field is None or places is None else found.log_gains(places)[data.sample_press].T
    together = fit_curves(
        curve,
        np.where(mine, data.sample_pressure, 0).sum(0)[None],
        data.sample_force * np.exp(-np.where(mine, gain, 0).sum(0)),
        mask=mine.any(0),
        groups=data.sample_place,
        loss=loss,
    )
    empty = np.flatnonzero(~mine.any(1))
    if not len(empty) or int(together.result[0]) != FitResult.SUCCESS:
        return found
    curves = jax.tree.map(lambda pads, one: pads.at[empty].set(one[0]), found.curves, together)
    return replace(found, curves=curves, field=_levelled(found.field, empty))


def _levelled(field: FittedField | None, empty: np.ndarray) -> FittedField | None:
    """The field, with the mean features of the other pads taken for the `empty` pads, which have no presses."""
    if field is None:
        return None
    centre = field.centre.at[empty].set(jnp.mean(jnp.delete(field.centre, empty, axis=0), 0))
    found: FittedField | None = eqx.tree_at(lambda f: f.centre, field, centre)
    return found
