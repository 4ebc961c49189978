"""`jaxeit import`."""

import argparse

from ..arguments import skin_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The formats, each with its own arguments."""
    from ...session.importers import add_arguments as add_formats

    add_formats(parser)


def run(args: argparse.Namespace) -> int:
    """Write the session file, and print what was found."""
    from ...session.importers import run as run_import

    return run_import(args, skin_of(args.skin))
