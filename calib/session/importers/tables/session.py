"""Convert tables to a session: the part of an import that all formats of tables share.

Columns are chosen, clocks are laid on one time line, units are converted to SI. Nothing is resampled, filtered or
filled in; what is left out or looks suspicious is counted in the report.
"""

import hashlib
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import SessionError, printable, problem
from ...facts import SessionFacts, StreamFacts
from ...outputs import IMPORT, file_hash, require_no_input, require_no_session
from ...tables import Status
from ...units import KNOWN_UNITS, UNITS, VARIABLE_UNIT, wrong_quantity
from ...writer import SessionWriter, program
from ..base import StatedFacts
from ..limits import MAX_COLUMNS
from ..reports import FileReport, ImportReport, StreamReport
from .clocks import Clock, clock_of, clock_of_rate, common_start, join_clocks, nanoseconds
from .columns import FileSpec, StreamSpec, name_and_unit
from .sentinels import sentinel_warnings
from .table import AbstractTableFile, Table
from .unused_clocks import clock_notes

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

VARIABLE = {unit: name for name, unit in VARIABLE_UNIT.items()} | {"A": "current"}
BLOCK_CELLS = 1 << 20


@dataclass(frozen=True)
class _Part:
    """One file as read: its table, its clock, and which table columns and which unit each stream has."""

    path: Path
    table: Table
    clock: Clock
    places: dict[str, list[int]]
    units: dict[str, str]
    counted: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Loaded:
    """Files that follow each other, and the options they have in common."""

    spec: FileSpec
    parts: tuple[_Part, ...]

    def channels(self, stream: str) -> int:
        return len(self.parts[0].places[stream])


def import_tables(
    open_table: Callable[[Path], AbstractTableFile],
    files: Sequence[FileSpec],
    output: str | os.PathLike[str],
    about: StatedFacts,
    *,
    sort: bool = False,
) -> ImportReport:
    """Write the described columns of files as one session file.

    Args:
        open_table: opens a file of the format.
        files: descriptions of the files and of the columns to import.
        output: the session file.
        about: facts that the user states about the recording. ``about.skin`` is the recorded skin: the stream eit has
            one column for each reading in the order of its protocol, and the stream pressure one for each pad.
        sort: allow rows that go back in time.

    The same files and options give the same bytes. An imported session at ``output`` is replaced. Raises
    `SessionError` for what cannot be read or understood and for a recording or an input at ``output``, and then writes
    nothing.

    Example:
        streams = (importers.StreamSpec("force", ("load",), "N"),)
        table = importers.FileSpec(Path("bench.csv"), time="time", time_unit="s", streams=streams)
        about = importers.StatedFacts(title="a bench of ours", license="CC0-1.0")
        report = importers.import_tables(importers.CsvFile, [table], "by_hand.h5", about)  # or your own
    """
    require_no_session(Path(output), simulated_too=False, imported_too=False)
    require_no_input(Path(output), (path for spec in files for path in spec.paths))
    _check_specs(files)
    about_skin = _described(files, about.skin)
    loaded: list[_Loaded] = []
    for spec in files:
        loaded.append(_load(open_table, spec, sort, about, _cells(loaded)))
    start, zero, known = common_start([one.parts[0].clock for one in loaded], about.epoch)
    _check_columns(loaded, about.skin)
    name = about.title or "import of " + ", ".join(printable(path.name) for f in files for path in f.paths)
    facts: dict[str, Any] = {"title": name, "epoch": start, "license": about.license}
    facts["creator"] = f"{program()} {IMPORT}"
    facts["session_id"] = _session_id(files, start.isoformat())
    reports: list[FileReport] = []
    with SessionWriter(output, SessionFacts(**about_skin, **facts)) as writer:
        for one in loaded:
            streams = [_write_stream(writer, one, stream, zero) for stream in one.spec.streams]
            reports += [_file_report(part, ()) for part in one.parts[:-1]]
            reports.append(_file_report(one.parts[-1], streams))
    notes = tuple(note for one in loaded for part in one.parts for note in part.notes)
    return ImportReport(Path(output), start, known, tuple(reports), notes)


# --- reading -------------------------------------------------------------------------------------


def _cells(loaded: Sequence[_Loaded]) -> int:
    return sum(part.table.values.size for one in loaded for part in one.parts)


def _load(
    open_table: Callable[[Path], AbstractTableFile], spec: FileSpec, sort: bool, about: StatedFacts, used: int
) -> _Loaded:
    """Read the columns that are asked for, from all files of a description."""
    parts: list[_Part] = []
    for path in spec.paths:
        parts.append(_load_part(open_table(path), spec, sort, about, used))
        used += parts[-1].table.values.size
        _check_same_columns(parts[0], parts[-1])
    clocks = join_clocks(spec.paths, [part.clock for part in parts], spec.gap)
    return _Loaded(spec, tuple(replace(part, clock=clock) for part, clock in zip(parts, clocks, strict=True)))


def _load_part(file: AbstractTableFile, spec: FileSpec, sort: bool, about: StatedFacts, used: int) -> _Part:
    path, wanted, places, units, notes = file.path, [], {}, {}, list[str]()
    if spec.rate_hz is None:
        wanted = file.indices(spec.time)
        if len(wanted) > 1:
            raise problem(path, f"--time {printable(spec.time)}", f"names {len(wanted)} columns", "name one")
        time_unit = _clock_unit(file, spec, wanted, notes)
    for stream in spec.streams:
        found = [i for text in stream.columns for i in file.indices(text)]
        places[stream.name] = list(range(len(wanted), len(wanted) + len(found)))
        where = f"--stream {printable(stream.name)}"
        if any(column in file.dates for column in found):
            raise problem(path, where, "names a column of dates and times", "name it with --time, or leave it out")
        units[stream.name] = stream.unit or _unit_of(path, where, found, file.header)
        if wrong := wrong_quantity(stream.name, UNITS[units[stream.name]].si):
            raise problem(path, where, wrong, "correct the unit, or give the stream another name")
        notes += _contradictions(path, where, units[stream.name], found, file.header)
        wanted = [*wanted, *found]
    if len(wanted) > MAX_COLUMNS:
        raise problem(path, "--stream", f"{len(wanted):,} columns are too many", "name fewer")
    table = file.read(wanted, used, about.progress)
    if spec.rate_hz is not None:
        notes += clock_notes(file, spec, wanted, about.progress)
    if spec.rate_hz is None:
        clock = clock_of(path, table, spec.time, UNITS[time_unit], sort, file.counted)
    else:
        clock = clock_of_rate(path, len(table.line), spec.rate_hz, spec.start)
    return _Part(path, table, clock, places, units, file.counted, tuple(notes))


def _clock_unit(file: AbstractTableFile, spec: FileSpec, wanted: Sequence[int], notes: list[str]) -> str:
    """The unit of the clock: the stated one, or that of the header; dates and times are read as s since 1970."""
    path, where = file.path, f"--time {printable(spec.time)}"
    if wanted[0] not in file.dates:
        unit = spec.time_unit or _unit_of(path, where, wanted, file.header, "s")
        notes += _contradictions(path, where, unit, wanted, file.header)
        return unit
    if spec.time_unit:
        what = "the column holds dates and times, which have no unit"
        raise problem(path, where, what, f"leave out :{spec.time_unit}")
    if not file.dates[wanted[0]]:
        notes.append(f"{printable(path.name)}: {where}: the times state no time zone and are read as UTC")
    return "s"


def _contradictions(path: Path, where: str, unit: str, indices: Sequence[int], header: Sequence[str]) -> Iterator[str]:
    """A note if a header states another unit: mN where N was given, or, in brackets, that of another quantity."""
    for head in (header[i] for i in indices if i < len(header)):
        said = name_and_unit(head)[1]
        known, given = UNITS.get(said), UNITS[unit]
        if known is None or "1" in (known.si, given.si) or known == given:
            continue
        if known.si == given.si or head.rstrip().endswith((")", "]")):  # x_m may be the name of a channel
            yield f"{printable(path.name)}: {where}: read in {unit}, but the header says {said} ({printable(head)!r})"
            return


def _unit_of(path: Path, where: str, indices: Sequence[int], header: Sequence[str], si: str = "") -> str:
    """The unit that the header names for these columns; `si`: what it must be a unit of."""
    heads = [header[i] for i in indices if i < len(header)]
    units = {name_and_unit(head)[1] for head in heads} or {""}
    unit = units.pop()
    if units or not unit or (si and UNITS[unit].si != si):
        said = ", ".join(map(repr, heads[:4])) or "there is none"
        what = f"no unit given, and the header does not say one for all its columns ({said})"
        raise problem(path, where, what, f"add it after a colon, one of: {KNOWN_UNITS}")
    return unit


# --- checks --------------------------------------------------------------------------------------


def _check_specs(files: Sequence[FileSpec]) -> None:
    if not files:
        raise SessionError("import: no file given; name one")
    names = [s.name for f in files for s in f.streams]
    for spec in files:
        if not spec.streams:
            raise problem(spec.path, "--stream", "none given", "write it as force=4:N")
        if spec.rate_hz is not None and spec.following and spec.gap is None:
            what = "tables without a clock do not say how long the pause between them was"
            raise problem(spec.following[0], "--gap", what, "give --gap SECONDS")
    for name in names:
        if names.count(name) > 1:
            raise SessionError(f"--stream {printable(name)}: given twice; use one name per stream")


def _check_same_columns(first: _Part, part: _Part) -> None:
    for name, places in part.places.items():
        if len(places) != len(first.places[name]) or part.units[name] != first.units[name]:
            what = f"{len(places)} columns in {part.units[name]}; {first.path.name} has {len(first.places[name])} in "
            todo = "give files of one layout together, others after --from"
            raise problem(part.path, f"--stream {printable(name)}", what + first.units[name], todo)


def _described(files: Sequence[FileSpec], skin: "je.Skin | None") -> dict[str, Any]:
    """Facts of the session about the skin that was recorded."""
    if skin is None:
        return {"skin_name": "", "skin_toml": ""}
    if not any(s.name == "eit" for f in files for s in f.streams):
        columns = f"1-{skin.protocol.readings}"
        raise SessionError(f"--skin: no stream is called eit; name the readings' columns, as --stream eit={columns}:V")
    protocol = skin.protocol
    scan = {
        "pattern": protocol.pattern,
        "mixing": protocol.mixing,
        "current": float(protocol.current),
        "frequency": float(protocol.frequency),
    }
    return {"skin_name": skin.name, "skin_toml": skin.toml, **scan}


def _check_columns(loaded: Sequence[_Loaded], skin: "je.Skin | None") -> None:
    if skin is None:
        return
    wanted = {"eit": (skin.protocol.readings, "readings a scan"), "pressure": (len(skin.pads), "pads")}
    for one in loaded:
        for stream in one.spec.streams:
            there = one.channels(stream.name)
            count, what = wanted.get(stream.name, (there, ""))
            if there != count:
                said = f"{there} columns; the skin {printable(skin.name)} has {count} {what}"
                where = f"--stream {printable(stream.name)}"
                raise problem(one.spec.path, where, said, "name one column for each, in order")


def _session_id(files: Sequence[FileSpec], start: str) -> str:
    """A UUID that depends only on the contents of the files and on the options."""
    digest = hashlib.sha256(start.encode())
    for spec in files:
        inner = [file for path in spec.paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]
        for file in inner:
            digest.update(file_hash(file).encode() if file.is_file() else b"")
        options = (spec.time, spec.time_unit, spec.streams, spec.missing, spec.rate_hz, spec.start, spec.gap)
        digest.update(repr(options).encode())
    return str(uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest()))


# --- writing -------------------------------------------------------------------------------------


def _write_stream(writer: SessionWriter, loaded: _Loaded, spec: StreamSpec, zero: float) -> StreamReport:
    """Convert, write and count one stream."""
    times = [nanoseconds(part.path, part.clock, zero) for part in loaded.parts]
    values = np.concatenate([part.table.values[part.clock.rows][:, part.places[spec.name]] for part in loaded.parts])
    bad = [part.table.bad[part.clock.rows][:, part.places[spec.name]] for part in loaded.parts]
    not_numbers = sum(int(b.sum()) for b in bad)
    if not_numbers == values.size:
        raise problem(loaded.spec.path, f"columns {','.join(spec.columns)}", "hold no number", "check the columns")
    missing = np.isin(values, loaded.spec.missing)
    values[missing] = np.nan
    said = loaded.parts[0].units[spec.name]
    time = np.concatenate(times)
    rate = 1e9 / float(np.median(np.diff(time)))
    facts = _stream_facts(loaded, spec, said, rate)
    writer.add_stream(spec.name, facts)
    starts = np.cumsum([len(t) for t in times])[:-1]
    _append(writer, spec.name, time, values, said, starts)
    lines = [_first_bad(part, b) for part, b in zip(loaded.parts, bad, strict=True) if b.any()]
    return StreamReport(
        name=spec.name,
        variable=facts.variable,
        unit=facts.units,
        rows=len(time),
        channels=facts.channels,
        rate_hz=rate,
        declared_missing=int(missing.sum()),
        not_numbers=not_numbers,
        first_not_number=lines[0] if lines else None,
        warnings=sentinel_warnings(spec.name, values),
    )


def _stream_facts(loaded: _Loaded, spec: StreamSpec, unit: str, rate: float) -> StreamFacts:
    si = UNITS[unit].si
    return StreamFacts(
        VARIABLE.get(si, "value"),
        units=si,
        channels=loaded.channels(spec.name),
        rate_hz=rate,
        dtype="f8",
        long_name=printable(f"{spec.name}, columns {', '.join(spec.columns)} in {unit}", 4096),
        clock="recorder",
        transport=printable(", ".join(path.name for path in loaded.spec.paths)),
    )


def _append(
    writer: SessionWriter, name: str, time: np.ndarray, values: np.ndarray, unit: str, starts: np.ndarray
) -> None:
    """Write rows in blocks, in SI; the rows ``starts`` begin a further file and are flagged as after a gap."""
    factor, offset = UNITS[unit].factor, UNITS[unit].offset
    status = np.zeros(len(time), "u2")
    status[starts] = Status.gap_before
    step = max(1, BLOCK_CELLS // values.shape[1])
    for at in range(0, len(time), step):
        rows = slice(at, at + step)
        with np.errstate(over="ignore"):  # beyond what can be stored: the writer flags it as missing
            values_si = values[rows] * factor + offset
        writer.append(name, time[rows], values_si, status[rows])


def _first_bad(part: _Part, bad: np.ndarray) -> int:
    """The first line with a bad cell."""
    return int(part.table.line[part.clock.rows][np.any(bad, axis=1)].min())


def _file_report(part: _Part, streams: Sequence[StreamReport]) -> FileReport:
    clock, line = part.clock, part.table.line
    return FileReport(
        path=part.path,
        rows_read=len(line),
        rows_without_time=len(clock.without),
        first_without_time=int(line[clock.without[0]]) if len(clock.without) else None,
        equal_times=len(clock.equal),
        first_equal_time=int(line[clock.equal[0]]) if len(clock.equal) else None,
        rows_sorted=clock.sorted,
        wraps=clock.wraps,
        streams=tuple(streams),
        counted=part.counted,
    )
