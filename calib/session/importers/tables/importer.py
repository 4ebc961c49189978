"""The command line of all formats of tables: which columns of which files are clocks and streams.

A file is described by which column is its clock and which columns form which stream::

    jaxeit import csv log.csv.gz --time 0:ms --stream pressure=5:bar --stream force=6:N -o s.h5
    jaxeit import csv states.csv --time 0:s --stream force=4:g --missing -1 \\
                      --from sensor.csv --time 0:s --stream sensor=s0-s14:counts -o s.h5
    jaxeit import npz day1.npz day2.npz --rate 100 --gap 60 --stream force=f:N -o s.h5
"""

import argparse
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...errors import SessionError, problem
from ..base import AbstractImporter, StatedFacts
from ..reports import ImportReport
from .columns import FileSpec, parse_stream, parse_time
from .session import import_tables
from .table import AbstractTableFile

COLUMNS_HELP = """\
Columns are numbers counted from zero (5), ranges of numbers (1-15), header names (load), ranges of header names (s0-s3)
or several of these (1,4-6). The unit of a header such as "load (N)" need not be repeated. Several files of one layout
become one recording, in the order given. Options apply to the files named before them; --from begins a further group of
files with separate options. Nothing is resampled, filtered or filled in.
"""


@dataclass
class _Group:
    """Files and the options that follow them, as typed."""

    paths: list[str] = field(default_factory=list)
    time: str = ""
    rate: float | None = None
    start: float | None = None
    gap: float | None = None
    streams: list[str] = field(default_factory=list)
    missing: list[float] = field(default_factory=list)


class _Grouped(argparse.Action):
    """Put FILE and the options of a file into the group of the files before them."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        groups = getattr(namespace, "groups", None) or [_Group()]
        if self.dest == "from_files":
            groups = [*groups, _Group(paths=values)]
        elif self.dest == "files":
            groups[0].paths = values
        elif self.dest in ("streams", "missing"):
            getattr(groups[-1], self.dest).append(values)
        else:
            setattr(groups[-1], self.dest, values)
        namespace.groups = groups


class AbstractTableImporter(AbstractImporter):
    """A format whose files are tables. It defines how a file is opened; all other parts of an import are shared."""

    @classmethod
    @abstractmethod
    def opener(cls, args: argparse.Namespace) -> Callable[[Path], AbstractTableFile]:
        """The function that opens a file of this format; its errors are `SessionError`."""

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Add the arguments for files, clock, streams, and numbers that stand for missing readings."""
        grouped: dict[str, Any] = {"action": _Grouped, "default": argparse.SUPPRESS}
        parser.epilog = COLUMNS_HELP
        parser.add_argument(
            "files", nargs="+", metavar="FILE", help="files of one layout, in the order of recording", **grouped
        )
        text = "column and unit of the clock, such as 0:ms; no unit for dates and times, or if the header states it"
        parser.add_argument("--time", metavar="COLUMN:UNIT", help=text, **grouped)
        text = "rate of a table without a clock, in Hz; instead of --time"
        parser.add_argument("--rate", metavar="HZ", type=float, help=text, **grouped)
        text = "time of the first row of a table without a clock, in s; default 0"
        parser.add_argument("--start", metavar="SECONDS", type=float, help=text, **grouped)
        text = "pause between one file and the next, if each file has its own clock or none"
        parser.add_argument("--gap", metavar="SECONDS", type=float, help=text, **grouped)
        text = "a stream, such as force=4:N, sensor=1-15:counts or signal=s0-s3:V; repeat the option for more streams"
        parser.add_argument("--stream", dest="streams", metavar="NAME=COLUMNS:UNIT", help=text, **grouped)
        text = "a number that stands for a missing reading, such as -1; repeat the option for more numbers"
        parser.add_argument("--missing", metavar="VALUE", type=float, help=text, **grouped)
        text = "further files; the options that follow apply to these files"
        parser.add_argument("--from", dest="from_files", nargs="+", metavar="FILE", help=text, **grouped)
        parser.add_argument("--sort", action="store_true", help="allow rows that go back in time")

    @classmethod
    def convert(cls, args: argparse.Namespace, output: Path, about: StatedFacts) -> ImportReport:
        """See `AbstractImporter.convert`."""
        return import_tables(cls.opener(args), cls.file_specs(args), output, about, sort=args.sort)

    @classmethod
    def file_specs(cls, args: argparse.Namespace) -> Sequence[FileSpec]:
        """The description of each group of files, from the arguments."""
        return [_file_spec(group) for group in args.groups]


def _file_spec(group: _Group) -> FileSpec:
    path, following = Path(group.paths[0]), tuple(map(Path, group.paths[1:]))
    streams = tuple(parse_stream(text) for text in group.streams)
    if bool(group.time) == (group.rate is not None):
        what = "missing, and no --rate" if not group.time else "given together with --rate"
        raise problem(path, "--time", what, "say which column is the clock, as --time 0:ms, or the rate, as --rate 100")
    for option in ("rate", "start", "gap"):
        _check_number(option, getattr(group, option))
    if group.start is not None and group.rate is None:
        raise problem(path, "--start", "is for tables without a clock", "give it with --rate, or leave it out")
    column, unit = parse_time(group.time) if group.time else ("", "")
    missing, start = tuple(group.missing), group.start or 0.0
    return FileSpec(path, column, unit, streams, missing, following, group.rate, start, group.gap)


def _check_number(option: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and (value > 0 or option == "start")):
        wanted = "a finite number" if option == "start" else "a finite number above zero"
        raise SessionError(f"--{option} {value:g}: not usable; give {wanted}")
