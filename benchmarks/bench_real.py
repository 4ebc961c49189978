"""Recordings of others on real hardware, which are not part of this project: what the fits make of them.

FOLDER holds the public recordings eflesh, pneumatic_actuator and insole_plenum (benchmarks/README.md says whose they
are).

eflesh: 15 magnetic channels against a scale; the first half in time is fitted, the second predicted.  The floor is a
static quadratic of all channels.
pneumatic_actuator: pressure against force with friction; first half fitted, second predicted, by laws that know of
hysteresis and that do not.
insole_plenum: 280 taxels against the pressure of a chamber that is filled and emptied once, all in one compiled fit.
Stuck, saturated and spiking taxels are told first; of the others each fifth of 20 stretches of time is predicted from
the rest.  Time stamps of counts and pressure differ, so that they are aligned by offset and rate.  What a static law
misses is mostly the loop, whose branches are 0.1 bar apart (median).  The shorter the reach of a law, the more it
follows the one branch where the other was held out; stretches a tenth as long a spline predicts as a cubic does, within
1 %.
command_line: the same recordings by `jaxeit import`, `check`, `calibrate --curve auto`, `evaluate` and `apply` alone.
The first half in time is calibrated, the second evaluated.  A newton of the insole stands for a bar.
"""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy import io, ndimage

import calib
from calib.fitting.channel_faults import faults
from calib.fitting.curves import CURVES, AbstractCurve, fit_curves
from calib.fitting.curves.fitted import predict_pads
from calib.fitting.logs import SmoothChannels, fit_log
from calib.fitting.results import FitResult
from calib.fitting.validation import rmse
from calib.runtime import set_up

from .harness import Question, Run
from .log_commands import through_commands
from .rows import Row

GRAM = 9.80665e-3  # N
EFLESH = "eflesh/20250401_014340_probe"
ACTUATORS = ("Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar")
LAWS = (calib.Linear(), calib.Affine(), calib.fitting.AffinePlay())
TAXEL_LAWS = (
    calib.MonotonePolynomial(),
    calib.MonotoneSpline(),
    calib.fitting.AffinePlay(),
    calib.fitting.PlaySpline(),
)
STRETCHES, FOLDS, THIN = 20, 5, 10
REST = 200  # samples at first, before the chamber is filled: the zero of counts and pressure alike


def _row(of: str, law: str, train: float, test: float, unit: str, **more: object) -> Row:
    return {"recording": of, "law": law, "fitted": round(train, 4), "predicted": round(test, 4), "unit": unit} | more


# --- pressure against force


def _actuators(folder: Path, smoke: bool) -> Iterator[Row]:
    for name in ACTUATORS[: 1 if smoke else None]:
        table = np.loadtxt(folder / "pneumatic_actuator" / f"{name}.csv.gz", delimiter=None)
        time, pressure, force = table[:, 0] * 1e6, table[:, 5] * 1e5, table[:, 6]
        for law in LAWS:
            fit = fit_log(law, time, pressure, force)
            yield _row(name, CURVES.name_of(law), fit.train.rmse, fit.held_out.rmse, "N")


# --- channels against a scale


def _eflesh_table(folder: Path) -> np.ndarray:
    """Time (ns), force (N, NaN where the scale had no new reading) and 15 channels, (n, 17)."""
    states = np.loadtxt(folder / EFLESH / "states.csv", delimiter=",")
    sensor = np.loadtxt(folder / EFLESH / "sensor_post_baselines.csv", delimiter=",")
    time = (states[:, 0] - states[0, 0]) * 1e9
    force = np.where(states[:, 4] == -1, np.nan, states[:, 4] * GRAM)
    at = (sensor[:, 0] - states[0, 0]) * 1e9
    return np.column_stack([time, force, *(np.interp(time, at, column) for column in sensor[:, 1:].T)])


def _eflesh(folder: Path, smoke: bool) -> Iterator[Row]:
    table = _eflesh_table(folder)
    time, force, signals = table[:, 0], table[:, 1], table[:, 2:]
    ways = {
        "static quadratic, ridge by cross-validation": None,
        "Gaussian process, no creep": SmoothChannels(lags=()),
        "Gaussian process with creep": SmoothChannels(),
    }
    for way, channels in list(ways.items())[: 1 if smoke else None]:
        fit = fit_log(calib.Affine(), time, signals, force, channels=channels)
        yield _row("eflesh", way, fit.train.rmse / GRAM, fit.held_out.rmse / GRAM, "g", source=fit.source)


# --- taxels against a chamber's pressure


def _insole(folder: Path, smoke: bool) -> Iterator[Row]:
    path = folder / "insole_plenum" / "calibration_dataset.mat"
    counts, pressure, rate, lag = _insole_counts(path)
    told = faults(counts, pressure)
    sound = ~told.any
    faulty = {name: np.flatnonzero(flags).tolist() for name, flags in told._asdict().items()}
    about: Row = {"recording": "insole", "taxels": counts.shape[1]} | faulty
    yield about | {"sound": int(sound.sum()), "rate": round(rate, 4), "lag_samples": round(lag, 1)}
    rows = slice(None, None, 100 if smoke else THIN)
    rest, gauge = np.median(counts[:REST], 0), np.median(pressure[:REST])  # the gauge's own zero is at 0.056 bar
    press = ndimage.median_filter(rest - counts, (9, 1))[rows][:, sound].T
    yield from _taxel_fits(press, pressure[rows] - gauge)


def _insole_counts(path: Path) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Counts (n, 280), pressure at the same samples (n,) bar, and the rate and lag of its own index."""
    found = io.loadmat(path, squeeze_me=True, struct_as_record=False)["experiment"]
    counts = found.C[:, 2:]
    return counts, *aligned(counts, found.P)


def aligned(counts: np.ndarray, pressure: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Pressure at the samples of the counts, and the rate and the lag (samples) of its own index."""
    middle, index = -np.median(counts, 1), np.arange(len(counts))

    def alike(rate: float, lag: float) -> float:
        return float(np.corrcoef(np.interp(index * rate + lag, np.arange(len(pressure)), pressure), middle)[0, 1])

    rate, lag, grid = 1.0, 0.0, partial(np.linspace, -1, 1)
    finer = ((0.02 * grid(21), 200 * grid(41)), (0.002 * grid(9), 40 * grid(9)), (4e-4 * grid(9), 8 * grid(9)))
    for rates, lags in finer:
        rate, lag = max(product(rate + rates, lag + lags), key=lambda one: alike(*one))
    return np.interp(index * rate + lag, np.arange(len(pressure)), pressure), rate, lag


def _taxel_fits(signal: np.ndarray, pressure: np.ndarray) -> Iterator[Row]:
    part = (np.arange(len(pressure)) * STRETCHES // len(pressure)) % FOLDS
    cubic = np.array([_cubic(one, pressure, part) for one in signal])
    train, test = np.median(cubic, 0)
    yield _row("insole", "static cubic, by hand", train, test, "bar", taxels=len(signal))
    for law in TAXEL_LAWS:
        each = _law_errors(law, signal, pressure, part)
        (train, test), failed = np.nanmedian(each, 0), int(np.isnan(each[:, 0]).sum())
        better = round(float(np.mean(each[:, 1] < cubic[:, 1])), 3)
        yield _row("insole", CURVES.name_of(law), train, test, "bar", failed=failed, better_than_cubic=better)


def _cubic(signal: np.ndarray, pressure: np.ndarray, part: np.ndarray) -> tuple[float, float]:
    z = signal / np.abs(signal).max()
    x = np.stack([z**k for k in range(4)], 1)
    held = np.empty_like(pressure)
    for k in range(FOLDS):
        out = part == k
        held[out] = x[out] @ np.linalg.lstsq(x[~out], pressure[~out], rcond=None)[0]
    return rmse(x @ np.linalg.lstsq(x, pressure, rcond=None)[0], pressure), rmse(held, pressure)


def _law_errors(law: AbstractCurve, signal: np.ndarray, pressure: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(taxels, 2) errors of a fit of all samples, and of those predicted; NaN where a fit failed."""
    held = np.empty_like(signal)
    for k in range(FOLDS):
        held[:, part == k] = _predicted(law, signal, pressure, part != k)[:, part == k]
    whole = _predicted(law, signal, pressure, part >= 0)
    return np.sqrt(np.stack([np.mean((e - pressure) ** 2, 1) for e in (whole, held)], 1))


def _predicted(law: AbstractCurve, signal: np.ndarray, pressure: np.ndarray, use: np.ndarray) -> np.ndarray:
    fitted = fit_curves(law, signal, pressure, mask=np.broadcast_to(use, signal.shape))
    force = np.asarray(predict_pads(fitted, jnp.asarray(signal)).force)
    return np.where((np.asarray(fitted.result) == FitResult.SUCCESS)[:, None], force, np.nan)


# --- by the command line


def _command_line(folder: Path, smoke: bool) -> Iterator[Row]:
    columns = ["--time", "0:ms", "--stream", "pressure=5:bar", "--stream", "force=6:N"]
    for name in ACTUATORS[: 1 if smoke else None]:
        table = np.loadtxt(folder / "pneumatic_actuator" / f"{name}.csv.gz")
        yield from through_commands(name, table, columns, "affine" if smoke else "auto")
    if smoke:
        return
    columns = ["--time", "0:ns", "--stream", "force=1:N", "--stream", "sensor=2-16:counts"]
    yield from through_commands("eflesh", _eflesh_table(folder), columns)
    counts, pressure, _, _ = _insole_counts(folder / "insole_plenum" / "calibration_dataset.mat")
    rows = np.arange(0, len(counts), THIN)
    columns = ["--time", "0:s", "--stream", "force=1:N", "--stream", "sensor=2-281:counts"]
    yield from through_commands("insole", np.column_stack([rows / 50.0, pressure[rows], -counts[rows]]), columns)


RECORDINGS: dict[str, Callable[[Path, bool], Iterator[Row]]] = {
    "pneumatic_actuator": _actuators,
    "eflesh": _eflesh,
    "insole_plenum": _insole,
    "command_line": _command_line,
}


def recording(name: str, run: Run) -> Iterator[Row]:
    """The rows of one recording; stops where a recording that is wanted is not there."""
    wanted = [run.args.only] if run.args.only else list(RECORDINGS)
    needed = [one for one in wanted if one != "command_line"] or FOLDERS
    absent = [one for one in needed if not (run.args.folder / one).is_dir()]
    if absent:
        folder = run.args.folder
        print(f"{folder} has no folder {', '.join(absent)}: give the one that holds the recordings", file=sys.stderr)
        raise SystemExit(2)
    for row in RECORDINGS[name](run.args.folder, run.smoke):
        print(" | ".join(f"{key} {value}" for key, value in row.items()), flush=True)
        yield {name: [row]}


FOLDERS = ["eflesh", "insole_plenum", "pneumatic_actuator"]
FOLDER: Row = {"type": Path, "metavar": "FOLDER", "help": "with eflesh, pneumatic_actuator and insole_plenum"}
PARTS = {name: partial(recording, name) for name in RECORDINGS}
main = Question("real", __doc__, PARTS, {"folder": FOLDER}, prepare=set_up)

if __name__ == "__main__":
    main()
