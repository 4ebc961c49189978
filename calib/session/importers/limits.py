"""Limits of one import. What is beyond a limit is refused before it is kept in memory."""

from pathlib import Path

from ..errors import problem

MAX_TEXT_BYTES = 4 << 30
"""Bytes of a text file, unpacked."""
MAX_LINE = 1 << 20
"""Characters of a line."""
MAX_ROWS = 20_000_000
"""Rows of a file: five hours at 1 kHz."""
MAX_CELLS = 100_000_000
"""Numbers of all files of an import together; about 2 GB of memory while they are written."""
MAX_COLUMNS = 100_000
"""More columns in one range or array are taken for a mistake."""
MAX_NAMES = 100_000
"""Arrays of one file."""
CHILD_BYTES = 4 << 30
"""Address space of the process that reads a foreign binary file."""
CHILD_SECONDS = 300
"""Time of the process that reads a foreign binary file."""


def check_size(path: Path, rows: int, columns: int, used: int = 0) -> None:
    """Refuse a table of this size; ``used`` is the number of cells that earlier files of the import have."""
    if rows > MAX_ROWS:
        what = f"has more than {MAX_ROWS:,} rows"
        raise problem(path, "file", what, "split the recording into shorter ones")
    if used + rows * columns > MAX_CELLS:
        what = f"{rows:,} rows of {columns:,} columns are more than {MAX_CELLS:,} numbers in one import"
        raise problem(path, "file", what, "name fewer columns, or split the recording")
