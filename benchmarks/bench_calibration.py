"""How short may a bench session be?  Presses, and forces at each of them, against the error on presses not fitted.

The pool is the bundled session testbed_grid.h5: 225 simulated presses to 20 N on a 15 x 15 grid.  Some of them are
fitted and the others predicted, over their holds and all along their presses; of all 225 each fifth of the places is
predicted from the rest.  They lie on a grid (nearest to the middles of equal cells) or are scattered evenly without one
(Roberts' R2 sequence).  With so many force levels, only the samples nearest to equal steps up to the hold are fitted,
as a bench that stops at these forces would record them.  Places are found with the noise of the whole session, and
through the sheet that the mean of its untouched frames shows.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

import calib
import jaxeit as je
from calib.fitting import Geometry, Places, geometry_of
from calib.fitting.cross_validation.held_out import folds_by_place
from calib.fitting.cross_validation.scores import rmse
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads
from calib.fitting.results import FitResult
from calib.presses import PressData, pool_presses
from calib.runtime import set_up

from .figures import curves, logarithmic, panels
from .harness import ROOT, Question, Run
from .rows import Row

SESSION = ROOT / "data" / "sessions" / "testbed_grid.h5"
SIDES = (3, 4, 5, 6, 8, 10, 15)  # of the grid of presses
SIDE = SIDES[-1]  # of the pool's grid
LEVELS = (1, 2, 3, 5, None)  # None: the whole press
FOLDS = 5
CURVES = {"linear": calib.Linear(), "affine": calib.Affine(), "power law": calib.PowerLaw()}
RECIPES = (("linear", "none"), ("linear", "pad edge"), ("power law", "pad edge"))  # curve, and location field
SMOKE = calib.Recipe(
    location=calib.fitting.Bilinear(nodes=2, shared=True),
    locator=calib.calibration.ImageCentroid(),
    fidelity=je.Fidelity.draft(),
    folds=2,
)


class Pool(NamedTuple):
    """Presses to fit from and to predict: what `fit_pads` takes, with the places that their images tell; the position
    of each press (presses, 2) m; and the seconds that a press takes, from one to the next."""

    data: PressData
    geometry: Geometry
    places: Places
    position: np.ndarray
    seconds: float


@cache
def pool(smoke: bool) -> Pool:
    """Places as `calibrate` tells them."""
    with calib.open_session(SESSION) as session:
        calibration = calib.calibrate([session], recipe=SMOKE if smoke else calib.Recipe(location=calib.PadEdge()))
        found = pool_presses([session], calibration.skin)
    seconds = float(np.median(np.diff(found.recordings[0].presses.t_press))) * 1e-9
    places: Any = calibration.locate(found.dv, single=True)  # it has a field
    geometry = geometry_of(calibration.skin, places.position.dtype)
    return Pool(found.data, geometry, places, found.position, seconds)


# --- what is fitted


def on_grid(position: np.ndarray, count: int) -> np.ndarray:
    """(presses,) true for those nearest to the middles of ``count`` equal cells of the box of presses."""
    side = round(count**0.5)
    low, high = position.min(0), position.max(0)
    pitch = (high - low) / (SIDE - 1)
    cell = (high - low + pitch) / side
    middles = (np.arange(side)[:, None] + 0.5) * cell + low - pitch / 2
    wanted = np.stack(np.meshgrid(*middles.T), -1).reshape(-1, 1, 2)
    chosen = np.zeros(len(position), bool)
    chosen[np.linalg.norm(wanted - position, axis=-1).argmin(1)] = True
    return chosen


def scattered(position: np.ndarray, count: int) -> np.ndarray:
    """(presses,) true for ``count`` of them, each the nearest left to the next point of the sequence; what lies half a
    spacing from the rim or less goes there."""
    low, high = position.min(0), position.max(0)
    step = 1 / 1.32471795724474602596 ** np.arange(1, 3)  # of the plastic number
    chosen = np.zeros(len(position), bool)
    for k in range(count):
        part = np.clip(0.5 + (1 + count**-0.5) * ((0.5 + k * step) % 1 - 0.5), 0, 1)
        away = np.linalg.norm(position - (low + (high - low) * part), axis=1)
        chosen[np.where(chosen, np.inf, away).argmin()] = True
    return chosen


SPREADS = {"grid": on_grid, "scattered": scattered}


def at_levels(data: PressData, levels: int | None) -> PressData:
    """The data with only those samples to fit that are nearest to ``levels`` equal steps on the way to the hold."""
    if levels is None:
        return data
    kept = np.zeros(len(data.sample_force), bool)
    for press in np.unique(data.sample_press):
        mine = np.flatnonzero((data.sample_press == press) & np.isfinite(data.sample_force))
        force = data.sample_force[mine]
        if len(mine):
            up = mine[: 1 + np.flatnonzero(force >= 0.98 * force.max())[-1]]
            steps = force.max() * (1 + np.arange(levels)) / levels
            kept[up[np.abs(data.sample_force[up] - steps[:, None]).argmin(1)]] = True
    return replace(data, mask=data.mask & kept)


def fitted(pool: Pool, recipe: tuple[str, str], use: np.ndarray, levels: int | None) -> PadModel | None:
    """None where the presses do not determine it."""
    field, places = (None, None) if recipe[1] == "none" else (calib.PadEdge(), pool.places)
    pressed = pool.position[use]
    data = replace(at_levels(pool.data, levels), reach=np.stack([pressed.min(0), pressed.max(0)]))
    presses = LocatedPresses(data, pool.geometry, places)
    model = fit_pads(CURVES[recipe[0]], field, presses, calib.fitting.SoftL1(), use=use)
    results = [model.curves.result, *([] if model.field is None else [model.field.result])]
    return model if all((np.asarray(found) == FitResult.SUCCESS).all() for found in results) else None


# --- how well it predicts


def judged(pool: Pool, recipe: tuple[str, str], use: np.ndarray, levels: int | None) -> Row:
    """Root mean squares of the error of the total force over presses not fitted, N, over the holds and along the
    presses; all presses: over folds of places.  Nothing where a fit is not determined."""
    folds = folds_by_place(pool.data.place, FOLDS)
    parts = [folds != k for k in range(FOLDS)] if use.all() else [use]
    models = [fitted(pool, recipe, part, levels) for part in parts]
    if not all(models):
        return {}
    data, own = pool.data, pool.data.sample_press
    errors = np.full(len(data.force), np.nan), np.full(len(own), np.nan)
    for part, model in zip(parts, models, strict=True):
        held = model.pad_forces(data.pressure, pool.places)[0].sum(1) - data.force
        along = model.pad_forces(data.sample_pressure.T, pool.places[own])[0].sum(1) - data.sample_force
        errors[0][~part], errors[1][~part[own]] = held[~part], along[~part[own]]
    return {name: rmse(e, np.zeros_like(e)) for name, e in zip(("hold_n", "press_n"), errors, strict=True)}


def row(pool: Pool, recipe: tuple[str, str], spread: str, count: int, levels: int | None = None) -> Row:
    out: Row = {"curve": recipe[0], "location": recipe[1], "spread": spread, "presses": count, "levels": levels}
    out["minutes"] = round(count * pool.seconds / 60, 1)
    return out | judged(pool, recipe, SPREADS[spread](pool.position, count), levels)


def by_presses(run: Run) -> Iterator[Row]:
    for recipe in run.sizes(RECIPES, RECIPES[1:2]):
        for side in run.sizes(SIDES, (5, SIDE)):
            spreads = SPREADS if side < SIDE else ("grid",)
            yield {"presses": [row(pool(run.smoke), recipe, spread, side**2) for spread in spreads]}


def by_levels(run: Run) -> Iterator[Row]:
    yield {"levels": []}
    for curve in run.sizes(list(CURVES), ()):
        for count in (36, 100):
            yield {"levels": [row(pool(False), (curve, "pad edge"), "scattered", count, n) for n in LEVELS]}


# --- the picture


def picture(data: Row) -> Figure:
    """Error against presses, and against force levels."""
    figure, (left, right) = panels(10.8, 4.6, 1, 2, sharey=True)
    for spread in SPREADS:
        rows = [row for row in data["presses"] if row["spread"] == spread]
        curves(left, rows, "presses", "hold_n", ("curve", "location", "spread"), _by_recipe)
    rows = [r | {"step": LEVELS.index(r["levels"])} for r in data["levels"]]
    curves(right, rows, "step", "press_n", ("curve", "presses"), _by_curve)
    labels: Any = {"xlabel": "presses fitted", "ylabel": "RMS error of held-out forces, N"}
    logarithmic(left, "over the holds; scattered (lines), grid (dashed)", **labels)
    left.set_xticks([s**2 for s in SIDES], labels=[str(s**2) for s in SIDES])
    left.set_xticks([], minor=True)
    right.set_xticks(range(len(LEVELS)), labels=["whole press" if n is None else str(n) for n in LEVELS])
    right.set(xlabel="force levels")
    right.set_title("all along the press; place: pad edge", fontsize=10)
    right.grid(True, which="both", color="#e4e4e4", linewidth=0.7)
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False)
    return figure


def _by_recipe(curve: str, location: str, spread: str) -> Row:
    look: Row = {"color": f"C{RECIPES.index((curve, location))}"}
    if spread == "grid":
        return look | {"marker": ".", "linestyle": "--"}
    return look | {"label": f"{curve}, place: {location}"}


def _by_curve(curve: str, count: int) -> Row:
    line, colour = "-" if count == 100 else "--", f"C{list(CURVES).index(curve)}"
    return {"color": colour, "linestyle": line, "label": f"{curve}, {count} presses"}


PARTS = {"presses": by_presses, "levels": by_levels}
main = Question("calibration_cost", __doc__, PARTS, picture=picture, file="calibration-cost.png", prepare=set_up)

if __name__ == "__main__":
    main()
