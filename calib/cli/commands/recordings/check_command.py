"""`jaxeit check`."""

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...arguments import skin_of
from ...terminal import one_line, progress_bar, say, show

if TYPE_CHECKING:
    from ....session import Session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sessions or skins, and how to print what is found."""
    text = "a session to check, or a skin's TOML file to describe and check"
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5", help=text)
    parser.add_argument(
        "--skin", help="a shipped skin or a TOML file; default: that of --calibration, or else of the session"
    )
    text = "also print how far the session is off this calibration, and whether to recalibrate"
    parser.add_argument("--calibration", metavar="CALIBRATION.h5", help=text)
    text = "also tell from the untouched frame whether electrodes sit where the skin's file says; takes up to a minute"
    parser.add_argument("--electrodes", action="store_true", help=text)
    parser.add_argument("--all", action="store_true", help="print every channel and electrode")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Print a report of each session; 2 if one cannot be used."""
    from ....runtime import set_up

    set_up()
    from ....check import check_session, render, to_json
    from ....check.placement import with_placement
    from ....check.report import with_health
    from ....session import SessionError, open_session

    calibration, worst = _calibration_of(args), 0
    skin = getattr(calibration, "skin", None) if args.skin is None else skin_of(args.skin)  # that of a log has no skin
    health = None if calibration is None else _health_by(calibration)
    for path in args.sessions:
        if path.endswith(".toml"):
            if args.json:
                raise ValueError(f"{path}: is a skin, of which there is no report as JSON; leave out --json")
            show(_described(path))
            continue
        try:
            with open_session(path) as session:
                bar = progress_bar(session.name)
                report = check_session(session, skin, electrodes=args.electrodes, progress=bar)
                report = report if args.electrodes else with_placement(report, session, skin)
                report = report if health is None else with_health(report, health(session))
        except SessionError as error:
            say(one_line(error))
            worst = 2
            continue
        print(to_json(report) if args.json else render(report, verbose=args.all))
        worst = worst if report.ok else 2
    return worst


def _described(path: str) -> str:
    """What a skin's file describes, and what its model reads without contact, in words."""
    import numpy as np

    import jaxeit as je
    from jaxeit.messages.kinds import listed

    from ....check.skin import skin_findings, voltage_findings
    from ....check.text import findings_text
    from ....session.errors import printable

    skin = je.load_skin(path)
    try:
        model = je.discretise(je.Scene(skin, effects=()), je.Fidelity.draft())
    except ValueError as error:
        raise ValueError(f"{path}: {one_line(error)}") from None
    readings = 1e3 * np.abs(je.forward(model))  # mV
    low, high = skin.domain.bounds
    width, height = (1e3 * (end - start) for start, end in zip(low, high, strict=True))
    pads = listed(printable(pad.name) for pad in skin.pads) or "none"
    doubts = "\n".join(findings_text([*skin_findings(skin), *voltage_findings(1e-3 * readings)]))
    return (
        f"{printable(path, 300)}: skin {printable(skin.name)}, {width:.4g} x {height:.4g} mm\n"
        f"{len(skin.electrodes)} electrodes; pads: {pads}\n"
        f"{len(readings)} readings in {1e3 * skin.protocol.frame_time:.3g} ms; without contact "
        f"{readings.min():.3g} to {readings.max():.3g} mV\n"
        f"{doubts or 'Nothing wrong was found.'}"
    )


def _calibration_of(args: argparse.Namespace) -> Any:
    if args.calibration is None:
        return None
    from ....calibration import load_calibration

    return load_calibration(args.calibration)


def _health_by(calibration: Any) -> "Callable[[Session], str]":
    """How a session's health is told by a calibration."""
    from ....calibration import LogCalibration, assess, assess_log
    from ....session import SessionError

    def health(session: "Session") -> str:
        try:
            if isinstance(calibration, LogCalibration):
                return assess_log(calibration, session).health
            return assess(calibration, session).health
        except SessionError as error:
            return f"calibration health: not determined: {one_line(error)}"

    return health
