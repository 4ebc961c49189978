"""Text files of tanks: tables, CSV of PyEIDORS, and the .eit files that the software of Sciospec writes."""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import jaxeit as je
from jaxeit.budget import require
from jaxeit.files import open_regular
from jaxeit.geometry import Domain
from jaxeit.skin import AbstractElectrode

from ..session import SessionError
from ..session.importers.formats.text_files import every_line, is_data
from ..session.importers.formats.text_layout import FIRST_LINES, Dialect, layout_of
from .recording import Tank, TankError, named_errors, tank_of

CURRENT_IN_NAME = re.compile(r"_([\d.]+)(uA|mA)(?:_([\d.]+)Hz)?")
AMPERE = {"uA": 1e-6, "mA": 1e-3}


def text_of(path: Path) -> str:
    """The text of a file; raises TankError for one that is larger than a file may be."""
    require("array_bytes", path.stat().st_size, path.name, TankError)
    with open_regular(path) as file:
        return file.read().decode("utf-8", "replace")


def _numbers(where: str, line: str) -> list[float]:
    try:
        return [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        raise TankError(f"{where}: {line.strip()[:60]!r} has a word that is no number") from None


def read_table(path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """The names of the columns and the numbers (rows, columns) of a table; "frame 0", ... where no line names them.

    Delimiter, decimal sign, quotes and header are found as by `jaxeit import csv`. A word that is no number is an
    error, since a tank has no reading to spare; "nan" and an empty cell are missing readings.

    Raises:
        TankError: if the file is no table of numbers.
    """
    require("array_bytes", path.stat().st_size, path.name, TankError)
    try:
        every = list(every_line(path))
        lines = [numbered for numbered in every if is_data(*numbered)]
        layout = layout_of(path, [text for _, text in lines[:FIRST_LINES]])
        cells = [(lines[n - 1][0], row) for n, row in layout.rows(text for _, text in lines) if n > layout.header_lines]
    except (SessionError, csv.Error) as error:
        raise TankError(str(error)) from error
    rows = [[_number(path, line, layout, cell) for cell in row] for line, row in _without_last(cells)]
    widths = sorted({len(row) for row in rows})
    names = layout.header or _names_of_comment(every[0][1], layout)
    names = names[:-1] if names and not names[-1] else names
    if len(widths) != 1 or (layout.header and len(names) != widths[0]):
        raise TankError(f"{path.name}: rows have {widths} numbers; give a table, with a frame a row or a column")
    return names if len(names) == widths[0] else tuple(f"frame {k}" for k in range(widths[0])), np.array(rows)


def _without_last(cells: Sequence[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """The rows; without their last cells where all of these are empty, since each line ends in a delimiter."""
    ended = all(not row[-1] for _, row in cells)
    for line, row in cells:
        yield line, row[:-1] if ended else row


def _number(path: Path, line: int, layout: Dialect, cell: str) -> float:
    value = layout.number(cell)
    if math.isnan(value) and cell.strip().lower() not in ("", "nan"):
        raise TankError(f"{path.name}: line {line}: {cell[:60]!r} is no number; correct it, or leave the cell empty")
    return value


def _names_of_comment(first: str, layout: Dialect) -> tuple[str, ...]:
    """The names that `numpy.savetxt` writes into the first line, behind a "#"."""
    names = next(layout.rows([first.removeprefix("#")]), (0, []))[1] if first.startswith("#") else []
    return tuple(name.strip(' "') for name in names)


def pyeidors_tank(path: Path, domain: Domain | None, rim: Sequence[AbstractElectrode] | None) -> Tank:
    """A table with one row a reading, two columns a frame (real and imaginary part), of opposite polarity to ours.

    Adjacent drive and measurement in rotating order; current and frequency are in the name of the file.
    """
    _, rows = read_table(path)
    electrodes = (3 + np.sqrt(9 + 4 * len(rows))) / 2
    if electrodes != int(electrodes) or electrodes < 4:
        raise TankError(
            f"{path.name}: has {len(rows)} lines, which is no n (n - 3) for n electrodes of adjacent pairs; describe "
            "another tank and its scan in a TOML file, and give that: --skin TANK.toml, in Python skin= (docs/tanks.md)"
        )
    if rows.shape[1] % 2:
        raise TankError(f"{path.name}: lines have {rows.shape[1]} columns; two are needed a frame")
    named = CURRENT_IN_NAME.search(path.name)
    current = float(named[1]) * AMPERE[named[2]] if named else 1e-3
    frequency = float(named[3]) if named and named[3] else 0.0
    protocol = je.Protocol(je.skin.adjacent(int(electrodes)), current, frequency)
    table = -rows.T
    names = tuple(f"frame {k}" for k in range(len(table) // 2))
    skin = tank_of(path.stem, protocol, int(electrodes), domain, rim)
    return Tank(skin, table[::2], names, table[1::2])


def sciospec_tank(paths: Sequence[Path], domain: Domain | None, rim: Sequence[AbstractElectrode] | None) -> Tank:
    """One frame a file, in the order of the names: the potential of each channel for each injection.

    The readings are differences of neighbouring channels that do not drive. Of several frequencies the first is taken.
    """
    frames: list[np.ndarray] = []
    names: list[str] = []
    first: tuple[np.ndarray, float, float] | None = None
    for path in sorted(paths):
        drives, potentials, current, frequency = _sciospec_frame(path)
        if first is not None and not np.array_equal(first[0], drives):
            raise TankError(f"{path.name}: has other injections than {names[0]}; load the files of one setup")
        first = first or (drives, current, frequency)
        frames.append(potentials)
        names.append(path.stem)
    if first is None:
        raise TankError("no .eit file was given; give one or more files of Sciospec's software")
    drives, current, frequency = first
    electrodes = frames[0].shape[1]
    ring = np.stack([np.arange(electrodes), (np.arange(electrodes) + 1) % electrodes], 1)
    rows = [[*drive, *pair] for drive in drives.tolist() for pair in ring.tolist() if not set(drive) & set(pair)]
    pattern = np.array(rows)
    drive = np.repeat(
        np.arange(len(drives)), [sum(not set(d) & set(p) for p in ring.tolist()) for d in drives.tolist()]
    )
    stack = np.array(frames)
    readings = stack[:, drive, pattern[:, 2]] - stack[:, drive, pattern[:, 3]]
    with named_errors(names[0]):
        protocol = je.Protocol(pattern, current, frequency)
    skin = tank_of(paths[0].parent.name or "sciospec", protocol, electrodes, domain, rim)
    return Tank(skin, np.ascontiguousarray(readings.real), tuple(names), np.ascontiguousarray(readings.imag))


def _sciospec_frame(path: Path) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Injections (n, 2) from 0, potentials (n, channels) V, current in A, frequency in Hz.

    The first line tells the number of header lines; of these the fifth is the least frequency, the eighth the number of
    frequencies, the ninth the current. Then each injection has a line of two electrodes, counted from 1, and a line a
    frequency of real and imaginary parts by turns.
    """
    lines = text_of(path).splitlines()
    where = path.name
    try:
        header, frequency, count, current = int(lines[0]), float(lines[4]), int(float(lines[7])), float(lines[8])
    except (ValueError, IndexError):
        raise TankError(f"{where}: does not begin like a text file of Sciospec's software") from None
    body = [line for line in lines[header:] if line.strip()]
    step = 1 + count
    if count < 1 or not body or len(body) % step or not current > 0:
        raise TankError(f"{where}: {len(body)} lines after its header are no injections of {count} frequencies")
    drives = [_numbers(where, line) for line in body[::step]]
    values = [_numbers(where, line) for line in body[1::step]]
    if {len(drive) for drive in drives} != {2} or len({len(v) for v in values}) != 1 or len(values[0]) % 2:
        raise TankError(f"{where}: an injection is two electrodes, and a line of potentials has two numbers a channel")
    table = np.array(values)
    pairs = np.array(drives).astype(int) - 1
    if pairs.min() < 0 or pairs.max() >= table.shape[1] // 2:
        raise TankError(f"{where}: injects at electrode {pairs.max() + 1}, and has {table.shape[1] // 2} channels")
    return pairs, table[:, ::2] + 1j * table[:, 1::2], current, frequency
