"""Force and channels of a log, cut into blocks of time, for the checks that compare them with each other."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...presses.channel_faults import rank_correlation
from ...presses.streams import resample
from ...session import Stream
from ...session.units import SECOND
from ..streams.statistics import StreamStatistics

NOT_SIGNALS = ("force", "stage", "temperature", "barometer")
MAX_CELLS, MAX_ROWS = 1 << 26, 1 << 15  # values that are read, and samples that are compared
LOG_BLOCKS, MIN_BLOCK = 12, 20  # blocks of a log; samples in a block, from which their relation shows
SPREAD_PERCENTILES = (5, 95)  # percentiles: what lies beyond may be spikes


def signal_name(streams: Collection[str]) -> str:
    """The stream of a log that tells its force: "pressure", or the only one that can be it; empty: there is none."""
    left = [name for name in streams if name not in NOT_SIGNALS]
    return "pressure" if "pressure" in streams else left[0] if len(left) == 1 else ""


@dataclass(frozen=True, eq=False)
class LogBlocks:
    """The samples of a log with force and all channels, each so many, in blocks of equal length.

    | field  | meaning                              | shape         | unit     |
    |--------|--------------------------------------|---------------|----------|
    | signal | name of the stream of the channels   |               |          |
    | time   | from the start of the force          | (n,)          | s        |
    | force  |                                      | (n,)          | N        |
    | values | of the channels that change at all   | (n, channels) | sensor's |
    | column | number of each channel in its stream | (channels,)   |          |
    | placed | whether a stage moves the contact    |               |          |
    """

    signal: str
    time: np.ndarray
    force: np.ndarray
    values: np.ndarray
    column: np.ndarray
    placed: bool

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """Rows of each block."""
        return np.array_split(np.arange(len(self.time)), LOG_BLOCKS)

    @cached_property
    def starts(self) -> np.ndarray:
        """Times (blocks,) at which blocks begin, ns from the start of the force."""
        return np.array([self.time[rows[0]] * SECOND for rows in self.rows])

    @cached_property
    def force_spread(self) -> np.ndarray:
        """Spread of the force in each block (blocks,), N."""
        return np.array([spread(self.force[rows]) for rows in self.rows])

    @cached_property
    def spreads(self) -> np.ndarray:
        """Spread of each channel in each block (channels, blocks)."""
        return np.array([[spread(column[rows]) for rows in self.rows] for column in self.values.T])

    @cached_property
    def correlations(self) -> np.ndarray:
        """Rank correlation of each channel with the force in each block (channels, blocks)."""
        return np.array(
            [[rank_correlation(column[rows], self.force[rows]) for rows in self.rows] for column in self.values.T]
        )


def log_blocks(statistics: Mapping[str, StreamStatistics]) -> LogBlocks | None:
    """The blocks of a log; None if it has no force, no signal or too few samples."""
    name = signal_name(statistics.keys())
    if not name or "force" not in statistics:
        return None
    force, signal = statistics["force"].stream, statistics[name].stream
    if len(signal) * signal.channels > MAX_CELLS or len(force) < LOG_BLOCKS * MIN_BLOCK:
        return None
    time, known, values = _together(force, signal)
    column = np.flatnonzero(~statistics[name].dead)
    good = np.isfinite(known) & np.isfinite(values[:, column]).all(1)
    if not len(column) or good.sum() < LOG_BLOCKS * MIN_BLOCK:
        return None
    rows = np.flatnonzero(good)
    rows = rows[:: -(-len(rows) // MAX_ROWS)]
    seconds = (time[rows] - time[0]) / SECOND
    return LogBlocks(name, seconds, known[rows], values[np.ix_(rows, column)], column, "stage" in statistics)


def _together(force: Stream, signal: Stream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time, values = force.time, signal.read()
    same = np.array_equal(time, signal.time)
    return time, force.read()[:, 0], values if same else resample(signal.time, values, time)


def spread(values: np.ndarray) -> float:
    """Range of most of the values."""
    low, high = np.percentile(values, SPREAD_PERCENTILES)
    return float(high - low)


def usual(spreads: np.ndarray) -> float:
    """Spread of a block in which something happens: the second largest (blocks,), as the largest may be a fault."""
    return float(np.sort(spreads)[-2])
