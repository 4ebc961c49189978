"""Forces predicted by fits that never saw the press: a place, a pad, an indenter or a session left out at a time.

Cross-validation over places says how well presses between known ones are told.  These say what happens beyond: at a
place far from all others, on a pad that was never pressed, under another tip, on another day.  Intervals are of a
bootstrap over places: all presses of a place are drawn together, as they share what is peculiar to it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .curve_fit import fit_curves
from .curves import AbstractCurve
from .fields import AbstractField, FittedField
from .losses import AbstractLoss
from .pads import Hybrid, LocatedPresses, fit_hybrid
from .results import FitResult
from .validation import assign_folds

DRAWS = 2000  # of the bootstrap: the ends of an interval are then known to about 2 % of its length
COVERAGE = 0.9  # of the intervals


class Split(NamedTuple):
    """Errors of the total force over the holds, each part predicted from the others.

    | meaning                                                             | unit |
    |---------------------------------------------------------------------|------|
    | by: what was left out, in the singular, as "pad"                    |      |
    | parts: how many there are                                           |      |
    | presses that were predicted                                         |      |
    | rmse, and the ends of its 90 % interval over places                 | N    |
    | worst: root mean square error of the worst part                     | N    |
    | note: why there is nothing to tell; empty where there is            |      |
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
    """(draws, presses) how often each press is drawn when places are, with replacement; the same every time."""
    _, first, index = np.unique(place, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[index.ravel()]  # in the order of appearance
    count = len(first)
    drawn = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    return np.stack([np.bincount(draw, minlength=count) for draw in drawn])[:, number]


def interval(draws: np.ndarray) -> tuple[float, float]:
    """Ends of the 90 % interval of a statistic's draws."""
    low, high = np.quantile(draws, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return float(low), float(high)


def folds_by_place(place: np.ndarray, folds: int) -> np.ndarray:
    """(presses,) fold of each press; presses at one place stay together."""
    return assign_folds(place, min(folds, len(np.unique(place))))


def hold_out(
    curve: AbstractCurve, field: AbstractField | None, presses: LocatedPresses, loss: AbstractLoss, fold: np.ndarray
) -> np.ndarray:
    """Pad forces over the hold of every press, (presses, pads) N, by fits that never saw its fold (presses,)."""
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
    """Total force by the image alone, (presses,) N: its integral (presses,) S m^2 times one number, found likewise."""
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
        groups: number of each press's part, (presses,), by what the parts are; -1: in none, and always fitted from.
            "pad" predicts a pad by the curve of all others together, and by what its field shares with theirs.
    """
    return tuple(
        _split(by, part, presses, partial(_by_other_pads if by == "pad" else fit_hybrid, curve, field, presses, loss))
        for by, part in groups.items()
    )


def _split(by: str, part: np.ndarray, presses: LocatedPresses, fit: Callable[..., Hybrid]) -> Split:
    data, parts = presses.data, np.unique(part[part >= 0])
    if len(parts) < 2:
        return Split(by, len(parts), note=f"the presses are of one {by} only: what another would do is not known")
    error = np.full(len(data.force), np.nan)
    for k in parts:
        held = part == k
        force, _, _ = fit(use=~held).pad_forces(data.pressure, presses.places)
        error[held] = (force.sum(1) - data.force)[held]
    if not np.isfinite(error[part >= 0]).all():
        return Split(by, len(parts), note=f"without one {by} the rest does not determine the fit: record more presses")
    return _judged(by, error, part, data.place)


def _judged(by: str, error: np.ndarray, part: np.ndarray, place: np.ndarray) -> Split:
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
    """As `fit_hybrid`; a pad that no press used rests on gets the curve of all other pads' samples together."""
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
    """A field whose mean on the `empty` pads is taken to be over such places as were pressed on the others."""
    if field is None:
        return None
    centre = field.centre.at[empty].set(jnp.mean(jnp.delete(field.centre, empty, axis=0), 0))
    found: FittedField | None = eqx.tree_at(lambda f: f.centre, field, centre)
    return found
