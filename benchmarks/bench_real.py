"""Recordings of others on real hardware, which are not part of this project: what the fits make of them.

python -m benchmarks.bench_real FOLDER [--only NAME] [--smoke]

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
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import io, ndimage

import calib
from calib.curves import AbstractCurve, curve_name
from calib.fit import FitResult, fit_curves, predict_pads
from calib.response import fit_log, rmse
from calib.runtime import set_up
from calib.smooth import SmoothChannels
from calib.taxels import faults

from . import _common as c

GRAM = 9.80665e-3  # N
EFLESH = "eflesh/20250401_014340_probe"
ACTUATORS = ("Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar")
LAWS = (calib.Linear(), calib.Affine(), calib.Hysteresis())
STRETCHES, PARTS, THIN = 20, 5, 10
REST = 200  # samples at first, before the chamber is filled: the zero of counts and pressure alike


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with eflesh, pneumatic_actuator and insole_plenum")
    parser.add_argument("--only", choices=RECORDINGS, help="one of them; its rows alone are replaced in the results")
    parser.add_argument("--smoke", action="store_true", help="few samples; writes nothing")
    args = parser.parse_args(argv)
    wanted = [args.only] if args.only else list(RECORDINGS)
    absent = [name for name in wanted if not (args.folder / name).is_dir()]
    if absent:
        parser.error(f"{args.folder} has no folder {', '.join(absent)}: give the one that holds the recordings")
    set_up()
    data: dict[str, Any] = (_stored() if args.only else {}) | {"circumstances": c.circumstances()}
    for name in wanted:
        data[name] = []
        for row in RECORDINGS[name](args.folder, args.smoke):
            data[name].append(row)
            print(" | ".join(f"{key} {value}" for key, value in row.items()), flush=True)
        if not args.smoke:  # at once: the insole takes minutes, and what is done is not lost if it is stopped
            c.write("real", c.closed(data))
    return data


def _stored() -> dict[str, Any]:
    path = c.RESULTS / f"{c.machine()}.json"
    return json.loads(path.read_text(encoding="utf-8")).get("real", {}) if path.exists() else {}


def _row(of: str, law: str, train: float, test: float, unit: str, **more: Any) -> dict[str, Any]:
    return {"recording": of, "law": law, "fitted": round(train, 4), "predicted": round(test, 4), "unit": unit} | more


# --- pressure against force -----------------------------------------------------------------------


def _actuators(folder: Path, smoke: bool) -> Iterator[dict[str, Any]]:
    for name in ACTUATORS[: 1 if smoke else None]:
        table = np.loadtxt(folder / "pneumatic_actuator" / f"{name}.csv.gz", delimiter=None)
        time, pressure, force = table[:, 0] * 1e6, table[:, 5] * 1e5, table[:, 6]
        for law in LAWS:
            fit = fit_log(law, time, pressure, force)
            yield _row(name, curve_name(law), fit.train.rmse, fit.held_out.rmse, "N")


# --- channels against a scale -----------------------------------------------------------------------


def _eflesh(folder: Path, smoke: bool) -> Iterator[dict[str, Any]]:
    states = np.loadtxt(folder / EFLESH / "states.csv", delimiter=",")
    sensor = np.loadtxt(folder / EFLESH / "sensor_post_baselines.csv", delimiter=",")
    time = (states[:, 0] - states[0, 0]) * 1e9
    force = np.where(states[:, 4] == -1, np.nan, states[:, 4] * GRAM)
    at = (sensor[:, 0] - states[0, 0]) * 1e9
    signals = np.stack([np.interp(time, at, column) for column in sensor[:, 1:].T], 1)
    ways = {
        "static quadratic, ridge by cross-validation": None,
        "Gaussian process, no creep": SmoothChannels(lags=()),
        "Gaussian process with creep": SmoothChannels(),
    }
    for way, channels in list(ways.items())[: 1 if smoke else None]:
        fit = fit_log(calib.Affine(), time, signals, force, channels=channels)
        yield _row("eflesh", way, fit.train.rmse / GRAM, fit.held_out.rmse / GRAM, "g", source=fit.source)


# --- taxels against a chamber's pressure --------------------------------------------------------------


def _insole(folder: Path, smoke: bool) -> Iterator[dict[str, Any]]:
    found = io.loadmat(folder / "insole_plenum" / "calibration_dataset.mat", squeeze_me=True, struct_as_record=False)[
        "experiment"
    ]
    counts = found.C[:, 2:]
    pressure, rate, lag = aligned(counts, found.P)
    told = faults(counts, pressure)
    sound = ~told.any
    yield {
        "recording": "insole",
        "taxels": counts.shape[1],
        **{name: np.flatnonzero(flags).tolist() for name, flags in told._asdict().items()},
        "sound": int(sound.sum()),
        "rate": round(rate, 4),
        "lag_samples": round(lag, 1),
    }
    rows = slice(None, None, 100 if smoke else THIN)
    rest, gauge = np.median(counts[:REST], 0), np.median(pressure[:REST])  # the gauge's own zero is at 0.056 bar
    press = ndimage.median_filter(rest - counts, (9, 1))[rows][:, sound].T
    yield from _taxel_fits(press, pressure[rows] - gauge)


def aligned(counts: np.ndarray, pressure: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Pressure at the samples of the counts, and the rate and the lag (samples) of its own index."""
    middle, index = -np.median(counts, 1), np.arange(len(counts))

    def alike(rate: float, lag: float) -> float:
        return float(np.corrcoef(np.interp(index * rate + lag, np.arange(len(pressure)), pressure), middle)[0, 1])

    tried = [(alike(r, k), r, k) for r in np.linspace(0.98, 1.02, 21) for k in np.linspace(-200, 200, 41)]
    for step in (0.001, 0.0002):
        _, rate, lag = max(tried)
        around = np.linspace(-2, 2, 9)
        tried = [
            (alike(rate + a * step, lag + b * 2e4 * step), rate + a * step, lag + b * 2e4 * step)
            for a in around
            for b in around
        ]
    _, rate, lag = max(tried)
    return np.interp(index * rate + lag, np.arange(len(pressure)), pressure), rate, lag


def _taxel_fits(signal: np.ndarray, pressure: np.ndarray) -> Iterator[dict[str, Any]]:
    part = (np.arange(len(pressure)) * STRETCHES // len(pressure)) % PARTS
    cubic = np.array([_cubic(one, pressure, part) for one in signal])
    yield _row("insole", "static cubic, by hand", *np.median(cubic, 0), "bar", taxels=len(signal))
    for law in (calib.MonotonePolynomial(), calib.MonotoneSpline(), calib.Hysteresis(), calib.HysteresisSpline()):
        each = _law_errors(law, signal, pressure, part)
        better = float(np.mean(each[:, 1] < cubic[:, 1]))
        yield _row(
            "insole",
            curve_name(law),
            *np.nanmedian(each, 0),
            "bar",
            failed=int(np.isnan(each[:, 0]).sum()),
            better_than_cubic=round(better, 3),
        )


def _cubic(signal: np.ndarray, pressure: np.ndarray, part: np.ndarray) -> tuple[float, float]:
    z = signal / np.abs(signal).max()
    x = np.stack([z**k for k in range(4)], 1)
    held = np.empty_like(pressure)
    for k in range(PARTS):
        out = part == k
        held[out] = x[out] @ np.linalg.lstsq(x[~out], pressure[~out], rcond=None)[0]
    return rmse(x @ np.linalg.lstsq(x, pressure, rcond=None)[0], pressure), rmse(held, pressure)


def _law_errors(law: AbstractCurve, signal: np.ndarray, pressure: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(taxels, 2) errors of a fit of all samples, and of those predicted; NaN where a fit failed."""
    held = np.empty_like(signal)
    for k in range(PARTS):
        held[:, part == k] = _predicted(law, signal, pressure, part != k)[:, part == k]
    whole = _predicted(law, signal, pressure, part >= 0)
    return np.sqrt(np.stack([np.mean((e - pressure) ** 2, 1) for e in (whole, held)], 1))


def _predicted(law: AbstractCurve, signal: np.ndarray, pressure: np.ndarray, use: np.ndarray) -> np.ndarray:
    fitted = fit_curves(law, signal, pressure, mask=np.broadcast_to(use, signal.shape))
    force = np.asarray(predict_pads(fitted, jnp.asarray(signal)).force)
    return np.where((np.asarray(fitted.result) == FitResult.SUCCESS)[:, None], force, np.nan)


RECORDINGS = {"pneumatic_actuator": _actuators, "eflesh": _eflesh, "insole_plenum": _insole}

if __name__ == "__main__":
    main()
