"""Limits of one import. What is beyond a limit is refused before it is kept in memory."""

from pathlib import Path

from jaxeit.budget import current_budget

from ..errors import problem

MAX_LINE = 1 << 20
"""Characters of a line."""
MAX_COLUMNS = 100_000
"""More columns in one range or array are taken for a mistake."""
MAX_NAMES = 100_000
"""Arrays of one file."""


def require_within(path: Path, limit: str, asked: float, counted: str = "") -> None:
    """Refuse a file that asks for more than the limit of that name in the budget allows.

    ``counted`` says what was counted, where that is more than one file.
    """
    if beyond := current_budget().excess(limit, asked):
        what, todo = beyond
        raise problem(path, "file", f"{counted}{what}" if counted else f"holds at least {what}", todo)


def check_size(path: Path, rows: int, columns: int, used: int = 0) -> None:
    """Refuse a table of this size; ``used`` is the number of cells that earlier files of the import have."""
    require_within(path, "import_rows", rows)
    counted = f"makes, with its {rows:,} rows of {columns:,} columns, "
    require_within(path, "import_numbers", used + rows * columns, counted)
