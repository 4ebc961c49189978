"""Writes two calibrations and their reports in turn, until it is killed; see `test_calibration`."""

import jax

from calib.calibration.calibration import load_calibration
from calib.report import document as report

jax.config.update("jax_enable_x64", True)


def write_for_ever(ready, drawn, out, begun):
    """`ready`: calibrations to load; `drawn`: their pictures by their notes; `out`: a folder to write them to under one
    name; `begun` is set in between."""
    versions = [load_calibration(path) for path in ready]
    report.calibration_pictures = lambda calibration, _: drawn[calibration.notes]  # drawing takes long, writes nothing
    begun.set()
    while True:
        for calibration in versions:
            write_all(calibration, out)


def write_all(calibration, out):
    """As ``jaxeit calibrate -o out/cal.h5 --report out/cal.html`` does."""
    calibration.save(out / "cal.h5")
    report.write_report(calibration, out / "cal.html")
