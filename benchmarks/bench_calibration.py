"""How short may a bench session be?  Presses, and forces at each of them, against the error on presses not fitted.

The pool is the bundled session testbed_grid.h5: 225 simulated presses to 20 N on a 15 x 15 grid.  Some of them are
fitted and the others predicted, over their holds and all along their presses; of all 225 each fifth of the places is
predicted from the rest.  They lie on a grid (nearest to the middles of equal cells), are scattered evenly without one
(Roberts' R2 sequence), or drawn at random.  The second session, testbed_presses.h5, is predicted too: four presses of
other forces, elsewhere.  With so many force levels, only the samples nearest to equal steps up to the hold are fitted,
as a bench that stops at these forces would record them.  Places are found with the noise of the whole session, and
through the sheet that the mean of its untouched frames shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import calib
import jaxeit as je
from calib.fitting.fields import Geometry, Places, geometry_of
from calib.fitting.held_out import folds_by_place
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads
from calib.fitting.results import FitResult
from calib.presses import PressData, pool_presses
from calib.runtime import set_up

from .figures import curves, logarithmic, panels
from .harness import ROOT, Question, Run
from .rows import Row, averaged, grouped

SESSIONS = ROOT / "data" / "sessions"
SIDES = (3, 4, 5, 6, 8, 10, 15)  # of the grid of presses
LEVELS = (1, 2, 3, 5, None)  # None: the whole press
DRAWS, FOLDS = 3, 5
SIDE = 15  # of the pool's grid
CURVES = {"linear": calib.Linear(), "affine": calib.Affine(), "power law": calib.PowerLaw()}
RECIPES = (("linear", "none"), ("linear", "pad edge"), ("power law", "pad edge"))  # curve, and location field
SMOKE = calib.Recipe(
    location=calib.fitting.Bilinear(nodes=2, shared=True),
    locator=calib.ImageCentroid("half"),
    fidelity=je.Fidelity.draft(),
    folds=2,
)
LINES = {"scattered": "-", "grid": "--", "random": ":"}


@dataclass(frozen=True, eq=False)
class Pool:
    """Presses to fit from and to predict, with the places that their images tell.

    | meaning                                                        | shape        | unit |
    |----------------------------------------------------------------|--------------|------|
    | data, geometry, places: what `fit_pads` takes                |              |      |
    | position of each press                                         | (presses, 2) | m    |
    | seconds a press takes, from one to the next                    | ()           | s    |
    | other, elsewhere: pressures and forces of the second session, and its places | |     |
    """

    data: PressData
    geometry: Geometry
    places: Places
    position: np.ndarray
    seconds: float
    other: PressData
    elsewhere: Places


@cache
def pool(smoke: bool) -> Pool:
    """Places as `calibrate` tells them."""
    with calib.open_session(SESSIONS / "testbed_grid.h5") as session:
        calibration = calib.calibrate([session], recipe=SMOKE if smoke else calib.Recipe(location=calib.PadEdge()))
        found = pool_presses([session], calibration.skin)
        seconds = float(np.median(np.diff(found.recordings[0].presses.t_press))) * 1e-9
    with calib.open_session(SESSIONS / "testbed_presses.h5") as session:
        other = pool_presses([session], calibration.skin)
    places: Any
    elsewhere: Any
    places, elsewhere = (calibration.locate(frames, single=True) for frames in (found.dv, other.dv))  # it has a field
    geometry = geometry_of(calibration.skin, places.position.dtype)
    return Pool(found.data, geometry, places, found.position, seconds, other.data, elsewhere)


# --- what is fitted


def on_grid(position: np.ndarray, side: int) -> np.ndarray:
    """(presses,) true for those nearest to the middles of side x side cells of the box of presses."""
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


def drawn(presses: int, count: int, seed: int) -> np.ndarray:
    chosen = np.zeros(presses, bool)
    chosen[np.random.default_rng(seed).choice(presses, count, replace=False)] = True
    return chosen


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
    hybrid = fit_pads(CURVES[recipe[0]], field, presses, calib.fitting.SoftL1(), use=use)
    results = [hybrid.curves.result, *([] if hybrid.field is None else [hybrid.field.result])]
    return hybrid if all((np.asarray(found) == FitResult.SUCCESS).all() for found in results) else None


# --- how well it predicts


def errors(hybrid: PadModel, data: PressData, places: Places) -> tuple[np.ndarray, np.ndarray]:
    """Of the total force, N: over the holds, (presses,), and of samples along the presses, (n,); NaN: not told."""
    held = hybrid.pad_forces(data.pressure, places)[0].sum(1) - data.force
    along = places[data.sample_press]
    return held, hybrid.pad_forces(data.sample_pressure.T, along)[0].sum(1) - data.sample_force


def judged(pool: Pool, recipe: tuple[str, str], use: np.ndarray, levels: int | None) -> dict[str, float] | None:
    """Root mean squares over presses not fitted, N; all presses: over folds of places."""
    folds = folds_by_place(pool.data.place, FOLDS)
    parts = [folds != k for k in range(FOLDS)] if use.all() else [use]
    hybrids = [fitted(pool, recipe, part, levels) for part in (*parts, use)]
    if not all(hybrids):
        return None
    held, along = [], []
    for part, hybrid in zip(parts, hybrids, strict=False):
        over_holds, over_samples = errors(hybrid, pool.data, pool.places)
        held.append(over_holds[~part])
        along.append(over_samples[~part[pool.data.sample_press]])
    other = errors(hybrids[-1], pool.other, pool.elsewhere)[0]
    return {"hold_n": _rms(held), "press_n": _rms(along), "other_session_n": _rms([other])}


def _rms(parts: Sequence[np.ndarray]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))


def row(pool: Pool, recipe: tuple[str, str], spread: str, uses: Sequence[np.ndarray], levels: int | None = None) -> Row:
    """Means over the draws that determine the fit, and their standard deviations."""
    good = [one for one in (judged(pool, recipe, use, levels) for use in uses) if one]
    count = int(uses[0].sum())
    out: Row = {"curve": recipe[0], "location": recipe[1], "spread": spread, "presses": count, "levels": levels}
    out |= {"minutes": round(count * pool.seconds / 60, 1), "draws": len(uses), "failed": len(uses) - len(good)}
    return out | (averaged(good) if good else {})


def by_presses(run: Run) -> Iterator[Row]:
    found = pool(run.smoke)
    presses = len(found.data.force)
    for recipe in run.sizes(RECIPES, RECIPES[1:2]):
        for side in run.sizes(SIDES, (5, 15)):
            uses, count = {"grid": [on_grid(found.position, side)]}, side**2
            if count < presses:
                uses["scattered"] = [scattered(found.position, count)]
                uses["random"] = [drawn(presses, count, seed) for seed in range(1 if run.smoke else DRAWS)]
            yield {"presses": [row(found, recipe, spread, some) for spread, some in uses.items()]}


def by_levels(run: Run) -> Iterator[Row]:
    yield {"levels": []}
    for curve in run.sizes(list(CURVES), ()):
        for count in (36, 100):
            uses = [scattered(pool(False).position, count)]
            rows = [row(pool(False), (curve, "pad edge"), "scattered", uses, levels) for levels in LEVELS]
            yield {"levels": rows}


# --- the picture


def picture(data: Row) -> Figure:
    """Error against presses, and against force levels."""
    figure, (left, right) = panels(10.8, 4.6, 1, 2, sharey=True)
    colours = dict(zip(RECIPES, ("C0", "C1", "C2"), strict=True))
    for (curve, location, spread), rows in grouped(data["presses"], "curve", "location", "spread").items():
        points = [(r["presses"], r["hold_n"], r.get("hold_n_sd", 0)) for r in rows if "hold_n" in r]
        first = spread == "scattered"
        look: Row = {"marker": "o", "label": f"{curve}, place: {location}"} if first else {"marker": "."}
        look |= {"color": colours[curve, location], "linestyle": LINES[spread]}
        left.errorbar(*zip(*points, strict=True), **look)
    rows = [r | {"step": LEVELS.index(r["levels"])} for r in data["levels"]]
    curves(right, rows, "step", "press_n", ("curve", "presses"), _look)
    labels: Any = {"xlabel": "presses fitted", "ylabel": "RMS error of held-out forces, N"}
    logarithmic(left, "over the holds; scattered (lines), grid (dashed), random (dotted, ± sd)", **labels)
    left.set_xticks([s**2 for s in SIDES], labels=[str(s**2) for s in SIDES])
    left.set_xticks([], minor=True)
    right.set_xticks(range(len(LEVELS)), labels=["whole press" if n is None else str(n) for n in LEVELS])
    right.set(xlabel="force levels")
    right.set_title("all along the press; place: pad edge", fontsize=10)
    right.grid(True, which="both", color="#e4e4e4", linewidth=0.7)
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False)
    return figure


def _look(curve: str, count: int) -> Row:
    line, colour = "-" if count == 100 else "--", f"C{list(CURVES).index(curve)}"
    return {"color": colour, "linestyle": line, "label": f"{curve}, {count} presses"}


PARTS = {"presses": by_presses, "levels": by_levels}
main = Question("calibration_cost", __doc__, PARTS, picture=picture, file="calibration-cost.png", prepare=set_up)

if __name__ == "__main__":
    main()
