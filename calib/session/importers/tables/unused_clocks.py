"""Find a clock among the columns that are not imported, where the user states the rate of a table instead."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from ...errors import printable
from .columns import FileSpec, name_and_unit
from .table import AbstractTableFile, Progress

CLOCK_NAME = re.compile(r"t|.*(time|clock|stamp|date|zeit|seconds).*|m?s|sec|elapsed", re.IGNORECASE)
MAX_EXAMINED = 2  # columns, because each is read from the file
INCREASING = 0.9  # of the steps of a clock
UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # s of one count
MAX_DIFFERENCE = 0.5  # of a period, from which the stated rate places a row at another time than the clock


def clock_notes(file: AbstractTableFile, spec: FileSpec, used: Sequence[int], progress: Progress) -> Iterator[str]:
    """A note for each column that looks like a clock and contradicts the stated rate."""
    assert spec.rate_hz is not None
    named = [i for i, head in enumerate(file.header) if CLOCK_NAME.fullmatch(name_and_unit(head)[0])]
    candidates = [i for i in dict.fromkeys([*file.dates, *named, 0]) if i not in used][:MAX_EXAMINED]
    if not candidates:
        return
    values = file.read(candidates, 0, progress).values
    for column, times in zip(candidates, values.T, strict=True):
        if _contradicts(times, spec.rate_hz):
            label = printable(repr(file.header[column])) if column < len(file.header) else str(column)
            yield (
                f"{printable(file.path.name)}: column {label} looks like a clock and does not agree with "
                f"--rate {spec.rate_hz:g}: give --time instead, if it is one"
            )


def _contradicts(times: np.ndarray, rate_hz: float) -> bool:
    """Whether the numbers increase as a clock does, but not by the same time in each row or not at this rate.

    A column that counts the rows agrees with every rate.
    """
    known = np.flatnonzero(np.isfinite(times))
    if len(known) < max(2, len(times) / 2):
        return False
    steps = np.diff(times[known])
    if (steps > 0).mean() < INCREASING or (np.diff(times[known]) == np.diff(known)).all():
        return False
    rows, since = known - known[0], times[known] - times[known[0]]
    return all(np.abs(since * unit * rate_hz - rows).max() > MAX_DIFFERENCE for unit in UNITS)
