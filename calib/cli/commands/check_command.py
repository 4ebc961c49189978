"""`jaxeit check`."""

import argparse
import sys

from ..arguments import skin_of
from ..terminal import one_line, progress_bar


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sessions, and how to print what is found."""
    parser.add_argument("sessions", nargs="+", metavar="SESSION.h5")
    parser.add_argument("--skin", help="a shipped skin or a TOML file; default: the session's own")
    parser.add_argument("--all", action="store_true", help="print every channel")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Print a report of each session; 2 if one cannot be used."""
    from ...runtime import set_up

    set_up()
    from ...check import check_session, render, to_json
    from ...session import SessionError, open_session

    skin, worst = skin_of(args.skin), 0
    for path in args.sessions:
        try:
            with open_session(path) as session:
                report = check_session(session, skin, progress=progress_bar(session.name))
        except SessionError as error:
            print(f"jaxeit: {one_line(error)}", file=sys.stderr)
            worst = 2
            continue
        print(to_json(report) if args.json else render(report, verbose=args.all))
        worst = worst if report.ok else 2
    return worst
