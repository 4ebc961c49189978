"""Readings that a caller hands to the calibration of a log, asked whether they can be such before they are used."""

import numpy as np
from jaxtyping import Float

from ...session import SessionError

MIN_INTERVAL = 1000.0  # ns; no sensor is read more often, so that a shorter usual interval is in another unit
_GIVE = "give nanoseconds that rise, as a stream's time"


def readings(
    time: object, values: object, place: object, columns: int, stream: str
) -> tuple[np.ndarray, Float[np.ndarray, "n columns"], Float[np.ndarray, "n 2"] | None]:
    """Times (n,) ns, values (n, columns) and places (n, 2) m of a log; values of one channel may be (n,).

    Raises:
        SessionError: if shapes do not fit each other and the sensor, or times are none, do not rise, or are in seconds.
    """
    table = _numbers(values, "values")
    if table.ndim == 1 and columns == 1:
        table = table[:, None]
    if table.ndim != 2:
        raise SessionError(f"values: of shape {table.shape}; give a row of {columns} channels for each time")
    require_channels(table.shape[1], columns, stream)
    times = _times(time)
    if times.shape != (len(table),):
        raise SessionError(f"time: of shape {times.shape} for {len(table)} rows of values; give one time for each row")
    where = None if place is None else _numbers(place, "place")
    if where is not None and where.shape != (len(table), 2):
        raise SessionError(f"place: of shape {where.shape} for {len(table)} rows of values; give x and y for each row")
    return times, table, where


def reading(
    time: object, values: object, place: object, columns: int, stream: str
) -> tuple[float, Float[np.ndarray, " columns"], Float[np.ndarray, " 2"] | None]:
    """Time ns, values (columns,) and place (2,) m of one reading; errors as for `readings`, but for rising times."""
    row, where = _numbers(values, "values"), None if place is None else _numbers(place, "place")
    if row.ndim > 1:
        raise SessionError(f"values: of shape {row.shape}; give the {columns} channels of one reading")
    times, table, places = readings([time], row.reshape(1, -1), None if where is None else where[None], columns, stream)
    return float(times[0]), table[0], None if places is None else places[0]


def require_channels(given: int, columns: int, stream: str) -> None:
    """Refuse readings of another number of channels than the sensor has."""
    if given != columns:
        raise SessionError(
            f"/streams/{stream}: {given} channels, but the calibration is of {columns}; give the calibration of "
            "this sensor"
        )


def require_later(time: float, last: float) -> None:
    """Refuse a reading that is not at least a nanosecond after the last one, ns."""
    if time - last < 1:
        raise SessionError(f"time: {time:.16g} after {last:.16g}, both in ns, is not later by 1 ns or more; {_GIVE}")


def _times(time: object) -> np.ndarray:
    times = np.asarray(time)
    if times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        what = f"holds {times.dtype}" if times.dtype.kind not in "iuf" else "holds values that are not finite"
        raise SessionError(f"time: {what}; {_GIVE}")
    if times.ndim != 1 or len(times) < 2:
        return times
    steps = np.diff(times.astype(np.int64) if times.dtype.kind == "u" else times)
    if (steps <= 0).any():
        row = int(np.flatnonzero(steps <= 0)[0])
        raise SessionError(f"time: {times[row + 1]} in row {row + 1} is not after {times[row]}; {_GIVE}")
    if np.median(steps) < MIN_INTERVAL:
        raise SessionError(f"time: rises by {np.median(steps):.3g} ns from row to row; are these seconds? {_GIVE}")
    return times


def _numbers(given: object, name: str) -> np.ndarray:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise SessionError(f"{name}: no table of numbers; give floats, NaN where one is missing") from None
