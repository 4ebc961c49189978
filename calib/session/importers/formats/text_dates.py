"""Columns of dates and times (ISO 8601) in tables of text, read as seconds since 1970."""

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime

_DATE_AND_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?(?P<zone>Z|[+-]\d\d:?\d\d)?")


def is_date(cell: str) -> bool:
    """Whether a cell holds a date and time."""
    return _DATE_AND_TIME.fullmatch(cell) is not None


def date_columns(rows: Sequence[Sequence[str]]) -> dict[int, bool]:
    """The columns of these rows that hold dates and times alone, and whether these state a time zone."""
    found: dict[int, bool] = {}
    for column in range(max(map(len, rows), default=0)):
        cells = [row[column] for row in rows if column < len(row) and row[column]]
        dates = [_DATE_AND_TIME.fullmatch(cell) for cell in cells]
        if cells and all(dates):
            found[column] = any(date["zone"] for date in dates if date)
    return found


def seconds_of(cell: str, zone: bool) -> float:
    """Seconds since 1970 (UTC); NaN if the cell is no date and time, or differs from the others in having a zone."""
    date = _DATE_AND_TIME.fullmatch(cell)
    if date is None or bool(date["zone"]) != zone:
        return math.nan
    try:
        moment = datetime.fromisoformat(cell)
        return (moment if zone else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return math.nan
