"""Real logs through the command line alone: import, check, calibrate on one half, evaluate on the other.

Each recording is cut in two files of equal time, because a user too has one log to calibrate with and another to trust.
"""

import io
import json
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib.cli import main

from .rows import Row

KEYS = ("force_rmse", "force_mape", "coverage", "coverage_low", "coverage_middle", "coverage_high", "outside_share")
DECIMALS = 4


def halves(table: np.ndarray, folder: Path, name: str) -> tuple[Path, Path]:
    """Two CSV files of a table whose first column is time: its first and its second half in time."""
    first = table[:, 0] - table[0, 0] < (table[-1, 0] - table[0, 0]) / 2
    paths = folder / f"{name}-1.csv", folder / f"{name}-2.csv"
    for path, rows in zip(paths, (first, ~first), strict=True):
        np.savetxt(path, table[rows], delimiter=",", fmt="%.17g")
    return paths


def through_commands(name: str, table: np.ndarray, streams: Sequence[str], curve: str = "auto") -> Iterator[Row]:
    """The row of one recording: errors and coverage on the second half, of the calibration of the first.

    Args:
        table: time, then the columns that `streams` name, as options of `jaxeit import csv`.
    """
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sessions = []
        for path in halves(table, folder, name):
            sessions.append(str(path.with_suffix(".h5")))
            _said("import", "csv", str(path), *streams, "-o", sessions[-1])
            _said("check", sessions[-1])
        calibration = str(folder / "calibration.h5")
        _said("calibrate", sessions[0], "--curve", curve, "-o", calibration)
        found = json.loads(_said("evaluate", calibration, sessions[1], "--json"))[Path(sessions[1]).name]
        _said("apply", calibration, sessions[1], "-o", str(folder / "forces.h5"))
    row: Row = {"recording": name, "law": "command line", "unit": "N"}
    yield row | {key: round(found[key], DECIMALS) for key in KEYS}


def _said(*words: str) -> str:
    """Standard output of a command that must succeed."""
    out = io.StringIO()
    with redirect_stdout(out):
        status = main(list(words))
    if status:
        raise SystemExit(f"jaxeit {' '.join(words)}: status {status}")
    return out.getvalue()
