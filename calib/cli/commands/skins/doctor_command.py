"""`jaxeit doctor`."""

import argparse

from ...terminal import show


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """No arguments."""
    del parser


def run(args: argparse.Namespace) -> int:
    """Print what this machine has; 2 if something is broken."""
    del args
    from ...diagnosis import examine

    lines = examine()
    show("\n".join(line.render() for line in lines))
    return 0 if all(line.ok for line in lines) else 2
