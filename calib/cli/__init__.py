"""The `jaxeit` command.  Each command is a module of its own, imported when it is called, so that --help is quick."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from .terminal import one_line

COMMANDS = {
    "simulate": "simulate a bench session from a scene file",
    "check": "validate a recording; say what is wrong and where",
    "import": "bring foreign recordings into a session file",
    "calibrate": "fit a calibration to recorded sessions",
    "evaluate": "judge a calibration on other sessions",
    "apply": "write the force map of every frame of a session",
    "bench": "measure what accuracy costs in time, for a skin on this machine",
    "record": "record devices into a session file; nothing that arrived is lost",
    "live": "show the force map as frames arrive, on a page of its own",
    "doctor": "examine this machine: versions, device, threads, cache, disk, ports",
    "recover": "make a session of what a crash left of a recording",
}
"""What each command does; ``name`` is the module ``commands/name_command.py`` with `add_arguments` and `run`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 2 for bad input with one line on standard error."""
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        args = _parser(argv).parse_args(argv)
        status: int = args.command(args)
        return status
    except (ValueError, OSError, ImportError) as error:
        print(f"jaxeit: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxeit: interrupted; nothing was written", file=sys.stderr)
        return 130


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """All commands by name; the arguments only of the one that is called, as its module costs imports."""
    chosen = next((word for word in argv if not word.startswith("-")), None)
    parser = argparse.ArgumentParser(
        prog="jaxeit",
        description="Force maps in newtons from EIT-pneumatic robot skins.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == chosen:
            module = import_module(f".commands.{name}_command", __name__)
            command.set_defaults(command=module.run)
            module.add_arguments(command)
    return parser


class _Version(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        from importlib import metadata

        parser.exit(message=f"jaxeit {metadata.version('jaxeit')}\n")
