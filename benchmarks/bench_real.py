"""Recordings of others on real hardware, which are not part of this project, by the command line alone.

FOLDER holds the public recordings eflesh (15 magnetic channels against a scale), pneumatic_actuator (pressure against
force with friction) and insole_plenum (280 taxels against the pressure of a chamber, filled and emptied once; a newton
stands for a bar).  Each is cut in two files of equal time, because a user too has one log to calibrate with and another
to trust: `jaxeit import`, `check`, `calibrate --curve auto` on the first, `evaluate` and `apply` on the second.
`rmse_goes_on` is the RMSE over the second half where `apply` is given the whole log, whose history is known.

`chance` holds, for each third of the force, between which shares exact 90 % intervals cover in at least 90 % of cases,
by the binomial distribution of as many independent parts as the third has: blocks of time, or whole cycles of load.
The stage of eflesh stands at one place, so that `--location auto` must leave the place out and lose nothing.
"""

import io
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.io import loadmat
from scipy.stats import binom

import calib
from calib.calibration.logs.evaluation import LOG_THIRDS, LogEvaluation, thirds
from calib.cli import main as jaxeit
from calib.fitting.cross_validation.scores import rmse
from calib.fitting.intervals import COVERAGE
from calib.fitting.logs.directions import count_cycles
from calib.fitting.logs.series import LogSeries
from calib.runtime import set_up
from calib.session import read_archive

from .harness import Question, Run
from .rows import Row

GRAM = 9.80665e-3  # N
EFLESH = "eflesh/20250401_014340_probe"
FOLDERS = ("eflesh", "insole_plenum", "pneumatic_actuator")
KEYS = (
    "force_rmse",
    "rmse_goes_on",
    "force_mape",
    "coverage",
    "coverage_low",
    "coverage_middle",
    "coverage_high",
    "outside_share",
)


def actuator(folder: Path, name: str) -> np.ndarray:
    """Time (ms), pressure (bar) and force (N) in columns 0, 5 and 6."""
    return np.loadtxt(folder / "pneumatic_actuator" / f"{name}.csv.gz")


def eflesh(folder: Path) -> np.ndarray:
    """Time (ns), force (N, NaN where the scale had no new reading), 15 channels, and the stage's x, y (mm), (n, 19)."""
    states = np.loadtxt(folder / EFLESH / "states.csv", delimiter=",")
    sensor = np.loadtxt(folder / EFLESH / "sensor_post_baselines.csv", delimiter=",")
    time, at = ((column - states[0, 0]) * 1e9 for column in (states[:, 0], sensor[:, 0]))
    force = np.where(states[:, 4] == -1, np.nan, states[:, 4] * GRAM)
    return np.column_stack([time, force, *(np.interp(time, at, column) for column in sensor[:, 1:].T), states[:, 1:3]])


def insole(folder: Path) -> np.ndarray:
    """Time (s), pressure (bar) and counts that rise with it, of every tenth sample, (n, 282)."""
    counts, pressure = insole_counts(folder)
    return np.column_stack([np.arange(len(counts)) / 50.0, pressure, -counts])[::10]


def insole_counts(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Counts (n, 280), and pressure at the same samples (n,) bar."""
    path = folder / "insole_plenum" / "calibration_dataset.mat"
    found = loadmat(path, squeeze_me=True, struct_as_record=False)["experiment"]
    counts = np.asarray(found.C)[:, 2:]
    return counts, aligned(counts, found.P)


def aligned(counts: np.ndarray, pressure: np.ndarray) -> np.ndarray:
    """Pressure at the samples of the counts; the two were recorded by clocks of their own, of another rate and lag."""
    middle, index, own = -np.median(counts, 1), np.arange(len(counts)), np.arange(len(pressure))

    def at_counts(rate: float, lag: float) -> np.ndarray:
        return np.interp(index * rate + lag, own, pressure)

    best, grid = (1.0, 0.0), partial(np.linspace, -1, 1)
    finer = ((0.02 * grid(21), 200 * grid(41)), (0.002 * grid(9), 40 * grid(9)), (4e-4 * grid(9), 8 * grid(9)))
    for rates, lags in finer:
        tried = product(best[0] + rates, best[1] + lags)
        best = max(tried, key=lambda one: np.corrcoef(at_counts(*one), middle)[0, 1])
    return at_counts(*best)


class Recording(NamedTuple):
    """A table whose first column is time, read from the folder, and its columns as options of `jaxeit import csv`.

    The choices are further options of `jaxeit calibrate`.
    """

    read: Callable[[Path], np.ndarray]
    streams: str
    choices: str = ""


PRESSED = "--time 0:ms --stream pressure=5:bar --stream force=6:N"
MAGNETIC = "--time 0:ns --stream force=1:N --stream sensor=2-16:counts"
RECORDINGS = {
    **{
        name: Recording(partial(actuator, name=name), PRESSED)
        for name in ("Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar")
    },
    "eflesh": Recording(eflesh, MAGNETIC),
    "eflesh, with its stage": Recording(eflesh, f"{MAGNETIC} --stream stage=17,18:mm", "--location auto"),
    "insole": Recording(insole, "--time 0:s --stream force=1:N --stream sensor=2-281:counts"),
}


def measure(run: Run) -> Iterator[Row]:
    """A row for each recording; stops where one is not there."""
    if absent := [name for name in FOLDERS if not (run.args.folder / name).is_dir()]:
        print(f"{run.args.folder} has no folder {', '.join(absent)}: give the one that has them all", file=sys.stderr)
        raise SystemExit(2)
    for name, recording in run.sizes(list(RECORDINGS.items()), list(RECORDINGS.items())[:1]):
        with TemporaryDirectory() as folder:
            table = recording.read(run.args.folder)
            found = through_commands(table, recording, Path(folder), "affine" if run.smoke else "auto")
        label: Row = {"recording": name}
        yield {
            "command_line": [label | {"unit": "N"} | {key: round(found[key], 4) for key in KEYS}],
            "chance": [label | row for row in found["chance"]],
        }


def through_commands(table: np.ndarray, recording: Recording, folder: Path, curve: str) -> Row:
    """Evaluation on the second half in time of the calibration of the first."""
    streams = recording.streams.split()
    first = table[:, 0] - table[0, 0] < (table[-1, 0] - table[0, 0]) / 2
    sessions = [str(folder / name) for name in ("first.h5", "second.h5", "whole.h5")]
    for session, rows in zip(sessions, (first, ~first, np.ones_like(first)), strict=True):
        log = session.replace(".h5", ".csv")
        np.savetxt(log, table[rows], delimiter=",", fmt="%.17g")
        said("import", "csv", log, *streams, "-o", session)
        said("check", session)
    calibration, forces = str(folder / "calibration.h5"), str(folder / "forces.h5")
    said("calibrate", sessions[0], "--curve", curve, *recording.choices.split(), "-o", calibration)
    said("apply", calibration, sessions[2], "-o", forces)
    found = json.loads(said("evaluate", calibration, sessions[1], "--json"))["second.h5"]
    with calib.open_session(sessions[1]) as second:
        chance = list(chance_rows(calib.evaluate(calib.load_calibration(calibration), second)))
    return found | {"rmse_goes_on": rmse_of_later_half(sessions[2], forces), "chance": chance}


def chance_rows(found: LogEvaluation) -> Iterator[Row]:
    """For each third of the force, its coverage, and the least and most that chance allows an exact interval.

    Samples that follow each other err together. Blocks are the parts that the fits take for independent
    (`LogSeries.blocks`). Cycles are those of load, which the intervals take for independent. Parts hold unequal numbers
    m of the samples of a third, and count as (sum m)^2 / sum m^2 equal ones.
    """
    rows = found.known & found.valid
    inside = (found.force >= found.low) & (found.force <= found.high)
    series = LogSeries(found.time, found.predicted[:, None], found.force, np.zeros(len(rows), int))
    parts = {"blocks": series.blocks(rows), "cycles": series.blocks(rows, count_cycles(found.force))}
    third = thirds(found.force[rows])
    for k, name in enumerate(LOG_THIRDS):
        covered = float(np.mean(inside[rows][third == k])) if (third == k).any() else float("nan")
        row: Row = {"third": name, "coverage": round(covered, 4)}
        for kind, part in parts.items():
            least, most = chance_band(count := effective_count(part[rows][third == k]))
            row |= {kind: count, f"{kind}_least": least, f"{kind}_most": most}
        yield row | {"beyond": beyond(row)}


def effective_count(part: np.ndarray) -> int:
    """Number of equal parts whose mean scatters as that of these samples, whose parts are numbered (n,)."""
    sizes = np.bincount(part).astype(float)
    return max(round(sizes.sum() ** 2 / np.sum(sizes**2)), 1) if len(part) else 0


def chance_band(count: int) -> tuple[float, float]:
    """Shares of parts between which an exact interval covers in at least 90 % of cases; no part tells nothing."""
    if not count:
        return 0.0, 1.0
    least, most = binom.ppf([(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], count, COVERAGE) / count
    return round(float(least), 4), round(float(most), 4)


def beyond(row: Row) -> str:
    """Whether the coverage of a row is beyond chance, in words: by blocks and cycles, by one of them, or by none."""
    chance = {kind: (row[f"{kind}_least"], row[f"{kind}_most"]) for kind in ("blocks", "cycles")}
    kinds = [kind for kind, (least, most) in chance.items() if not least <= row["coverage"] <= most]
    return "by " + " and ".join(kinds) if kinds else "no"


def rmse_of_later_half(session: str, forces: str) -> float:
    """RMSE in N, over the second half in time, of a file of forces against the force of its session."""
    found = read_archive(forces, "log-forces").arrays
    with calib.open_session(session) as log:
        stream = log.stream("force")
        time, true = np.asarray(stream.time), stream.read()[:, 0]
    later = np.isfinite(true) & (time - time[0] >= (time[-1] - time[0]) / 2)
    return rmse(np.interp(time[later], found["time"], found["force"]), true[later])


def said(*words: str) -> str:
    """Standard output of a command that must succeed."""
    out = io.StringIO()
    with redirect_stdout(out):
        status = jaxeit(list(words))
    if status:
        raise SystemExit(f"jaxeit {' '.join(words)}: status {status}")
    return out.getvalue()


FOLDER: Row = {"type": Path, "metavar": "FOLDER", "help": "with eflesh, pneumatic_actuator and insole_plenum"}
main = Question("real", __doc__, {"command_line": measure}, {"folder": FOLDER}, prepare=set_up)

if __name__ == "__main__":
    main()
