"""Convert recordings in other formats to session files: one class per format.

A new format is one class derived from `AbstractImporter` in a module of `formats`, and its import in the ``__init__``
there; another package adds one by an entry point of the group ``calib.importers``, and users name a class of their own
by its import path, ``my_package.my_module:MyImporter``. A format of tables derives from
`AbstractTableImporter`, or from `AbstractArrayImporter` where a file holds named arrays: it then has the options of all
tables.

Example:
    from pathlib import Path

    import calib
    from calib.session import importers

    Path("bench.csv").write_text(
        "time,load,left,right\\n" + "".join(f"{k / 100},{k % 7},{3 * k},{k}\\n" for k in range(200))
    )
    streams = (
        importers.StreamSpec("force", ("load",), "N"),
        importers.StreamSpec("pressure", ("left", "right"), "Pa"),
    )
    table = importers.FileSpec(Path("bench.csv"), time="time", time_unit="s", streams=streams)
    report = importers.import_csv([table], "imported.h5", title="a bench of ours")
    print(report.summary())
    with calib.open_session("imported.h5") as session:
        print({name: stream.shape for name, stream in session.streams.items()})
    # formats: CsvImporter and so on
    print(list(importers.importers()), importers.find_importer("csv").summary)
"""

import argparse
import pkgutil
from collections.abc import Iterator, Sequence
from functools import cache, partial
from importlib.metadata import entry_points
from inspect import isabstract, isclass
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from ..errors import SessionError, printable
from .arrays import AbstractArrayImporter, ArrayShape
from .base import AbstractImporter, StatedFacts, add_common_arguments, parse_epoch
from .formats import (
    CsvFile,
    CsvImporter,
    Hdf5Importer,
    MatImporter,
    McapImporter,
    NpzImporter,
    ParquetImporter,
    import_csv,
)
from .reports import FileReport, ImportReport, StreamReport
from .tables.columns import FileSpec, StreamSpec
from .tables.importer import AbstractTableImporter
from .tables.session import import_tables
from .tables.table import AbstractTableFile, Table

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

__all__ = [
    "AbstractArrayImporter",
    "AbstractImporter",
    "AbstractTableFile",
    "AbstractTableImporter",
    "ArrayShape",
    "CsvFile",
    "CsvImporter",
    "FileReport",
    "FileSpec",
    "Hdf5Importer",
    "ImportReport",
    "MatImporter",
    "McapImporter",
    "NpzImporter",
    "ParquetImporter",
    "StatedFacts",
    "StreamReport",
    "StreamSpec",
    "Table",
    "add_arguments",
    "find_importer",
    "import_csv",
    "import_tables",
    "importers",
    "run",
]


@cache
def importers() -> dict[str, type[AbstractImporter]]:
    """The formats by name, of this room and of entry points.

    They are in no `jaxeit.registry.Registry`, because its package takes a second to import.
    """
    kinds = sorted(_formats(AbstractImporter), key=lambda kind: kind.name)
    shipped = {kind.name: kind for kind in kinds if kind.__module__.startswith(__name__)}
    return {point.name: point.load() for point in entry_points(group="calib.importers")} | shipped


def _formats(kind: type) -> Iterator[type[AbstractImporter]]:
    """The concrete formats among the subclasses of a class."""
    subclasses: Sequence[type[AbstractImporter]] = kind.__subclasses__()
    for one in subclasses:
        if not isabstract(one):
            yield one
        yield from _formats(one)


def find_importer(name: str) -> type[AbstractImporter]:
    """The format of a name, or of an import path as in ``my_package.my_module:MyImporter``.

    Raises:
        SessionError: for an import path that leads to no concrete format.

    Example:
        kinds = (
            importers.CsvImporter,
            importers.NpzImporter,
            importers.MatImporter,
            importers.Hdf5Importer,
            importers.ParquetImporter,
            importers.McapImporter,
        )
        for kind in kinds:
            print(f"{kind.name}: {kind.summary}", importers.find_importer(kind.name) is kind)
    """
    if name in importers():
        return importers()[name]
    try:
        kind = pkgutil.resolve_name(name)
    except (ModuleNotFoundError, AttributeError) as error:
        why = printable(error, 200)
        raise SessionError(f"import format {name!r} cannot be imported ({why}); check path and PYTHONPATH") from None
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        why = f"{type(error).__name__}: {printable(error, 200)}"
        raise SessionError(f"import format {name!r} cannot be imported ({why}); correct its module") from None
    if not (isclass(kind) and issubclass(kind, AbstractImporter)) or isabstract(kind):
        raise SessionError(f"import format {name!r} is not a concrete class derived from {AbstractImporter.__name__}")
    return kind


def add_arguments(parser: argparse.ArgumentParser, own: Sequence[str] = ()) -> None:
    """Add the arguments of ``jaxeit import``: the format, then the arguments of that format.

    Args:
        own: import paths of formats beside the known ones.

    Example:
        import argparse

        parser = argparse.ArgumentParser()
        importers.add_arguments(parser)  # those of `jaxeit import`
        words = ["csv", "bench.csv", "--time", "time:s", "--stream", "force=load:N", "-o", "again.h5"]
        importers.run(parser.parse_args(words))
    """
    formats = parser.add_subparsers(title="formats", dest="format", required=True, metavar="FORMAT")
    for name, kind in {**importers(), **{path: find_importer(path) for path in own}}.items():
        one = formats.add_parser(name, help=kind.summary, description=kind.summary[0].upper() + kind.summary[1:] + ".")
        kind.add_arguments(one)
        add_common_arguments(one)


def run(args: argparse.Namespace, skin: "je.Skin | None" = None) -> int:
    """Import as parsed by `add_arguments`, ``skin`` being the one named; prints the report. Raises `SessionError`."""
    progress = partial(tqdm, desc="lines", unit="", disable=None, leave=False)
    about = StatedFacts(args.title, args.license, parse_epoch(args.epoch), skin, progress)
    summary = find_importer(args.format).convert(args, Path(args.output), about).summary()
    print("\n".join(printable(line, 1000) for line in summary.splitlines()))
    return 0
