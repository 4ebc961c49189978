"""Tables in Markdown from rows of results.

A cell is a format string over a row, as ``"{frames:,}"``. Added to Python's formats are ``{x:ms}``, three figures or
whole numbers from 100 on, ``{x:.1f %}``, a fraction in percent, and the factors ``{x:.1f milli}`` (in thousandths),
``{x:.1f kilo}`` (in thousands) and ``{x:.0f mega}`` (in millions). A cell is empty where the row lacks the number.
"""

import re
import string
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .rows import Row

FACTORS = {"%": 100, "milli": 1e3, "kilo": 1e-3, "mega": 1e-6}


class _Format(string.Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "ms":
            return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
        spec, _, unit = format_spec.partition(" ")
        if unit:
            return self.format_field(FACTORS[unit] * value, spec) + (" %" if unit == "%" else "")
        return format(value, spec)


def cell(template: str, row: Row, missing: str = "") -> str:
    """A format string filled from a row; ``missing`` where the row has not all that the string names."""
    try:
        return _Format().vformat(template, (row,), row)
    except (KeyError, TypeError):
        return missing


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def crossed(head: str, line: str, column: str, content: str, rows: Sequence[Row], missing: str = "") -> str:
    """A line and a column for each value of two format strings, in order of appearance; of equals the last counts."""
    heads = dict.fromkeys(cell(column, row) for row in rows)
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        found.setdefault(cell(line, row), {})[cell(column, row)] = cell(content, row, missing)
    return markdown([head, *heads], [[label, *(cells.get(h, "") for h in heads)] for label, cells in found.items()])


def replaced(page: str, mark: str, table: str) -> str:
    """A page with a table between ``<!-- mark: ... -->`` and ``<!-- end of mark -->``."""
    pattern = rf"(<!-- {mark}:.*?-->\n).*?(<!-- end of {mark} -->)"
    return re.sub(pattern, lambda m: m[1] + table + m[2], page, flags=re.DOTALL)


def all_columns(rows: Sequence[Row]) -> str:
    """Every number of the rows; least and most stand beside the median, and a standard deviation after its mean."""
    names = dict.fromkeys(name for row in rows for name, value in row.items() if not isinstance(value, Mapping))
    shown = [n for n in names if not (n.endswith("_sd") or re.sub("^(min|max)_", "median_", n) in {*names} - {n})]
    return markdown([name.replace("_", " ") for name in shown], [[_with_spread(row, n) for n in shown] for row in rows])


def _with_spread(row: Row, name: str) -> str:
    value, least, most = (row.get(name.replace("median_", kind)) for kind in ("median_", "min_", "max_"))
    if name.startswith("median_") and least is not None:
        return f"{value:.3g} ({least:.3g} to {most:.3g})"
    sd = row.get(f"{name}_sd")
    return plain(row.get(name)) + ("" if sd is None else f" ± {sd:.2g}")


def plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)
