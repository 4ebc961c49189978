"""`jaxeit evaluate`."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from ..recipe_options import add_correction_arguments, processing_of, refuse_corrections
from ..terminal import progress_bar, show, title

if TYPE_CHECKING:
    from ...calibration import LogCalibration


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A calibration and the sessions on which it is evaluated."""
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    add_correction_arguments(parser, default="as for the calibration")
    text = "continue despite errors that `jaxeit check` finds; the results name them"
    parser.add_argument("--force", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Print a table for each session, or all as JSON."""
    from ...runtime import set_up

    set_up()
    from ...calibration import LogCalibration, evaluate, load_calibration
    from ...calibration.evaluation import render_table
    from ...session import open_session

    calibration = load_calibration(args.calibration)
    if isinstance(calibration, LogCalibration):
        return _evaluate_logs(args, calibration)
    results = {}
    for path in progress_bar("sessions")(args.sessions):
        with open_session(path) as session:
            processing = processing_of(args, calibration.processing)
            found = evaluate(calibration, session, processing, ignore_errors=args.force)
            heading = title(session.name, session.simulated)
        results[Path(path).name] = found.summary()
        if not args.json:
            show(render_table(found, heading))
    if args.json:
        print(json.dumps(results, indent=2, sort_keys=True))
    return 0


def _evaluate_logs(args: argparse.Namespace, calibration: "LogCalibration") -> int:
    """Evaluate the calibration of a sensor without EIT on logs."""
    from ...calibration.logs.evaluation import render_evaluation
    from ...calibration.logs.procedure import evaluate_log
    from ...session import open_session

    refuse_corrections(args)
    results = {}
    for path in progress_bar("sessions")(args.sessions):
        with open_session(path) as session:
            found = evaluate_log(calibration, session, ignore_errors=args.force)
            heading = title(session.name, session.simulated)
        results[Path(path).name] = found.summary()
        if not args.json:
            show(render_evaluation(found, heading))
    if args.json:
        print(json.dumps(results, indent=2, sort_keys=True))
    return 0
