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
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares

import calib
import jaxeit as je
from calib.bench import load_bench, simulate
from calib.fitting.curves import fit_curves
from calib.presses import PressData, pool_presses
from calib.runtime import set_up

from .clock import in_turns, require_agreement, seconds, spread
from .harness import ROOT, Question, Run
from .rows import Row

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
    began = [("opening", time.perf_counter())]
    with calib.open_session(path) as session:
        calibration = calib.calibrate(
            [session], recipe=recipe, progress=lambda stage: began.append((stage, time.perf_counter()))
        )
        began.append(("saving", time.perf_counter()))
        calibration.save(out)
    began.append(("", time.perf_counter()))
    spent = {name: round(after - at, 3) for (name, at), (_, after) in pairwise(began)}
    return spent | {"all": round(began[-1][1] - began[0][1], 3)}


# --- many


def many(run: Run) -> Iterator[Row]:
    sessions = 2 if run.smoke else run.args.sessions
    for workers in run.sizes(run.args.workers, (1,)):
        yield {"many": [batch(sessions, workers, recipe_of(run))]}


def batch(sessions: int, workers: int, recipe: calib.Recipe) -> Row:
    """Sessions per minute, all in all and once every worker is warm, and what it comes to per session and worker."""
    ended: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"s{i:04d}.h5" for i in range(sessions)]
        for path in paths:
            shutil.copy(SESSION, path)
        how = {"jobs": workers, "recipe": recipe, "tell": lambda outcome: ended.append(time.perf_counter())}
        spent, outcomes = seconds(lambda: calib.calibrate_many(paths, Path(folder) / "out", **how))
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
    ours = partial(_ours, data, calib.PowerLaw(reference))
    found = ours()
    scales = np.asarray(found.scale, float)

    def theirs() -> np.ndarray:
        return np.stack([_theirs(data, pad, reference, scale) for pad, scale in enumerate(scales)])

    outputs = {"scipy.optimize.least_squares": theirs() / np.asarray(found.parameters), "calib.fit_curves": np.ones(2)}
    difference = require_agreement(outputs, "calib.fit_curves", {"scipy.optimize.least_squares": MAX_DIFFERENCE})
    calls = {"calib.fit_curves": lambda: jax.block_until_ready(ours().parameters), next(iter(difference)): theirs}
    about = {"samples": int(data.mask.sum()), "pads": len(scales), "difference": next(iter(difference.values()))}
    times = {name: spread(taken) for name, taken in in_turns(calls, 3 if run.smoke else 20).items()}
    yield {"fits": about | {"first_call_s": round(first, 3), **times, "remark": REMARK}}


def _ours(data: PressData, curve: calib.PowerLaw) -> Any:
    own = data.pad_samples(with_history=curve.path)  # as `calibrate` gives them
    return fit_curves(curve, own.pressure, own.force, mask=own.mask, groups=own.place)


def _theirs(data: PressData, pad: int, reference: float, scale: float) -> np.ndarray:
    """Secant and exponent of one pad, as exponents of e in the fit."""
    p, f = data.sample_pressure[pad, data.mask[pad]], data.sample_force[data.mask[pad]]
    loaded = p > 0
    z, log_z = np.where(loaded, p / reference, 0.0), np.log(np.where(loaded, p / reference, 1.0))
    size = np.quantile(np.abs(f), 0.75) / reference

    def force(x):
        return np.where(loaded, np.exp(x[0]) * size * reference * z ** np.exp(x[1]), 0.0)

    def slope(x):
        h = force(x)
        return -np.stack([h, h * log_z * np.exp(x[1])], 1) / scale

    how = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-9) | {"loss": "soft_l1", "f_scale": WIDTH}
    found = least_squares(lambda x: (f - force(x)) / scale, [0.0, 0.0], jac=slope, **how)
    return np.array([np.exp(found.x[0]) * size, np.exp(found.x[1])])


OPTIONS: Row = {
    "--sessions": {"type": int, "default": 24, "help": "of a batch"},
    "--workers": {"type": int, "nargs": "+", "default": [1, 2], "help": "batches of so many workers"},
}
PARTS = {"end_to_end": end_to_end, "fits": fits, "many": many}
main = Question("fit", __doc__, PARTS, OPTIONS, prepare=set_up)

if __name__ == "__main__":
    main()
