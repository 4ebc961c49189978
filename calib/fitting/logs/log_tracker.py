"""The model of a log for one reading after the other, as a running sensor sends them."""

from collections import deque
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..curves.play_operators import remembered
from .model import LogModel, LogPrediction, median_of_three, with_noise
from .noise import RATE_WINDOW


class _Reading(NamedTuple):
    """A reading of channels (1, channels) at a place (1, 2) m, and its entry of `LogTracker`'s recent forces."""

    values: np.ndarray
    place: np.ndarray
    entry: list[float]


class LogTracker:
    """Predicts what `LogModel.predict` predicts for the last reading of a log, from one reading after the other.

    It keeps the states of lags, the turning points that a curve with hysteresis remembers, and the forces over which
    the rate is taken.

    Example:
        # one reading after the other, as a running sensor sends them
        tracker = logs.LogTracker(found.model)
        for at, reading in zip(time[:3], channels[:3], strict=True):
            print(tracker.step(at, reading).force)  # N
    """

    def __init__(self, model: LogModel):
        self._model, self._signals = model, model.combination.tracker()
        self._past = np.zeros((0, 0))  # turning points of the signals before the last, (points, histories)
        self._latest: deque[np.ndarray] = deque(maxlen=3)  # the last signals, (histories,) each
        self._previous: _Reading | None = None  # the last one, whose force is final once the next one is known
        self._copies = 1
        self._recent: deque[list[float]] = deque()  # time, force, standard error and validity

    def step(
        self, time: float, values: Float[np.ndarray, " channels"], place: Float[np.ndarray, " 2"] | None = None
    ) -> LogPrediction:
        """Force, standard error, interval and validity of one reading, at a time (ns) that rises."""
        location = self._model.location
        at = np.full((1, 2), np.nan) if place is None else place[None]
        inputs = values[None] if location is None else location.inputs(values[None], at)
        reading = _Reading(values[None], at, [time, 0.0, 0.0, 0.0])
        self._recent.append(reading.entry)
        self._estimate(self._signals.step(time / 1e9, inputs[0]), reading)
        while len(self._recent) > 2 and self._recent[1][0] <= time - 1e9 * RATE_WINDOW:
            self._recent.popleft()
        when, force, error, valid = (np.array(column) for column in zip(*self._recent, strict=True))
        found = with_noise(self._model.noise, when, force, error, valid > 0)
        return LogPrediction(*(part[-1:] for part in found))

    def _estimate(self, signals: Float[np.ndarray, " histories"], reading: _Reading) -> None:
        """Enter the force of a reading and, where the curve remembers, that of the reading before it again."""
        rows = [reading]
        series = signals[:, None]
        if self._model.curve.curve.path and np.isfinite(signals[0]):
            series = self._with_turning_points(signals)
            rows = [row for row in (self._previous, reading) if row is not None]
            self._previous = reading
        values, place = (np.concatenate(column) for column in list(zip(*rows, strict=True))[:2])
        for row, found in zip(rows, zip(*self._model.forces(series, values, place), strict=True), strict=True):
            row.entry[1:] = map(float, found)

    def _with_turning_points(self, signals: Float[np.ndarray, " histories"]) -> Float[np.ndarray, "more m"]:
        """The signals after the turning points of each history.

        A reading becomes part of the past as the median of three (`filter_signals`), once the next one is known.
        """
        if not self._latest:
            extremes = self._model.with_extreme_histories(signals[:, None])
            self._copies = len(extremes) // len(signals)
            self._past = remembered(extremes[:, :-1].T)
        self._latest.append(np.tile(signals, self._copies))
        if len(self._latest) > 1:
            filtered = median_of_three(*self._latest) if len(self._latest) > 2 else self._latest[0]
            self._past = remembered(np.concatenate([self._past, filtered[None]]))
        return np.concatenate([self._past, self._latest[-1][None]]).T
