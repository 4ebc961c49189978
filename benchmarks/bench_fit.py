"""What calibrating costs: a session of 225 presses end to end, many sessions by workers, and the fits alone.

end to end: the bundled session, whose streams are slow, and one with all the frames that a bench records in 25 minutes
(scene paper_bench, simulated first), without and with a correction by location. Each stage apart, in the first call,
which compiles (or reads the cache of compiled programs), and in the second.
many: copies of the bundled session through `calib.calibrate_many`, sessions per minute for each number of workers, the
start of the workers included, and after each has done its first; results are new every time. Workers are renewed after
16 sessions each: give --sessions 100 to see a long batch.
fits: every pad's power law through all of its samples with the same robust loss, the same scale of residuals and the
same start, by `calib.fit_curves` (all pads in one compiled call) and by `scipy.optimize.least_squares`, pad by pad,
with an exact Jacobian as users write it; parameters must agree to 1e-5 before a clock is read.
"""

import shutil
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares

import calib
import jaxeit as je
from calib.batch.sessions import Outcome
from calib.bench import load_bench, simulate
from calib.fitting.curve_fit import fit_curves
from calib.presses import PressData, pool_presses
from calib.runtime import set_up

from .clock import in_turns, seconds, spread
from .harness import ROOT, Question, Row, Run

SESSION = ROOT / "data" / "sessions" / "testbed_grid.h5"
WIDTH = 1.287  # of the robust loss, in units of the residuals' scale
MAX_DIFFERENCE = 1e-5
REMARK = (
    "ours finds the scale of the residuals in four rounds and the covariance over places too; scipy is "
    "given the scale and finds no covariance"
)


def recipe_of(run: Run) -> calib.Recipe:
    coarse = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
    return coarse if run.smoke else calib.Recipe(location=calib.PadEdge())


# --- end to end


def end_to_end(run: Run) -> Iterator[Row]:
    """A row of seconds for each session, way and call."""
    with tempfile.TemporaryDirectory() as folder:
        sessions = {"bundled": SESSION}
        if not run.smoke:
            sessions["paper_bench"] = simulate(load_bench("paper_bench"), Path(folder) / "paper_bench.h5")
        for name, path in sessions.items():
            for recipe in (recipe_of(run),) if run.smoke else (calib.Recipe(), recipe_of(run)):
                for call in ("first", "second"):
                    about = {"session": name, "location": recipe.locates, "call": call}
                    yield {"end_to_end": [about | stages(path, recipe, Path(folder) / "calibration.h5")]}


def stages(path: Path, recipe: calib.Recipe, out: Path) -> dict[str, float]:
    """Seconds of each stage of one calibration, saving included."""
    began: list[tuple[str, float]] = []

    def begin(stage: str) -> None:
        began.append((stage, time.perf_counter()))

    begin("opening")
    with calib.open_session(path) as session:
        calibration = calib.calibrate([session], recipe=recipe, progress=begin)
        begin("saving")
        calibration.save(out)
        begin("")
    spent = {name: after - at for (name, at), (_, after) in pairwise(began)}
    return {name: round(s, 3) for name, s in spent.items()} | {"all": round(began[-1][1] - began[0][1], 3)}


# --- many


def many(run: Run) -> Iterator[Row]:
    sessions, several = (2, [1]) if run.smoke else (run.args.sessions, run.args.workers)
    for workers in several:
        yield {"many": [batch(sessions, workers, recipe_of(run))]}


def batch(sessions: int, workers: int, recipe: calib.Recipe) -> Row:
    """Sessions per minute, all in all and once every worker is warm, and what it comes to per session and worker."""
    ended: list[float] = []

    def tell(outcome: Outcome) -> None:
        ended.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"s{i:04d}.h5" for i in range(sessions)]
        for path in paths:
            shutil.copy(SESSION, path)
        out = Path(folder) / "out"
        spent, outcomes = seconds(lambda: calib.calibrate_many(paths, out, jobs=workers, tell=tell, recipe=recipe))
    failed = [outcome.reason for outcome in outcomes if outcome.reason]
    if failed:
        raise SystemExit(f"{len(failed)} sessions failed: {failed[0]}")
    return {
        "workers": workers,
        "sessions": sessions,
        "seconds": round(spent, 2),
        "sessions_per_minute": round(60 * sessions / spent, 2),
        "warm_sessions_per_minute": round(60 * (sessions - workers) / max(ended[-1] - ended[workers - 1], 1e-9), 2),
        "median_session_s": round(float(np.median([outcome.seconds for outcome in outcomes])), 3),
    }


# --- fits


def fits(run: Run) -> Iterator[Row]:
    """Milliseconds for all pads, in turn; compilation apart."""
    with calib.open_session(SESSION) as session:
        data = pool_presses([session], je.load_skin("testbed")).data
    first, found = seconds(_ours, data, calib.PowerLaw())
    reference = float(np.asarray(found.curve.reference)[0])
    curve = calib.PowerLaw(reference)
    found = _ours(data, curve)
    scales = np.asarray(found.scale, float)

    def theirs() -> np.ndarray:
        return np.stack([_theirs(data, pad, reference, scale) for pad, scale in enumerate(scales)])

    difference = float(np.abs(theirs() / np.asarray(found.parameters) - 1).max())
    if difference > MAX_DIFFERENCE:
        raise SystemExit(f"scipy's parameters differ by {difference:.1e}: nothing is timed")
    calls = {"calib.fit_curves": lambda: jax.block_until_ready(_ours(data, curve).parameters)}
    calls["scipy.optimize.least_squares"] = theirs
    about = {"samples": int(data.mask.sum()), "pads": len(scales), "difference": difference}
    times = {name: spread(taken) for name, taken in in_turns(calls, 3 if run.smoke else 20).items()}
    yield {"fits": about | {"first_call_s": round(first, 3), **times, "remark": REMARK}}


def _ours(data: PressData, curve: calib.PowerLaw) -> Any:
    own = data.pad_samples(with_history=curve.path)  # as `calibrate` gives them
    return fit_curves(curve, own.pressure, own.force, mask=own.mask, groups=own.place)


def _theirs(data: PressData, pad: int, reference: float, scale: float) -> np.ndarray:
    """Secant and exponent of one pad."""
    p, f = data.sample_pressure[pad, data.mask[pad]], data.sample_force[data.mask[pad]]
    loaded = p > 0
    z, log_z = np.where(loaded, p / reference, 0.0), np.log(np.where(loaded, p / reference, 1.0))
    size = np.quantile(np.abs(f), 0.75) / reference

    def force(x):
        return np.where(loaded, np.exp(x[0]) * size * reference * z ** np.exp(x[1]), 0.0)

    def residual(x):
        return (f - force(x)) / scale

    def slope(x):
        h = force(x)
        return -np.stack([h, h * log_z * np.exp(x[1])], 1) / scale

    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-9)
    found = least_squares(residual, [0.0, 0.0], jac=slope, loss="soft_l1", f_scale=WIDTH, **tolerances)
    return np.array([np.exp(found.x[0]) * size, np.exp(found.x[1])])


OPTIONS: Row = {
    "--sessions": {"type": int, "default": 24, "help": "of a batch"},
    "--workers": {"type": int, "nargs": "+", "default": [1, 2], "help": "batches of so many workers"},
}
PARTS = {"end_to_end": end_to_end, "fits": fits, "many": many}
main = Question("fit", __doc__, PARTS, OPTIONS, prepare=set_up)

if __name__ == "__main__":
    main()
