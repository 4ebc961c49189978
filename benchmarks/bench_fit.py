"""What calibrating costs: a session of 225 presses end to end, many sessions by workers, and the fits alone.

python -m benchmarks.bench_fit [--sessions 24] [--workers 1 2] [--smoke]

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

import argparse
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares

import calib
import jaxeit as je
from calib.bench import load_bench, simulate
from calib.calibration import press_data
from calib.fit import fit_curves
from calib.hybrid import PressData
from calib.runtime import set_up

from . import _common as c

SESSION = c.ROOT / "data" / "sessions" / "testbed_grid.h5"
WIDTH = 1.287  # of the robust loss, in units of the residuals' scale
AGREE = 1e-5


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=24)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--smoke", action="store_true", help="coarse, two sessions, one worker; writes nothing")
    args = parser.parse_args(argv)
    set_up()
    data: dict[str, Any] = {"circumstances": c.circumstances()}
    options: dict[str, Any] = {"location": calib.PadEdge()}
    if args.smoke:
        options = {"basis": je.Pixels(20), "fidelity": je.Fidelity.draft()}
    data["end_to_end"] = list(end_to_end(options, args.smoke))
    data["fits"] = fits(3 if args.smoke else 20)
    many = (2, [1]) if args.smoke else (args.sessions, args.workers)
    data["many"] = [batch(many[0], workers, options) for workers in many[1]]
    for name in ("end_to_end", "fits", "many"):
        print(name, *data[name] if isinstance(data[name], list) else [data[name]], sep="\n  ", flush=True)
    if not args.smoke:
        c.write("fit", c.closed(data))
    return data


# --- end to end -----------------------------------------------------------------------------------


def end_to_end(options: dict[str, Any], smoke: bool) -> Iterator[dict[str, Any]]:
    """A row of seconds for each session, way and call."""
    with tempfile.TemporaryDirectory() as folder:
        sessions = {"bundled": SESSION}
        if not smoke:
            sessions["paper_bench"] = simulate(load_bench("paper_bench"), Path(folder) / "paper_bench.h5")
        for name, path in sessions.items():
            for way in (options,) if smoke else ({}, options):
                for call in ("first", "second"):
                    about = {"session": name, "location": "location" in way, "call": call}
                    yield about | stages(path, way, Path(folder) / "calibration.h5")


def stages(path: Path, options: dict[str, Any], out: Path) -> dict[str, float]:
    """Seconds of each stage of one calibration, saving included."""
    began = [("opening", time.perf_counter())]
    with calib.open_session(path) as session:
        calibration = calib.calibrate(
            [session], **options, progress=lambda stage: began.append((stage, time.perf_counter()))
        )
        began.append(("saving", time.perf_counter()))
        calibration.save(out)
        began.append(("", time.perf_counter()))
    spent = {name: after - at for (name, at), (_, after) in pairwise(began)}
    return {name: round(s, 3) for name, s in spent.items()} | {"all": round(began[-1][1] - began[0][1], 3)}


# --- many -----------------------------------------------------------------------------------------


def batch(sessions: int, workers: int, options: dict[str, Any]) -> dict[str, Any]:
    """Sessions per minute, all in all and once every worker is warm, and what it comes to per session and worker."""
    ended: list[float] = []

    def tell(outcome: calib.Outcome) -> None:
        ended.append(time.perf_counter())

    with _copies(sessions) as (paths, out):
        spent, outcomes = c.seconds(lambda: calib.calibrate_many(paths, out, jobs=workers, tell=tell, **options))
    failed = [outcome.reason for outcome in outcomes if outcome.reason]
    if failed:
        raise SystemExit(f"{len(failed)} sessions failed: {failed[0]}")
    each = np.array([outcome.seconds for outcome in outcomes])
    return {
        "workers": workers,
        "sessions": sessions,
        "seconds": round(spent, 2),
        "sessions_per_minute": round(60 * sessions / spent, 2),
        "warm_sessions_per_minute": round(60 * (sessions - workers) / max(ended[-1] - ended[workers - 1], 1e-9), 2),
        "median_session_s": round(float(np.median(each)), 3),
    }


@contextmanager
def _copies(sessions: int) -> Iterator[tuple[list[Path], Path]]:
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"s{i:04d}.h5" for i in range(sessions)]
        for path in paths:
            shutil.copy(SESSION, path)
        yield paths, Path(folder) / "out"


# --- fits -----------------------------------------------------------------------------------------


def fits(repeats: int) -> dict[str, Any]:
    """Milliseconds for all pads, in turn; compilation apart."""
    with calib.open_session(SESSION) as session:
        data, _, _ = press_data([calib.measure(session, je.load_skin("testbed"))])
    start = time.perf_counter()
    ours = _ours(data)
    first = time.perf_counter() - start
    curve = calib.PowerLaw(float(np.asarray(ours.curve.reference)[0]))
    ours, scales = _ours(data, curve), None
    scales = np.asarray(ours.scale, float)
    theirs = np.stack(
        [_theirs(data, pad, float(np.asarray(curve.reference)), scales[pad]) for pad in range(len(scales))]
    )
    difference = float(np.abs(theirs / np.asarray(ours.parameters) - 1).max())
    if difference > AGREE:
        raise SystemExit(f"scipy's parameters differ by {difference:.1e}: nothing is timed")
    times: dict[str, list[float]] = {"calib.fit_curves": [], "scipy.optimize.least_squares": []}
    for _ in range(repeats):
        times["calib.fit_curves"].append(c.seconds(lambda: jax.block_until_ready(_ours(data, curve).parameters))[0])
        times["scipy.optimize.least_squares"].append(
            c.seconds(
                lambda: [_theirs(data, pad, float(np.asarray(curve.reference)), s) for pad, s in enumerate(scales)]
            )[0]
        )
    return {
        "samples": int(data.mask.sum()),
        "pads": len(scales),
        "difference": difference,
        "first_call_s": round(first, 3),
        **{name: c.spread(t) for name, t in times.items()},
        "remark": "ours finds the scale of the residuals in four rounds and the covariance over places too; scipy is "
        "given the scale and finds no covariance",
    }


def _ours(data: PressData, curve: calib.PowerLaw | None = None):
    curve = curve or calib.PowerLaw()
    own = data.samples_for(curve)  # as `calibrate` gives them
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

    found = least_squares(
        residual, [0.0, 0.0], jac=slope, loss="soft_l1", f_scale=WIDTH, xtol=1e-9, ftol=1e-9, gtol=1e-9
    )
    return np.array([np.exp(found.x[0]) * size, np.exp(found.x[1])])


if __name__ == "__main__":
    main()
