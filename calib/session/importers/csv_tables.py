"""Bring recordings made elsewhere into the session format: tables of numbers as text (CSV).

A file is described by which column is its clock and which columns form which stream::

    jaxeit import csv log.csv.gz --time 0:ms --stream pressure=5:bar --stream force=6:N -o s.h5
    jaxeit import csv states.csv --time 0:s --stream force=4:g --missing -1 \\
                      --from sensor.csv --time 0:s --stream sensor=1-15:counts -o s.h5

Columns are counted from zero or named as in the header, whose units need not be repeated: of ``time (ms),x [mm]``
the clock is ``--time time`` and the stage ``--stream stage=x``. ``1-15`` and ``0,3`` are several columns. Options apply
to the file named before them. ``--skin`` says on which skin the streams eit and pressure were recorded; without it they
cannot be calibrated. Nothing is resampled, filtered or filled in; what was left out or looks suspicious is counted in
the report.
"""

import argparse
import hashlib
import itertools
import os
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..errors import SessionError, printable, problem
from ..facts import SessionFacts, StreamFacts
from ..storage import file_hash
from ..units import KNOWN_UNITS, UNITS, VARIABLE_UNIT
from ..writer import SessionWriter
from .base import About, AbstractImporter
from .clocks import Clock, clock_of, common_start, nanoseconds
from .columns import FileSpec, StreamSpec, parse_stream, parse_time
from .reports import FileReport, ImportReport, StreamReport
from .sentinels import sentinel_warnings
from .tables import (
    FIRST_LINES,
    Dialect,
    Progress,
    Table,
    column_index,
    layout_of,
    lines_of,
    name_and_unit,
    read_table,
)

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

VARIABLE = {unit: name for name, unit in VARIABLE_UNIT.items()} | {"A": "current"}


@dataclass(frozen=True)
class _Loaded:
    """One file, read: its table, its clock, and which table columns and which unit each stream has."""

    spec: FileSpec
    table: Table
    clock: Clock
    places: dict[str, list[int]]
    units: dict[str, str]


def _load(spec: FileSpec, sort: bool, progress: Progress) -> _Loaded:
    """Read the columns that are asked for."""
    first = [line for _, line in itertools.islice(lines_of(spec.path), FIRST_LINES)]
    dialect = layout_of(spec.path, first)
    wanted = [column_index(spec.path, spec.time, dialect)]
    time_unit = spec.time_unit or _unit_of(spec.path, f"--time {printable(spec.time)}", wanted, dialect, "s")
    places, units = {}, {}
    for stream in spec.streams:
        indices = [column_index(spec.path, c, dialect) for c in stream.columns]
        places[stream.name] = list(range(len(wanted), len(wanted) + len(indices)))
        where = f"--stream {printable(stream.name)}"
        units[stream.name] = stream.unit or _unit_of(spec.path, where, indices, dialect)
        wanted += indices
    table = read_table(spec.path, dialect, wanted, progress)
    clock = clock_of(spec.path, table, spec.time, UNITS[time_unit], sort)
    return _Loaded(spec, table, clock, places, units)


def _unit_of(path: Path, where: str, indices: Sequence[int], dialect: Dialect, si: str = "") -> str:
    """The unit that the header names for these columns; `si`: what it must be a unit of."""
    heads = [dialect.header[i] for i in indices if i < len(dialect.header)]
    units = {name_and_unit(head)[1] for head in heads} or {""}
    unit = units.pop()
    if units or not unit or (si and UNITS[unit].si != si):
        said = ", ".join(map(repr, heads[:4])) or "there is none"
        what = f"no unit given, and the header does not say one for all its columns ({said})"
        raise problem(path, where, what, f"add it after a colon, one of: {KNOWN_UNITS}")
    return unit


def _write_stream(writer: SessionWriter, loaded: _Loaded, spec: StreamSpec, times: np.ndarray) -> StreamReport:
    """Convert, write and count one stream."""
    rows, places = loaded.clock.rows, loaded.places[spec.name]
    raw, bad = loaded.table.values[rows][:, places], loaded.table.bad[rows][:, places]
    if bad.all():
        where = f"columns {','.join(spec.columns)}"
        raise problem(loaded.spec.path, where, "hold no number", "check the column numbers")
    missing = np.isin(raw, loaded.spec.missing)
    said = loaded.units[spec.name]
    values, unit = np.where(missing, np.nan, raw), UNITS[said]
    variable = VARIABLE.get(unit.si, "value")
    rate = 1e9 / float(np.median(np.diff(times)))
    about: dict[str, Any] = {"units": unit.si, "channels": len(places), "rate_hz": rate}
    long_name = f"{spec.name}, columns {', '.join(spec.columns)} in {said}"
    transport = printable(loaded.spec.path.name)
    about |= {"long_name": long_name, "clock": "recorder", "transport": transport}
    writer.add_stream(spec.name, StreamFacts(variable, dtype="f8", **about))
    with np.errstate(over="ignore"):  # beyond what can be stored: the writer flags it as missing
        values_si = values * unit.factor + unit.offset
    writer.append(spec.name, times, values_si)
    return StreamReport(
        name=spec.name,
        variable=variable,
        unit=unit.si,
        rows=len(rows),
        channels=len(places),
        rate_hz=rate,
        declared_missing=int(missing.sum()),
        not_numbers=int(bad.sum()),
        first_not_number=_first_line(loaded.table.line[rows], bad),
        warnings=sentinel_warnings(spec.name, values),
    )


def _first_line(lines: np.ndarray, bad: np.ndarray) -> int | None:
    """The first line with a bad cell, or None."""
    return int(lines[np.any(bad, axis=1)].min()) if bad.any() else None


def _file_report(loaded: _Loaded, streams: Sequence[StreamReport]) -> FileReport:
    clock, line = loaded.clock, loaded.table.line
    return FileReport(
        path=loaded.spec.path,
        rows_read=len(line),
        rows_without_time=len(clock.without),
        first_without_time=int(line[clock.without[0]]) if len(clock.without) else None,
        equal_times=len(clock.equal),
        first_equal_time=int(line[clock.equal[0]]) if len(clock.equal) else None,
        rows_sorted=clock.sorted,
        streams=tuple(streams),
    )


def import_csv(
    files: Sequence[FileSpec],
    output: str | os.PathLike[str],
    *,
    title: str = "",
    epoch: datetime | None = None,
    sort: bool = False,
    license: str = "",
    skin: "je.Skin | None" = None,
    progress: Progress = iter,
) -> ImportReport:
    """Write the described columns of text files as one session file.

    ``epoch`` (with time zone) is when the clocks read zero; clocks that count from 1970 need none.
    ``sort`` allows rows that go back in time; ``skin`` is what the stream eit was recorded on, with one column for each
    reading in the order of its protocol, and the stream pressure, with one for each pad; ``progress`` wraps the
    iteration over lines, such as `tqdm.tqdm`. The same files and options give the same bytes.
    Raises `SessionError` for what cannot be read or understood, and then writes nothing.
    """
    _check_specs(files)
    about_skin = _described(files, skin)
    loaded = [_load(spec, sort, progress) for spec in files]
    start, zero, known = common_start([f.clock for f in loaded], epoch)
    name = title or "import of " + ", ".join(printable(f.path.name) for f in files)
    about: dict[str, Any] = {"title": name, "epoch": start, "license": license}
    about["session_id"] = _session_id(files, start)
    reports = []
    _check_columns(loaded, skin)
    with SessionWriter(output, SessionFacts(**about_skin, **about)) as writer:
        for one in loaded:
            times = nanoseconds(one.spec.path, one.clock, zero)
            streams = [_write_stream(writer, one, s, times) for s in one.spec.streams]
            reports.append(_file_report(one, streams))
    return ImportReport(Path(output), start, known, tuple(reports))


def _check_specs(files: Sequence[FileSpec]) -> None:
    if not files:
        raise SessionError("import: no file given; name one")
    names = [s.name for f in files for s in f.streams]
    for spec in files:
        if not spec.streams:
            raise problem(spec.path, "--stream", "none given", "write it as force=4:N")
    for name in names:
        if names.count(name) > 1:
            raise SessionError(f"--stream {printable(name)}: given twice; use one name per stream")


def _described(files: Sequence[FileSpec], skin: "je.Skin | None") -> dict[str, Any]:
    """What the session says of the skin it was recorded on."""
    if skin is None:
        return {"skin_name": "", "skin_toml": ""}
    if not any(s.name == "eit" for f in files for s in f.streams):
        raise SessionError("--skin: no stream is called eit; name the readings' columns, as --stream eit=1-550:V")
    protocol = skin.protocol
    scan = {"pattern": protocol.pattern, "current": float(protocol.current), "frequency": float(protocol.frequency)}
    return {"skin_name": skin.name, "skin_toml": skin.toml, **scan}


def _check_columns(loaded: Sequence[_Loaded], skin: "je.Skin | None") -> None:
    if skin is None:
        return
    wanted = {"eit": (len(skin.protocol.pattern), "readings a scan"), "pressure": (len(skin.pads), "pads")}
    for one in loaded:
        for name, places in one.places.items():
            count, what = wanted.get(name, (len(places), ""))
            if len(places) != count:
                said = f"{len(places)} columns; the skin {printable(skin.name)} has {count} {what}"
                raise problem(one.spec.path, f"--stream {printable(name)}", said, "name one column for each, in order")


def _session_id(files: Sequence[FileSpec], start: datetime) -> str:
    """A UUID that depends on the contents of the files and on the options, on nothing else."""
    digest = hashlib.sha256(start.isoformat().encode())
    for spec in files:
        digest.update(file_hash(spec.path).encode())
        digest.update(repr((spec.time, spec.time_unit, spec.streams, spec.missing)).encode())
    return str(uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest()))


# --- command line --------------------------------------------------------------------------------


@dataclass
class _Group:
    """One file and the options that follow it, as typed."""

    path: str = ""
    time: str = ""
    streams: list[str] = field(default_factory=list)
    missing: list[float] = field(default_factory=list)


class _Grouped(argparse.Action):
    """Put FILE, --time, --stream and --missing into the group of the file before them."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        groups = getattr(namespace, "groups", None) or [_Group()]
        if self.dest == "from_file":
            groups = [*groups, _Group(path=values)]
        elif self.dest == "file":
            groups[0].path = values
        elif self.dest == "time":
            groups[-1].time = values
        else:
            getattr(groups[-1], self.dest).append(values)
        namespace.groups = groups


class CsvImporter(AbstractImporter):
    """Tables of numbers as text."""

    name: ClassVar[str] = "csv"
    summary: ClassVar[str] = "tables of numbers as text, .gz allowed"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        grouped: dict[str, Any] = {"action": _Grouped, "default": argparse.SUPPRESS}
        parser.add_argument("file", metavar="FILE", help="table of numbers, .gz allowed", **grouped)
        text = "the clock's column and unit, as 0:ms; the unit may be left out where the header says it, as time (ms)"
        parser.add_argument("--time", metavar="COLUMN:UNIT", help=text, **grouped)
        text = "a stream, as force=4:N or sensor=1-15:counts; repeat for more"
        parser.add_argument("--stream", dest="streams", metavar="NAME=COLUMNS:UNIT", help=text, **grouped)
        text = "a number that means no reading, as -1; repeat for more"
        parser.add_argument("--missing", metavar="VALUE", type=float, help=text, **grouped)
        text = "a further file; the options after it are its own"
        parser.add_argument("--from", dest="from_file", metavar="FILE", help=text, **grouped)
        parser.add_argument("--sort", action="store_true", help="allow rows that go back in time")

    @classmethod
    def convert(cls, args: argparse.Namespace, output: Path, about: About) -> ImportReport:
        files = [_file_spec(group) for group in args.groups]
        return import_csv(files, output, sort=args.sort, **about._asdict())


def _file_spec(group: _Group) -> FileSpec:
    path = Path(group.path)
    if not group.time:
        raise problem(path, "--time", "missing", "say which column is the clock, as --time 0:ms")
    column, unit = parse_time(group.time)
    streams = tuple(parse_stream(text) for text in group.streams)
    return FileSpec(path, column, unit, streams, tuple(group.missing))
