"""Limits of one import. Data beyond a limit are refused before they are kept in memory."""

from pathlib import Path

from jaxeit.budget import current_budget

from ..errors import problem

MAX_LINE = 1 << 20
"""Largest number of characters in a line."""
MAX_COLUMNS = 100_000
"""Largest number of columns in one range or array; more are taken for a mistake."""
MAX_NAMES = 100_000
"""Largest number of arrays in one file."""


def require_within(path: Path, limit: str, asked: float, counted: str = "") -> None:
    """Refuse a file that asks for more than the limit of that name in the budget allows.

    ``counted`` begins the message if several files are counted together.
    """
    if beyond := current_budget().excess(limit, asked):
        what, todo = beyond
        raise problem(path, "file", f"{counted}{what}" if counted else f"holds at least {what}", todo)


def check_size(path: Path, rows: int, columns: int, used: int = 0) -> None:
    """Refuse a table of this size; ``used`` is the number of cells that earlier files of the import have."""
    require_within(path, "import_rows", rows)
    counted = f"makes, with its {rows:,} rows of {columns:,} columns, "
    require_within(path, "import_numbers", used + rows * columns, counted)
