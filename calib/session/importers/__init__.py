"""Bring recordings made elsewhere into the session format: a class for each format.

A new format is one class derived from `AbstractImporter` in a module of this room, and its import here; another
package adds one by an entry point of the group ``calib.importers``.
"""

import argparse
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from .base import About, AbstractImporter, add_common_arguments, parse_epoch
from .columns import FileSpec, StreamSpec
from .csv_tables import import_csv
from .reports import FileReport, ImportReport, StreamReport

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

__all__ = [
    "About",
    "AbstractImporter",
    "FileReport",
    "FileSpec",
    "ImportReport",
    "StreamReport",
    "StreamSpec",
    "add_arguments",
    "import_csv",
    "importers",
    "run",
]


@cache
def importers() -> dict[str, type[AbstractImporter]]:
    """The formats by name: those of this room, and those of entry points.

    They are not in a `jaxeit.registry.Registry`, whose package takes a second to import.
    """
    shipped = {kind.name: kind for kind in AbstractImporter.__subclasses__() if kind.__module__.startswith(__name__)}
    return {point.name: point.load() for point in entry_points(group="calib.importers")} | shipped


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``jaxeit import``: the format, then those of the format."""
    formats = parser.add_subparsers(title="formats", dest="format", required=True, metavar="FORMAT")
    for name, kind in importers().items():
        one = formats.add_parser(name, help=kind.summary, description=kind.summary[0].upper() + kind.summary[1:] + ".")
        kind.add_arguments(one)
        add_common_arguments(one)


def run(args: argparse.Namespace, skin: "je.Skin | None" = None) -> int:
    """Import as parsed by `add_arguments`, ``skin`` being the one named; prints the report. Raises `SessionError`."""
    progress = partial(tqdm, desc="lines", unit="", disable=None, leave=False)
    about = About(args.title, args.license, parse_epoch(args.epoch), skin, progress)
    print(importers()[args.format].convert(args, Path(args.output), about).summary())
    return 0
