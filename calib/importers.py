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
import gzip
import hashlib
import itertools
import math
import os
import re
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from tqdm import tqdm

from calib.session import SessionError, SessionWriter
from calib.session.model import printable, problem
from calib.session.storage import file_hash
from calib.session.units import KNOWN_UNITS, UNITS, VARIABLE_UNIT, Unit

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

Progress = Callable[[Iterable], Iterable]

SENTINELS = (-1.0, -99.0, -999.0, -9999.0, 999.0, 9999.0, 99999.0)
"""Numbers that recorders write where they have no reading."""
SENTINEL_SHARE = 0.05
UNIX_TIME_FROM = 1e8
"""A clock beyond this many seconds (1973) counts from 1970; below, from an unknown start."""
MAX_LINE = 1 << 20
BLOCK_LINES = 1 << 15
LAYOUTS = (
    (",", False),
    ("\t", False),
    (";", False),
    (None, False),
    ("\t", True),
    (";", True),
    (None, True),
)
"""Delimiter (None is white space) and whether a comma is the decimal point; likelier ones first."""
VARIABLE = {unit: name for name, unit in VARIABLE_UNIT.items()} | {"A": "current"}


@dataclass(frozen=True)
class StreamSpec:
    """A stream to make: its name, its columns (numbers or header names), their unit (empty: the header says)."""

    name: str
    columns: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class FileSpec:
    """A file to read: the clock's column and unit (empty: the header says), streams, numbers that mean missing."""

    path: Path
    time: str
    time_unit: str
    streams: tuple[StreamSpec, ...]
    missing: tuple[float, ...] = ()


@dataclass(frozen=True)
class StreamReport:
    """What became of one stream; counts are of values, over all its channels."""

    name: str
    variable: str
    unit: str
    rows: int
    channels: int
    rate_hz: float
    declared_missing: int
    not_numbers: int
    first_not_number: int | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class FileReport:
    """What became of one file; ``first_*`` are line numbers counted from 1."""

    path: Path
    rows_read: int
    rows_without_time: int
    first_without_time: int | None
    equal_times: int
    first_equal_time: int | None
    rows_sorted: int
    streams: tuple[StreamReport, ...]


@dataclass(frozen=True)
class ImportReport:
    """What an import read, left out and found suspicious."""

    output: Path
    epoch: datetime
    epoch_known: bool
    files: tuple[FileReport, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Lines a person should act on."""
        found = [w for f in self.files for s in f.streams for w in s.warnings]
        if not self.epoch_known:
            found.append("the clock does not say when the recording began; give --epoch if known")
        return tuple(found)

    def summary(self) -> str:
        """The report as text, one line per stream, loss and warning."""
        lines = [line for f in self.files for line in _file_lines(f)]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join([*lines, f"wrote {self.output}"])


def _file_lines(report: FileReport) -> Iterator[str]:
    yield f"{report.path.name}: {report.rows_read:,} rows"
    if report.rows_without_time:
        first = report.first_without_time
        yield f"  {report.rows_without_time:,} rows without a time left out (first: line {first})"
    if report.equal_times:
        first = report.first_equal_time
        yield f"  {report.equal_times:,} rows with a repeated time left out (first: line {first})"
    if report.rows_sorted:
        yield f"  {report.rows_sorted:,} rows went back in time and were sorted"
    for s in report.streams:
        shape = f"{s.rows:,} x {s.channels}"
        yield f"  {s.name}: {s.variable} in {s.unit}, {shape}, about {s.rate_hz:.4g} Hz"
        if s.declared_missing:
            yield f"    {s.declared_missing:,} values declared missing"
        if s.not_numbers:
            yield f"    {s.not_numbers:,} cells are not numbers (first: line {s.first_not_number})"


# --- specifications ------------------------------------------------------------------------------


def parse_time(text: str) -> tuple[str, str]:
    """``COLUMN:UNIT`` of the clock, as ``0:ms``; ``COLUMN`` where the header says the unit. Raises `SessionError`."""
    column, unit = _column_and_unit(text)
    if not column or (unit and UNITS.get(unit, UNITS["m"]).si != "s"):
        raise SessionError(f"--time {printable(text)}: not COLUMN:UNIT; write it as 0:ms (s, us, ns)")
    return column.strip(), unit


def _column_and_unit(text: str) -> tuple[str, str]:
    """What stands before and after the last colon; without one there is no unit."""
    column, colon, unit = text.rpartition(":")
    return (column, unit.strip() or "?") if colon else (text, "")


def parse_stream(text: str) -> StreamSpec:
    """``NAME=COLUMNS:UNIT``, as ``force=4:g`` or ``sensor=1-15:counts``.

    Without a unit, ``NAME=COLUMNS``, the header must say it. Raises `SessionError`.
    """
    name, equals, rest = text.partition("=")
    columns, unit = _column_and_unit(rest)
    where = f"--stream {printable(text)}"
    if not (equals and name and columns) or unit == "?":
        raise SessionError(f"{where}: not NAME=COLUMNS:UNIT; write it as force=4:N")
    if unit and unit not in UNITS:
        raise SessionError(f"{where}: unit {printable(unit)!r} not known; use one of: {KNOWN_UNITS}")
    parts = tuple(itertools.chain(*(_column_range(c.strip()) for c in columns.split(","))))
    return StreamSpec(name, parts, unit)


def _column_range(text: str) -> list[str]:
    """``3`` -> 3; ``1-15`` -> 1..15; anything else is a header name."""
    first, dash, last = text.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal()):
        return [text]
    low, high = int(first), int(last)
    if low > high or high - low > 100_000:
        raise SessionError(f"columns {text}: not a range; write it as 1-15")
    return [str(i) for i in range(low, high + 1)]


# --- the table -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Dialect:
    """How a text file is laid out: delimiter (None is white space), header names, columns."""

    delimiter: str | None
    decimal_comma: bool
    header: tuple[str, ...] = ()
    columns: int = 0

    def plain(self, line: str) -> str:
        """The line with decimal points."""
        return line.replace(",", ".") if self.decimal_comma else line

    def cells(self, line: str) -> list[str]:
        """The cells of a line, stripped."""
        return [cell.strip().strip('"') for cell in line.split(self.delimiter)]


@dataclass
class _Table:
    """Selected columns of a file: ``values`` (rows, columns) NaN where a cell is no number."""

    values: np.ndarray
    line: np.ndarray
    bad: np.ndarray = field(repr=False)


def _open_text(path: Path) -> TextIO:
    try:
        with path.open("rb") as stream:
            packed = stream.read(2) == b"\x1f\x8b"
        opener: Any = gzip.open if packed else open
        return opener(path, "rt", encoding="utf-8-sig", errors="replace", newline=None)
    except FileNotFoundError:
        raise problem(path, "file", "does not exist", "check the name and the folder") from None
    except IsADirectoryError:
        raise problem(path, "file", "is a folder", "name the file in it") from None
    except OSError as error:
        raise problem(path, "file", f"cannot be read ({error.strerror})", "check access") from error


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1 and lines that are neither blank nor comments."""
    with _open_text(path) as stream:
        number = 0
        try:
            while line := stream.readline(MAX_LINE):
                number += 1
                if len(line) >= MAX_LINE or "\0" in line:
                    raise problem(path, f"line {number}", "is not text", "give a CSV file")
                if line.strip() and not line.startswith("#"):
                    yield number, line.rstrip("\r\n")
        except (EOFError, gzip.BadGzipFile, OSError) as error:
            what = f"the gzip file is damaged ({error})"
            raise problem(path, f"line {number + 1}", what, "take another copy") from error


def _number(cell: str) -> float:
    """The number in a cell; NaN if there is none (an infinite one counts as none)."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


def _sniff(path: Path, first: list[str]) -> _Dialect:
    """The layout under which most cells of the first lines are numbers."""
    if not first:
        raise problem(path, "file", "holds no rows", "give a table of numbers")
    best = max(LAYOUTS, key=lambda layout: _numbers_found(first, _Dialect(*layout)))
    dialect = _Dialect(*best)
    widths = [len(dialect.cells(line)) for line in first]
    columns = max(widths, key=widths.count)
    head = dialect.cells(first[0])
    named = any(head) and all(math.isnan(_number(cell)) for cell in head)
    return _Dialect(*best, tuple(head) if named else (), columns)


def _numbers_found(lines: list[str], dialect: _Dialect) -> int:
    cells = itertools.chain(*(dialect.cells(dialect.plain(line)) for line in lines))
    return sum(not math.isnan(_number(cell)) for cell in cells)


_NAME_AND_UNIT = re.compile(r"(.*?)\s*(?:[(\[]\s*(.*?)\s*[)\]]|[/_,]\s*(\w+))")


def _name_and_unit(head: str) -> tuple[str, str]:
    """``load (N)``, ``load [N]``, ``load/N``, ``load_N`` -> load and N; the whole name where no known unit ends it."""
    found = _NAME_AND_UNIT.fullmatch(head)
    unit = (found[2] or found[3]) if found else ""
    return (found[1], unit) if found and unit in UNITS else (head, "")


def _index(path: Path, column: str, dialect: _Dialect) -> int:
    """A column's index from its number or its header name, the unit and the case of which may be left out."""
    if column in dialect.header:
        return dialect.header.index(column)
    bare = [_name_and_unit(head)[0].lower() for head in dialect.header]
    if bare.count(column.lower()) == 1:
        return bare.index(column.lower())
    if column.isdecimal():
        if int(column) < dialect.columns:
            return int(column)
        what = f"not there; the file has columns 0 to {dialect.columns - 1}"
        raise problem(path, f"column {column}", what, "count columns from zero")
    what = f"not there; header names: {', '.join(dialect.header) or 'none, it has no header'}"
    raise problem(path, f"column {column!r}", what, "use one of them, or count from zero")


def _read_table(path: Path, dialect: _Dialect, columns: Sequence[int], progress: Progress) -> _Table:
    """The given columns of every row."""
    lines = iter(progress(itertools.islice(_lines(path), 1 if dialect.header else 0, None)))
    values, numbers, bad = [np.empty((0, len(columns)))], [np.empty(0, np.int64)], []
    bad.append(np.empty((0, len(columns)), bool))
    while block := list(itertools.islice(lines, BLOCK_LINES)):
        texts = [dialect.plain(text) for _, text in block]
        cells, wrong = _parse_block(texts, dialect, columns)
        values.append(cells)
        bad.append(wrong)
        numbers.append(np.array([n for n, _ in block], np.int64))
    return _Table(np.concatenate(values), np.concatenate(numbers), np.concatenate(bad))


def _parse_block(lines: list[str], dialect: _Dialect, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (rows, columns), and where a cell held none."""
    try:
        options: dict[str, Any] = {"delimiter": dialect.delimiter, "usecols": columns}
        values = np.loadtxt(lines, ndmin=2, comments=None, **options)
    except (ValueError, IndexError):
        values = np.array([_row(dialect.cells(line), columns) for line in lines])
    values = values.reshape(len(lines), len(columns))
    bad = ~np.isfinite(values)
    return np.where(bad, np.nan, values), bad


def _row(cells: list[str], columns: Sequence[int]) -> list[float]:
    return [_number(cells[c]) if c < len(cells) else math.nan for c in columns]


# --- times ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Clock:
    """Rows that are kept, in order, their times in s, and what was left out."""

    rows: np.ndarray
    seconds: np.ndarray
    without: np.ndarray
    equal: np.ndarray
    sorted: int


def _clock(path: Path, table: _Table, column: str, unit: Unit, sort: bool) -> _Clock:
    """Strictly increasing times; repeated ones are left out, backward ones refused or sorted."""
    seconds = table.values[:, 0] * unit.factor
    rows = np.flatnonzero(np.isfinite(seconds))
    without = np.flatnonzero(~np.isfinite(seconds))
    back = np.flatnonzero(np.diff(seconds[rows]) < 0) + 1
    if len(back) and not sort:
        line = table.line[rows[back[0]]]
        what = f"time goes back at {len(back):,} rows, first at line {line}"
        raise problem(path, f"column {column}", what, "check the clock's column, or give --sort")
    if len(back):
        rows = rows[np.argsort(seconds[rows], kind="stable")]
    repeat = np.flatnonzero(np.diff(seconds[rows]) == 0) + 1
    kept = np.delete(rows, repeat)
    if len(kept) < 2 or len(without) > len(seconds) // 2:
        what = f"only {len(kept):,} of {len(seconds):,} rows have a time of their own"
        raise problem(path, f"column {column}", what, "check the clock's column, and the file")
    return _Clock(kept, seconds[kept], without, np.sort(rows[repeat]), len(back))


def _start(clocks: Sequence[_Clock], epoch: datetime | None) -> tuple[datetime, float, bool]:
    """The epoch, the clock reading in s that belongs to it, and whether it is known."""
    first = min(float(c.seconds[0]) for c in clocks)
    if first >= UNIX_TIME_FROM:
        whole = math.floor(first)
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=whole), float(whole), True
    if epoch is not None:
        return epoch, 0.0, True
    return datetime(1970, 1, 1, tzinfo=UTC), 0.0, False


def _nanoseconds(path: Path, clock: _Clock, zero: float) -> np.ndarray:
    times = np.rint((clock.seconds - zero) * 1e9)
    if np.abs(times).max() >= 2.0**62 or (np.diff(times) <= 0).any():
        raise problem(path, "clock", "cannot be kept in nanoseconds", "check the unit of --time")
    return times.astype(np.int64)


# --- streams -------------------------------------------------------------------------------------


def sentinel_warnings(name: str, values: np.ndarray) -> tuple[str, ...]:
    """Lines about numbers that look like "no reading" in ``values`` (rows, channels)."""
    found = []
    for channel, column in enumerate(values.T):
        label = name if values.shape[1] == 1 else f"{name}[{channel}]"
        finite = column[np.isfinite(column)]
        for value in SENTINELS:
            count = int((finite == value).sum())
            if count > SENTINEL_SHARE * len(finite) and _out_of_line(finite, value):
                number = f"{value:g}"
                what = f"{count:,} of {len(column):,} rows of {label} are exactly {number}"
                found.append(f"{what}: missing? give --missing {number}")
    return tuple(found)


def _out_of_line(column: np.ndarray, value: float) -> bool:
    """Whether `value` lies outside the other numbers, or is reached by jumps they do not make."""
    hit = column == value
    others = column[~hit]
    if len(others) < 2:
        return True
    if value < others.min() or value > others.max():
        return True
    into = np.abs(np.diff(column))[hit[1:] & ~hit[:-1]]
    usual = np.median(np.abs(np.diff(others)))
    return bool(len(into) and np.median(into) > 10 * usual)


@dataclass(frozen=True)
class _Loaded:
    """One file, read: its table, its clock, and which table columns and which unit each stream has."""

    spec: FileSpec
    table: _Table
    clock: _Clock
    places: dict[str, list[int]]
    units: dict[str, str]


def _load(spec: FileSpec, sort: bool, progress: Progress) -> _Loaded:
    """Read the columns that are asked for."""
    first = [line for _, line in itertools.islice(_lines(spec.path), 20)]
    dialect = _sniff(spec.path, first)
    wanted = [_index(spec.path, spec.time, dialect)]
    time_unit = spec.time_unit or _unit_of(spec.path, f"--time {printable(spec.time)}", wanted, dialect, "s")
    places, units = {}, {}
    for stream in spec.streams:
        indices = [_index(spec.path, c, dialect) for c in stream.columns]
        places[stream.name] = list(range(len(wanted), len(wanted) + len(indices)))
        where = f"--stream {printable(stream.name)}"
        units[stream.name] = stream.unit or _unit_of(spec.path, where, indices, dialect)
        wanted += indices
    table = _read_table(spec.path, dialect, wanted, progress)
    clock = _clock(spec.path, table, spec.time, UNITS[time_unit], sort)
    return _Loaded(spec, table, clock, places, units)


def _unit_of(path: Path, where: str, indices: Sequence[int], dialect: _Dialect, si: str = "") -> str:
    """The unit that the header names for these columns; `si`: what it must be a unit of."""
    heads = [dialect.header[i] for i in indices if i < len(dialect.header)]
    units = {_name_and_unit(head)[1] for head in heads} or {""}
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
    writer.add_stream(spec.name, variable, dtype="f8", **about)
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
    start, zero, known = _start([f.clock for f in loaded], epoch)
    name = title or "import of " + ", ".join(printable(f.path.name) for f in files)
    about: dict[str, Any] = {"title": name, "epoch": start, "license": license}
    about["session_id"] = _session_id(files, start)
    reports = []
    _check_columns(loaded, skin)
    with SessionWriter(output, **about_skin, **about) as writer:
        for one in loaded:
            times = _nanoseconds(one.spec.path, one.clock, zero)
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``jaxeit import``."""
    grouped: dict[str, Any] = {"action": _Grouped, "default": argparse.SUPPRESS}
    parser.add_argument("format", choices=["csv"], help="kind of file")
    parser.add_argument("file", metavar="FILE", help="table of numbers, .gz allowed", **grouped)
    text = "the clock's column and unit, as 0:ms; the unit may be left out where the header says it, as time (ms)"
    parser.add_argument("--time", metavar="COLUMN:UNIT", help=text, **grouped)
    text = "a stream, as force=4:N or sensor=1-15:counts; repeat for more"
    parser.add_argument("--stream", dest="streams", metavar="NAME=COLUMNS:UNIT", help=text, **grouped)
    text = "a number that means no reading, as -1; repeat for more"
    parser.add_argument("--missing", metavar="VALUE", type=float, help=text, **grouped)
    text = "a further file; the options after it are its own"
    parser.add_argument("--from", dest="from_file", metavar="FILE", help=text, **grouped)
    parser.add_argument("-o", "--output", required=True, metavar="SESSION", help="file to write")
    parser.add_argument("--title", default="", help="what was recorded")
    parser.add_argument("--license", default="", help="licence of the recording")
    text = "what eit and pressure were recorded on: a shipped skin or a TOML file, in the order of its protocol"
    parser.add_argument("--skin", help=text)
    parser.add_argument("--epoch", help="ISO time when the clock read zero, with zone")
    parser.add_argument("--sort", action="store_true", help="allow rows that go back in time")


def run(args: argparse.Namespace, skin: "je.Skin | None" = None) -> int:
    """Import as parsed by `add_arguments`, `skin` being the one named; prints the report. Raises `SessionError`."""
    files = [_file_spec(group) for group in args.groups]
    options: dict[str, Any] = {"title": args.title, "license": args.license, "sort": args.sort, "skin": skin}
    options["progress"] = partial(tqdm, desc="lines", unit="", disable=None, leave=False)
    report = import_csv(files, args.output, epoch=_epoch(args.epoch), **options)
    print(report.summary())
    return 0


def _file_spec(group: _Group) -> FileSpec:
    path = Path(group.path)
    if not group.time:
        raise problem(path, "--time", "missing", "say which column is the clock, as --time 0:ms")
    column, unit = parse_time(group.time)
    streams = tuple(parse_stream(text) for text in group.streams)
    return FileSpec(path, column, unit, streams, tuple(group.missing))


def _epoch(text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise SessionError(f"--epoch {printable(text)}: not a time; write it as 2025-01-31T12:00:00Z")
    return moment
