"""`jaxeit evaluate`."""

import argparse
import json
from pathlib import Path
from typing import Any

from ...recipe_options import add_correction_arguments, processing_of, refuse_corrections
from ...results import render_found
from ...terminal import progress_bar, show, title


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
    from ....runtime import set_up

    set_up()
    from ....calibration import LogCalibration, evaluate, load_calibration
    from ....session import open_session

    calibration = load_calibration(args.calibration)
    choices: dict[str, Any] = {"ignore_errors": args.force}
    if isinstance(calibration, LogCalibration):
        refuse_corrections(args)
    else:
        choices["processing"] = processing_of(args, calibration.processing)
    results = {}
    for path in progress_bar("sessions")(args.sessions):
        with open_session(path) as session:
            found = evaluate(calibration, session, **choices)
            heading = title(session.name, session.simulated)
        results[Path(path).name] = found.summary()
        if not args.json:
            show(render_found(found, heading))
    if args.json:
        print(json.dumps(results, indent=2, sort_keys=True))
    return 0
