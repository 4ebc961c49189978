"""Writes two calibrations and their reports in turn, until it is killed; see `test_calibration`."""

import jax

from calib.calibration import load_calibration
from calib.report import write_report

jax.config.update("jax_enable_x64", True)


def write_for_ever(ready, out, begun):
    """`ready`: calibrations to load; `out`: a folder to write them to under one name; `begun` is set in between."""
    versions = [load_calibration(path) for path in ready]
    begun.set()
    while True:
        for calibration in versions:
            write_all(calibration, out)


def write_all(calibration, out):
    """As ``jaxeit calibrate -o out/cal.h5 --report out/cal.html`` does."""
    calibration.save(out / "cal.h5")
    write_report(calibration, out / "cal.html")
