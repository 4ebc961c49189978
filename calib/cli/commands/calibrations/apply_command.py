"""`jaxeit apply`."""

import argparse
from typing import TYPE_CHECKING

from ...arguments import (
    NO_PROPOSAL,
    above_zero,
    add_proposal_argument,
    add_settings_argument,
    add_tracking_arguments,
    prepare_results,
    proposal_of,
    require_matplotlib_for,
    settings_of_option,
    tracking_of,
)
from ...recipe_options import add_correction_arguments, processing_of, refuse_corrections
from ...terminal import after_writing, progress_bar, show

if TYPE_CHECKING:
    from ....calibration import LogCalibration


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A calibration, a session, and the file to write."""
    parser.add_argument("calibration", metavar="CALIBRATION.h5")
    parser.add_argument("session", metavar="SESSION.h5")
    parser.add_argument("-o", "--output", required=True, metavar="FORCEMAP.h5")
    text = "continue despite errors that `jaxeit check` finds; the results name them"
    parser.add_argument("--force", action="store_true", help=text)
    text = "also tell what touches the skin (one, two or an edge, with probabilities) in windows of this duration"
    parser.add_argument("--loads", type=above_zero, metavar="SECONDS", help=text)
    add_proposal_argument(parser, "with --loads: the network of jaxeit train, where fits begin")
    text = (
        "with --loads: only round tips touch the skin; two are told apart at smaller distances, and nothing is an edge"
    )
    parser.add_argument("--round-tips", action="store_true", help=text)
    text = "with --loads: what is known of loads, settings of jaxeit.contacts.LoadSettings"
    add_settings_argument(parser, "--load-settings", text, "width=0.008")
    text = "also follow contacts from frame to frame: number, place with covariance, force, smoothed over time"
    add_tracking_arguments(parser, text)
    text = (
        "write an HTML report: paths and forces of the contacts that are followed (--track), probabilities of --loads"
    )
    parser.add_argument("--report", metavar="REPORT.html", help=text)
    add_correction_arguments(parser, default="as for the calibration")


def run(args: argparse.Namespace) -> int:
    """Write the force map of every frame, or the force of a log over time."""
    from ....runtime import set_up

    set_up()
    from jaxeit.contacts import LoadSettings

    from ....calibration import LogCalibration, apply, load_calibration
    from ....session import open_session

    _check_options(args)
    track = tracking_of(args)
    known = settings_of_option(args, "load_settings", LoadSettings)
    prepare_results(args, "output", "report")
    calibration = load_calibration(args.calibration)
    if isinstance(calibration, LogCalibration):
        return _run_log(args, calibration)
    with open_session(args.session) as session:
        apply(
            calibration,
            session,
            args.output,
            processing=processing_of(args, calibration.processing),
            ignore_errors=args.force,
            progress=progress_bar("frames"),
            loads=args.loads,
            proposal=proposal_of(args.proposal),
            load_settings=LoadSettings.round_tips() if args.round_tips else known,
            track=track,
            tell=show,
        )
        frames = len(session.stream("eit"))
    if args.report is not None:
        from ....report.track_report import write_track_report

        with after_writing(args.output):
            write_track_report(args.report, args.output, calibration.skin)
    show(f"{args.output}: {frames} force maps in newtons")
    return 0


def _check_options(args: argparse.Namespace) -> None:
    if args.proposal is not None and args.loads is None:
        raise ValueError("--proposal: it is where fits of loads begin; add --loads SECONDS")
    if args.round_tips and args.loads is None:
        raise ValueError("--round-tips: it is about fits of loads; add --loads SECONDS")
    if args.load_settings is not None and args.loads is None:
        raise ValueError("--load-settings: it is about fits of loads; add --loads SECONDS")
    if args.load_settings is not None and args.round_tips:
        raise ValueError("--load-settings and --round-tips both say what is known of loads; give one of them")
    if args.round_tips and args.proposal not in (None, NO_PROPOSAL):
        raise ValueError("--round-tips: a proposal was trained on tips of all shapes; leave out one of the two")
    if args.report is not None:
        if not tracking_of(args) and args.loads is None:
            raise ValueError("--report: it is about contacts; add --track, which follows them, or --loads SECONDS")
        require_matplotlib_for("--report")


def _run_log(args: argparse.Namespace, calibration: "LogCalibration") -> int:
    from ....calibration import apply_log
    from ....session import open_session

    refuse_corrections(args)
    if args.loads is not None or tracking_of(args):
        option = "--loads" if args.loads is not None else "--tracker" if args.tracker is not None else "--track"
        raise ValueError(f"{option}: the calibration of a log has no EIT, which tells where contacts are")
    with open_session(args.session) as session:
        found = apply_log(calibration, session, args.output, ignore_errors=args.force, tell=show)
    outside = (~found.valid).mean() if len(found.valid) else 0.0
    show(f"{args.output}: {len(found.force)} forces in newtons, {outside:.1%} outside the calibrated range")
    return 0
