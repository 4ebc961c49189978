"""What an import read, left out and found suspicious."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

MAX_EQUAL_TIMES = 0.2  # share of the rows that may have the time of another: more tell of a clock that is too coarse


@dataclass(frozen=True)
class StreamReport:
    """Report of one stream, over all its channels and files.

    | field                  | meaning                                                           |
    |------------------------|-------------------------------------------------------------------|
    | name, variable, unit   | of the stream and of its quantity                                 |
    | rows, channels         | number of samples, and of values of each                          |
    | rate_hz                | rate of the samples, Hz                                           |
    | declared_missing       | number of values that were declared to stand for a missing one    |
    | not_numbers            | number of cells that are no numbers                               |
    | first_not_number       | line or row of the first of these; None: there is none            |
    | warnings               | what the user should act on                                       |
    """

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
    """Report of one file; ``first_*`` are numbers of lines or, in a binary file, of rows, as ``counted`` says.

    Streams that several files continue are in the report of the last of these files.

    | field                               | meaning                                                      |
    |-------------------------------------|--------------------------------------------------------------|
    | path                                | of the file                                                  |
    | rows_read                           | number of rows                                               |
    | rows_without_time                   | number of rows left out because their time is missing        |
    | equal_times                         | number of rows left out because they have the time of another |
    | first_without_time, first_equal_time | where the first of these is; None: there is none            |
    | rows_sorted                         | number of rows that went back in time and were sorted        |
    | wraps                               | how often the counter of the clock began anew at its end     |
    | streams                             | a report of each                                             |
    """

    path: Path
    rows_read: int
    rows_without_time: int
    first_without_time: int | None
    equal_times: int
    first_equal_time: int | None
    rows_sorted: int
    streams: tuple[StreamReport, ...]
    wraps: int = 0
    counted: str = "line"


@dataclass(frozen=True)
class ImportReport:
    """What an import read, left out and found suspicious.

    ``output`` is the path of the session, ``epoch`` when its clock read zero (1970 unless ``epoch_known``), ``files`` a
    report of each file and ``notes`` what holds for all.

    Example:
        for file in report.files:
            for stream in file.streams:
                print(stream.name, stream.rows, "rows,", stream.not_numbers, "cells that are no numbers")
        print(report.warnings)
    """

    output: Path
    epoch: datetime
    epoch_known: bool
    files: tuple[FileReport, ...]
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings that the user should act on, one line each."""
        found = [w for f in self.files for w in (*_clock_warnings(f), *(w for s in f.streams for w in s.warnings))]
        if not self.epoch_known:
            found.append("the clock does not say when the recording began; give --epoch if known")
        return (*found, *self.notes)

    def summary(self) -> str:
        """The report as text, one line per stream, loss and warning."""
        lines = [line for f in self.files for line in _file_lines(f)]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join([*lines, f"wrote {self.output}"])


def _clock_warnings(report: FileReport) -> Iterator[str]:
    """What to do about a clock with fewer times than there are rows, as one of whole seconds."""
    timed = report.rows_read - report.rows_without_time
    if report.equal_times > MAX_EQUAL_TIMES * timed:
        rate = max((s.rate_hz for s in report.streams), default=0.0) * timed / (timed - report.equal_times)
        what = f"{report.equal_times:,} of {timed:,} rows are left out, since they have the time of another"
        todo = f"give the rate of the rows in its place (about --rate {rate:.3g})"
        yield f"{report.path.name}: {what}: if the clock is coarse, as one of whole seconds, {todo}"


def _file_lines(report: FileReport) -> Iterator[str]:
    yield f"{report.path.name}: {report.rows_read:,} rows"
    if report.rows_without_time:
        first = f"{report.counted} {report.first_without_time}"
        yield f"  {report.rows_without_time:,} rows without a time left out (first: {first})"
    if report.equal_times:
        first = f"{report.counted} {report.first_equal_time}"
        yield f"  {report.equal_times:,} rows with a repeated time left out (first: {first})"
    if report.rows_sorted:
        yield f"  {report.rows_sorted:,} rows went back in time and were sorted"
    if report.wraps:
        yield f"  the counter of the clock began anew {report.wraps:,} times, and its times go on"
    for s in report.streams:
        shape = f"{s.rows:,} x {s.channels}"
        yield f"  {s.name}: {s.variable} in {s.unit}, {shape}, about {s.rate_hz:.4g} Hz"
        if s.declared_missing:
            yield f"    {s.declared_missing:,} values declared missing"
        if s.not_numbers:
            yield f"    {s.not_numbers:,} cells are not numbers (first: {report.counted} {s.first_not_number})"
