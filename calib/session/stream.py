"""Streams of a session file, read in bounded pieces."""

import functools
from collections.abc import Iterator

import numpy as np

from .hdf5.chunks import GuardedArray
from .hdf5.guard import Node
from .hdf5.members import declared_unit, required
from .tables import STREAM_EXTRAS

LARGEST_VALUE = 1e18
"""In SI units. What is larger was not measured; its square would overflow where float32 is computed with."""

TIME_BLOCK = 1 << 20
"""Time stamps that are read and checked at once."""


class Stream:
    """One stream of a session, with its own clock and rate.

    | attribute        | meaning                                          |
    |------------------|--------------------------------------------------|
    | name, variable   | name of the stream and of its main variable      |
    | unit             | SI unit of the main variable                     |
    | channels, shape  | number of columns; (rows, channels)              |
    | nominal_rate     | Hz                                               |
    | clock, transport | texts, as recorded                               |
    """

    def __init__(self, name: str, node: Node):
        self.name, self._node = name, node
        self.variable = _signal(node)
        self.nominal_rate = float(node.number("nominal_rate_hz"))
        if self.nominal_rate <= 0:
            raise node.error("nominal_rate_hz is not positive", "write samples per second")
        self.clock, self.transport = node.text("clock", ""), node.text("transport", "")
        values = required(node, self.variable, node.dataset(self.variable))
        self._values = GuardedArray(values)
        self._time = GuardedArray(required(node, "time", node.dataset("time")))
        self._check_shapes()
        self._unit = declared_unit(values, self.variable)
        self.unit = self._unit.si
        self._scale = float(values.number("scale_factor", 1.0))
        self._shift = float(values.number("add_offset", 0.0))
        fill = values.attribute("_FillValue")
        self._fill = fill if isinstance(fill, int | float) else None

    def _check_shapes(self) -> None:
        values, time = self._values, self._time
        if time.dtype.kind != "i" or time.dtype.itemsize != 8 or len(time.shape) != 1:
            raise time.node.error(
                f"is {time.dtype} of rank {len(time.shape)}", "write int64 nanoseconds since the epoch"
            )
        if values.dtype.kind not in "iuf" or len(values.shape) not in (1, 2):
            what = f"is {values.dtype} of rank {len(values.shape)}"
            raise values.node.error(what, "write numbers (time, channel)")
        self.channels = values.shape[1] if len(values.shape) == 2 else 1
        self.shape = (values.shape[0], self.channels)
        if self.channels < 1:
            raise values.node.error("has no channels", "give at least one")
        values.node.require("channels", self.channels)
        self._check_rows("time", time)

    def _check_rows(self, name: str, array: GuardedArray) -> None:
        if array.shape != (self.shape[0],):
            what = f"has shape {array.shape} beside {self.shape[0]:,} samples"
            raise array.node.error(what, "write one entry per sample")

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"Stream({self.name!r}, {self.variable!r} in {self.unit}, shape={self.shape})"

    @functools.cached_property
    def time(self) -> np.ndarray:
        """Time stamps (n,) int64 ns since the session's epoch, checked to be strictly increasing."""
        self._time.node.require("array_bytes", 8 * len(self))
        times = np.empty(len(self), np.int64)
        for start in range(0, len(self), TIME_BLOCK):  # a file of zeros is refused after its first block
            stop = min(start + TIME_BLOCK, len(self))
            times[start:stop] = self._time.read(start, stop)
            self._require_increase(times, max(start - 1, 0), stop)
        times.setflags(write=False)
        return times

    def _require_increase(self, times: np.ndarray, start: int, stop: int) -> None:
        # A difference of damaged times could overflow, hence a comparison.
        bad = times[start + 1 : stop] <= times[start : stop - 1]
        if bad.any():
            row = start + int(np.argmax(bad)) + 1
            back = (int(times[row - 1]) - int(times[row])) / 1e9
            how, remedy = "it repeats the time of the row before", "drop rows of equal times"
            if back:
                how = f"it jumps back by {back:.4g} s"
                remedy = "sort the rows if they are out of order; if a clock was set back, keep one part"
            raise self._time.node.error(f"does not increase at row {row} ({how})", remedy)

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Samples ``start:stop`` as float64 (n, channels) in SI; missing values, and those above 1e18, are NaN."""
        rows = len(range(*slice(start, stop).indices(len(self))))
        self._values.node.require("array_bytes", 8 * rows * self.channels)
        raw = self._values.read(start, stop).reshape(-1, self.channels)
        values = raw.astype(np.float64)
        if self._fill is not None and not np.isnan(self._fill):
            values[raw == self._fill] = np.nan
        scale = self._scale * self._unit.factor
        shift = self._shift * self._unit.factor + self._unit.offset
        with np.errstate(over="ignore", invalid="ignore"):
            # In place, and only if necessary, because a long session spends most of its time here.
            values = np.multiply(values, scale, out=values) if scale != 1.0 else values
            values = np.add(values, shift, out=values) if shift != 0.0 else values
        values[np.abs(values) > LARGEST_VALUE] = np.nan
        return values

    def blocks(self, max_bytes: int = 32 << 20) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield ``(start, stop, values)`` over the stream, each block below `max_bytes`."""
        rows = max(1, max_bytes // (8 * self.channels))
        chunk = self._values.chunk[0] if self._values.chunk else 1
        rows = rows - rows % chunk if rows > chunk > 0 else rows
        for start in range(0, len(self), rows):
            stop = min(start + rows, len(self))
            yield start, stop, self.read(start, stop)

    def status(self) -> np.ndarray | None:
        """`Status` flags (n,) uint16, or None if the file has none."""
        return self._optional("status", "u2")

    @property
    def time_device(self) -> np.ndarray | None:
        """Raw device ticks (n,) uint64, or None."""
        return self._optional("time_device", STREAM_EXTRAS["time_device"])

    @property
    def time_host(self) -> np.ndarray | None:
        """Monotonic time of the host at reception (n,) int64 ns, or None."""
        return self._optional("time_host", STREAM_EXTRAS["time_host"])

    @property
    def seq(self) -> np.ndarray | None:
        """Sequence numbers (n,) uint32, or None."""
        return self._optional("seq", STREAM_EXTRAS["seq"])

    def _optional(self, name: str, dtype: str) -> np.ndarray | None:
        node = self._node.dataset(name)
        if node is None:
            return None
        array = GuardedArray(node)
        self._check_rows(name, array)
        if not np.can_cast(array.dtype, dtype, "safe"):
            raise node.error(f"is {array.dtype}", f"write it as {np.dtype(dtype)}")
        return array.read().astype(dtype)


def _signal(node: Node) -> str:
    """Name of the main variable of a stream."""
    name = node.text("signal", "")
    if name:
        return name
    known = {"time", "status", "channel", *STREAM_EXTRAS}
    found = [name for name in node.members() if name not in known]
    if len(found) != 1:
        raise node.error("does not say which variable it holds", "write the attribute `signal`")
    return found[0]
