"""Rows of results: dictionaries of labels and numbers, their groups and their means."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]


def grouped(rows: Iterable[Row], *names: str) -> dict[Any, list[Row]]:
    """Rows by their value under a name, or by their values under several; groups in order of appearance."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        key = row[names[0]] if len(names) == 1 else tuple(row[name] for name in names)
        found.setdefault(key, []).append(row)
    return found


def group_means(rows: Iterable[Row], *names: str, count: str = "", sd_of: str = "") -> list[Row]:
    """The mean of each group of rows, as `averaged` forms it, with the number of its rows under ``count``."""
    return [averaged(same, sd_of) | ({count: len(same)} if count else {}) for same in grouped(rows, *names).values()]


def rounded(row: Row, digits: int = 4) -> Row:
    """The numbers of a row as floats with so many digits behind the point."""
    return {name: round(float(value), digits) for name, value in row.items()}


def averaged(rows: Sequence[Row], sd_of: str = "") -> Row:
    """Labels of the first row, and the mean of each number over the rows that have it (None or NaN: has not).

    With several values the standard deviation follows as ``NAME_sd``, for names that end in ``sd_of``.
    """
    out: Row = {}
    for name, first in rows[0].items():
        values = [row[name] for row in rows if row[name] is not None and row[name] == row[name]]
        number = first is None or isinstance(first, float)
        out[name] = (float(np.mean(values)) if values else None) if number else first
        if number and name.endswith(sd_of) and len(values) > 1:
            out[f"{name}_sd"] = float(np.std(values, ddof=1))
    return out
