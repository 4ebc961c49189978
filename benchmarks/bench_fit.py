"""What calibrating costs: sessions end to end, and the fits alone.

end to end: the bundled session, whose streams are slow, and one with all the frames that a bench records in 25 minutes
(scene paper_bench, simulated first), without and with a correction by location. Each stage apart, in the first call,
which compiles (or reads the cache of compiled programs), in the second, in which the process still takes memory from
the system, and as the median of calls after these two.
fits: every pad's power law through all of its samples with the same robust loss, the same scale of residuals and the
same start, by `calib.fit_curves` (all pads in one compiled call) and by `scipy.optimize.least_squares`, pad by pad,
with an exact Jacobian as users write it; parameters must agree to 1e-5 before a clock is read.  Ours finds the scale of
the residuals and the covariance over places too; SciPy is given the scale and finds no covariance.
memory: of a process that calibrates the bundled session again and again.
"""

import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise, product
from pathlib import Path

import jax
import numpy as np
from scipy.optimize import least_squares

import calib
import jaxeit as je
from calib.bench import load_bench, simulate
from calib.fitting.curves import FittedCurve, fit_curves
from calib.presses import PressData, pool_presses
from calib.runtime import set_up

from .clock import in_turns, require_agreement, seconds, spread
from .harness import ROOT, Question, Run
from .memory import growth, resident
from .rows import Row

SESSION = ROOT / "data" / "sessions" / "testbed_grid.h5"
WIDTH = 1.287  # of the robust loss, in units of the residuals' scale
MAX_DIFFERENCE = 1e-5
OURS, THEIRS = "calib.fit_curves", "scipy.optimize.least_squares"


def end_to_end(run: Run) -> Iterator[Row]:
    """A row of seconds for each session, way and call."""
    coarse = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
    recipes = run.sizes((calib.Recipe(), calib.Recipe(location=calib.PadEdge())), (coarse,))
    with tempfile.TemporaryDirectory() as folder:
        sessions = {"bundled": SESSION}
        if not run.smoke:
            sessions["paper_bench"] = simulate(load_bench("paper_bench"), Path(folder) / "paper_bench.h5")
        calls = {"first": 1, "second": 1, "later": 1 if run.smoke else 5}
        for (name, session), recipe, (call, count) in product(sessions.items(), recipes, calls.items()):
            spent = [stages(session, recipe, Path(folder) / "calibration.h5") for _ in range(count)]
            median = {stage: round(float(np.median([one[stage] for one in spent])), 3) for stage in spent[0]}
            about = {"session": name, "location": "yes" if recipe.locates else "no", "call": call}
            yield {"end_to_end": [about | median]}


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
    spent = {name: round(after - at, 3) for (name, at), (_, after) in pairwise(began)}
    return spent | {"all": round(began[-1][1] - began[0][1], 3)}


def fits(run: Run) -> Iterator[Row]:
    """Milliseconds for all pads, in turn; compilation apart."""
    with calib.open_session(SESSION) as session:
        data = pool_presses([session], je.load_skin("testbed")).data
    first, found = seconds(ours, data, calib.PowerLaw())
    law = calib.PowerLaw(float(np.asarray(found.curve.reference)[0]))
    found = ours(data, law)

    def theirs() -> np.ndarray:
        return np.stack([by_scipy(data, pad, law, scale) for pad, scale in enumerate(np.asarray(found.scale, float))])

    outputs = {THEIRS: theirs() / np.asarray(found.parameters), OURS: np.ones(2)}
    (difference,) = require_agreement(outputs, OURS, {THEIRS: MAX_DIFFERENCE}).values()
    calls = {OURS: lambda: jax.block_until_ready(ours(data, law).parameters), THEIRS: theirs}
    times = {name: spread(taken) for name, taken in in_turns(calls, 3 if run.smoke else 20).items()}
    about = {"samples": int(data.mask.sum()), "pads": len(data.mask), "difference": difference}
    yield {"fits": about | {"first_call_s": round(first, 3)} | times}


def ours(data: PressData, curve: calib.PowerLaw) -> FittedCurve:
    own = data.pad_samples(with_history=curve.path)  # as `calibrate` gives them
    return fit_curves(curve, own.pressure, own.force, mask=own.mask, groups=own.place)


def by_scipy(data: PressData, pad: int, law: calib.PowerLaw, scale: float) -> np.ndarray:
    """Secant and exponent of one pad, as exponents of e in the fit."""
    reference = float(law.reference)
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


def memory(run: Run) -> Iterator[Row]:
    """MB after the first calibration, after half of them and at the end, and growth over the later half."""
    count, recipe, used = 12 if run.smoke else 200, calib.Recipe(location=calib.PadEdge()), []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            stages(SESSION, recipe, Path(folder) / "calibration.h5")
            used.append((3.6 * number, resident()))  # so that an hour stands for 1,000 sessions
    found, mb = growth(np.array(used)), [round(used[at][1], 1) for at in (0, count // 2, -1)]
    names = ("mb_per_1000_sessions", "mb_per_1000_sessions_error")
    rates = {name: round(value, 1) for name, value in zip(names, found, strict=True)}
    yield {"memory": {"sessions": count, "first_half_last_mb": mb} | rates}


main = Question("fit", __doc__, {"end_to_end": end_to_end, "fits": fits, "memory": memory}, prepare=set_up)

if __name__ == "__main__":
    main()
