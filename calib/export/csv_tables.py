"""Forces as tables of text, for spreadsheets and pandas: a row a frame, and a second table of the contacts."""

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxeit.files import open_regular

from ..calibration.application.frame_blocks import Progress
from ..calibration.application.map_files import FORCE_MAP_FORMAT, TRACKS
from ..calibration.logs.procedure import FORCE_FORMAT as LOG_FORCES
from ..session import ArchiveReader, open_archive
from ..session.archive import archive_format
from ..session.errors import printable, problem
from ..session.outputs import folder_beside, require_no_input, require_no_session

BLOCK = 4096  # rows that are read at once
CONTACTS = "-contacts.csv"  # end of the name of the second table
PAD_COLUMNS = {"pad_force": "force_N", "pad_force_se": "standard_error_N", "pad_valid": "valid"}
LOG_COLUMNS = {
    "force": "force_N",
    "standard_error": "standard_error_N",
    "low": "low_N",
    "high": "high_N",
    "valid": "valid",
}
CONTACT_COLUMNS = ["time_s", "number", "x_m", "y_m", "force_N"]
LOG_HEAD, PAD_HEAD = ["time_s", *LOG_COLUMNS.values()], ["time_s", "total_N"]
HEAD_BYTES = 256  # enough to hold the columns with which tables begin
Row = Sequence[object]


@dataclass(frozen=True)
class TableSummary:
    """What was written.

    | meaning                                     |
    |---------------------------------------------|
    | frames: rows of the table of forces         |
    | contacts: rows of each table, by its name   |
    """

    frames: int
    contacts: dict[str, int]

    def __str__(self) -> str:
        more = [f"{name}: {rows:,} rows, one for each contact of a frame" for name, rows in self.contacts.items()]
        return "\n".join([f"{self.frames:,} rows, one for each frame", *more])


def export_csv(
    source: str | os.PathLike[str], output: str | os.PathLike[str], *, progress: Progress = iter
) -> TableSummary:
    """Write the forces of `calib.apply` as a table of text; contacts go to a second table, ``NAME-contacts.csv``.

    ``docs/commands.md`` lists the columns. A cell is empty where a value is not known. Numbers are those of the file,
    to the last bit.

    Args:
        source: a force map, or the forces of a log.
        output: replaced if it exists and is such a table; the tables appear when they are complete.
        progress: wraps what is written piece by piece, as `tqdm.tqdm` does.

    Raises:
        SessionError: for another kind of file, or one that lacks an array; for an output, or a second table, in whose
            place lies the source, a session or another file that is no table of forces, which would be lost.
    """
    source, output = Path(source), Path(output)
    require_no_input(output, [source])
    require_no_session(output)
    _require_own(output, (LOG_HEAD, PAD_HEAD))
    kind = archive_format(source)
    if kind not in (FORCE_MAP_FORMAT, LOG_FORCES):
        what = f"is {printable(kind)!r}" if kind else "has no format"
        raise problem(source, "file", what, "name a force map of `jaxeit apply`")
    with open_archive(source, kind) as archive, folder_beside(output) as folder:
        tables = [_log_table if kind == LOG_FORCES else _pad_table]
        tables += [_track_table] if TRACKS + "number" in archive.arrays else []
        tables += [_contact_table] if len(tables) == 1 and "contact_force" in archive.arrays else []
        names = [output.name, output.stem + CONTACTS][: len(tables)]
        for name in names[1:]:
            _require_own(output.with_name(name), (CONTACT_COLUMNS,))
        rows = [_write(folder / name, table(archive, progress)) for name, table in zip(names, tables, strict=True)]
        for name in names:
            os.replace(folder / name, output.parent / name)
    return TableSummary(rows[0], dict(zip(names[1:], rows[1:], strict=True)))


def _log_table(archive: ArchiveReader, progress: Progress) -> Iterator[Row]:
    _require(archive, LOG_COLUMNS)
    yield LOG_HEAD
    for time, *columns in _blocks(archive, ["time", *LOG_COLUMNS], progress):
        yield from zip(_seconds(time), *map(_cells, columns), strict=True)


def _pad_table(archive: ArchiveReader, progress: Progress) -> Iterator[Row]:
    _require(archive, ["pad_names", *PAD_COLUMNS])
    pads = [printable(name) for name in archive.arrays["pad_names"].read().tolist()]  # a line break splits rows
    yield [*PAD_HEAD, *(f"{pad} {label}" for pad in pads for label in PAD_COLUMNS.values())]
    for time, *columns in _blocks(archive, ["time", *PAD_COLUMNS], progress):
        each = [_cells(column[:, pad]) for pad in range(len(pads)) for column in columns]
        yield from zip(_seconds(time), _cells(columns[0].sum(1)), *each, strict=True)


def _track_table(archive: ArchiveReader, progress: Progress) -> Iterator[Row]:
    """Contacts that were followed: the number stays while a contact lives."""
    names = [TRACKS + name for name in ("time", "number", "position", "force", "force_se")]
    _require(archive, names)
    yield [*CONTACT_COLUMNS, "standard_error_N"]
    for time, number, place, *forces in _blocks(archive, names, progress):
        columns = (number.astype(int), *place.T, *forces)
        yield from zip(_seconds(time), *map(_cells, columns), strict=True)


def _contact_table(archive: ArchiveReader, progress: Progress) -> Iterator[Row]:
    """Contacts that were found in each frame alone: the number counts them in their frame."""
    names = ["time", "contact_position", "contact_force"]
    _require(archive, names)
    yield CONTACT_COLUMNS
    for time, place, force in _blocks(archive, names, progress):
        frame, number = np.nonzero(np.isfinite(place).all(2))
        columns = (number, *place[frame, number].T, force[frame, number])
        yield from zip(_seconds(time[frame]), *map(_cells, columns), strict=True)


def _require_own(path: Path, heads: Iterable[Sequence[str]]) -> None:
    """Refuse a path at which a file lies that does not begin with one of these columns: it may be a log."""
    if not path.is_file():
        return
    with open_regular(path) as file:
        begin = file.read(HEAD_BYTES)
    if begin and not any(begin.startswith(",".join(head).encode()) for head in heads):
        raise problem(path, "file", "is no table of forces, and would be lost", "give another name for the output")


def _require(archive: ArchiveReader, names: Iterable[str]) -> None:
    """Refuse a file without these arrays."""
    for name in ("time", *names):
        if name not in archive.arrays:
            raise problem(archive.path, name, "missing", "write the force map again with `jaxeit apply`")


def _blocks(archive: ArchiveReader, names: list[str], progress: Progress) -> Iterator[list[np.ndarray]]:
    """The arrays side by side, some rows at a time."""
    for low in progress(range(0, archive.arrays[names[0]].shape[0], BLOCK)):
        yield [archive.arrays[name].read(low, low + BLOCK) for name in names]


def _cells(column: np.ndarray) -> list[object]:
    """Numbers as the file has them; flags as 0 and 1; nothing where a value is not known."""
    values = column.astype(int) if column.dtype.kind in "bu" else column
    return ["" if value != value else value for value in values.tolist()]


def _seconds(time: np.ndarray) -> list[str]:
    """Nanoseconds as seconds, exactly."""
    return [f"{'-' * (ns < 0)}{abs(ns) // 10**9}.{abs(ns) % 10**9:09d}" for ns in time.tolist()]


def _write(path: Path, table: Iterator[Row]) -> int:
    """Write a table, whose first row is its head; returns the number of the other rows."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer, rows = csv.writer(file, lineterminator="\n"), -1
        for row in table:
            writer.writerow(row)
            rows += 1
    return rows
