"""`jaxeit recalibrate`."""

import argparse
from typing import TYPE_CHECKING

from ...arguments import percent, prepare_results
from ...terminal import show, title

if TYPE_CHECKING:
    from ....calibration import LogCalibration
    from ....fitting.gain_update import GainDrift


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A calibration, a session recorded since, and the file to write."""
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("session", metavar="SESSION.h5")
    parser.add_argument("-o", "--output", required=True, metavar="NEW.h5", help="the same calibration, moved")
    text = (
        "presses of known force, or ordinary use without a load cell; default: force, if the session has such a stream"
    )
    parser.add_argument("--from", dest="evidence", choices=("force", "use"), help=text)
    text = (
        "percent by which a gain may have drifted, of each pad and of all together (standard deviations); default: 10"
    )
    parser.add_argument("--drift", type=percent, default=10.0, metavar="PERCENT", help=text)
    text = "also learn the gain of the contact layer, from presses or from contacts that are followed"
    parser.add_argument("--learn-layer", action="store_true", help=text)
    text = "continue despite errors that `jaxeit check` finds, or if the session determines the gain of no pad"
    parser.add_argument("--force", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Write the moved calibration, and print what has changed."""
    from ....runtime import set_up

    set_up()
    from ....calibration import KnownForces, LogCalibration, OrdinaryUse, learn_layer, load_calibration, recalibrate
    from ....calibration.layer import render_layer
    from ....calibration.recalibration.changes import render
    from ....fitting.gain_update import GainDrift
    from ....session import open_session

    prepare_results(args, "output")
    drift = GainDrift(args.drift / 100, args.drift / 100)
    ways = {"force": KnownForces(drift), "use": OrdinaryUse(drift)}
    calibration = load_calibration(args.calibration)
    if isinstance(calibration, LogCalibration):
        return _recalibrate_log(args, calibration, drift)
    with open_session(args.session) as session:
        way = args.evidence or ("force" if "force" in session.streams else "use")
        moved = recalibrate(calibration, session, ways[way], ignore_errors=args.force)
        if args.learn_layer:
            moved = learn_layer(moved, session, ignore_errors=args.force)
        heading = title(session.name, session.simulated)
    moved.save(args.output)
    found = moved.recalibration
    assert found is not None
    print(found.to_json()) if args.json else show(f"{heading}\n{render(found)}")
    if moved.layer is not None and not args.json:
        show(render_layer(moved.layer, moved.recon))
    if moved.contact_law is not None and not args.json:
        show(f"force without pads: {moved.contact_law.render()}")
    return 0


def _recalibrate_log(args: argparse.Namespace, calibration: "LogCalibration", drift: "GainDrift") -> int:
    """Write the moved calibration of a log, and print what has changed."""
    from ....calibration import recalibrate_log
    from ....calibration.logs.shift import render_shift
    from ....session import open_session

    if args.learn_layer:
        raise ValueError(f"{args.calibration}: the calibration of a log has no contact layer; leave --learn-layer")
    if args.evidence == "use":
        raise ValueError(f"{args.calibration}: the calibration of a log, which only known force can move; record force")
    with open_session(args.session) as session:
        moved = recalibrate_log(calibration, session, drift, ignore_errors=args.force)
        heading = title(session.name, session.simulated)
    moved.save(args.output)
    assert moved.shift is not None
    print(moved.shift.to_json()) if args.json else show(f"{heading}\n{render_shift(moved.shift)}")
    return 0
