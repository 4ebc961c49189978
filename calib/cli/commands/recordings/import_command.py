"""`jaxeit import`."""

import argparse

from ...arguments import prepare_outputs, skin_of
from ...parser import CommandParser


def add_arguments(parser: CommandParser) -> None:
    """The formats, each with its own arguments; a user's own format where the command line names one."""
    from ....session.importers import add_arguments as add_formats

    own = [word for word in parser.words[1:2] if ":" in word]
    add_formats(parser, own)


def run(args: argparse.Namespace) -> int:
    """Write the session file, and print what was found."""
    from ....session.importers import run as run_import

    prepare_outputs(args, "output")
    return run_import(args, skin_of(args.skin))
