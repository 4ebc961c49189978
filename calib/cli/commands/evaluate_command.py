"""`jaxeit evaluate`."""

import argparse
import json
from pathlib import Path

from ..recipe_options import add_low_pass_argument, processing_of
from ..terminal import progress_bar, title


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A calibration and the sessions on which it is evaluated."""
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    add_low_pass_argument(parser)
    text = "continue despite errors that `jaxeit check` finds; the results name them"
    parser.add_argument("--force", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Print a table for each session, or all as JSON."""
    from ...runtime import set_up

    set_up()
    from ...calibration import evaluate, load_calibration
    from ...calibration.evaluation import render_table
    from ...session import open_session

    calibration = load_calibration(args.calibration)
    results = {}
    for path in progress_bar("sessions")(args.sessions):
        with open_session(path) as session:
            processing = processing_of(args, calibration.processing)
            found = evaluate(calibration, session, processing, ignore_errors=args.force)
            heading = title(session.name, session.simulated)
        results[Path(path).name] = found.summary()
        if not args.json:
            print(render_table(found, heading))
    if args.json:
        print(json.dumps(results, indent=2, sort_keys=True))
    return 0
