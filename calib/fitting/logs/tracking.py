"""The model of a log for one reading after the other, as a running sensor sends them."""

from collections import deque

import numpy as np
from jaxtyping import Float

from ..curves.play_operators import remembered
from .model import LogModel, LogPrediction, with_noise
from .noise import WINDOW


class LogTracker:
    """Predicts what `LogModel.predict` predicts for the last reading of a log, from one reading after the other.

    It keeps the states of lags, the turning points that a curve with hysteresis remembers, and the forces over which
    the rate is taken.
    """

    def __init__(self, model: LogModel):
        self._model, self._signals = model, model.combination.tracker()
        self._past = np.zeros((0, 0))  # turning points of the signals, (points, histories)
        self._copies = 1
        self._recent: deque[tuple[float, float, float, bool]] = deque()

    def step(
        self, time: float, values: Float[np.ndarray, " channels"], place: Float[np.ndarray, " 2"] | None = None
    ) -> LogPrediction:
        """Force, standard error, interval and validity of one reading, at a time (ns) that rises."""
        where = self._model.location
        at = np.full((1, 2), np.nan) if place is None else place[None]
        inputs = values[None] if where is None else where.inputs(values[None], at)
        signals = self._signals.step(time / 1e9, inputs[0])
        force, error, valid = self._model.forces(self._with_past(signals), values[None], at)
        self._recent.append((time, float(force[0]), float(error[0]), bool(valid[0])))
        while len(self._recent) > 2 and self._recent[1][0] <= time - 1e9 * WINDOW:
            self._recent.popleft()
        found = with_noise(self._model.noise, *(np.array(column) for column in zip(*self._recent, strict=True)))
        return LogPrediction(*(part[-1:] for part in found))

    def _with_past(self, signals: Float[np.ndarray, " histories"]) -> Float[np.ndarray, "more m"]:
        """The signals after the turning points of each history, where the curve remembers."""
        now = signals[:, None]
        if not self._model.curve.curve.path or not np.isfinite(signals[0]):
            return now
        if not len(self._past):
            begun = self._model.with_starts(now)
            self._copies = len(begun) // len(now)
            self._past = remembered(begun.T)
            return begun
        now = np.tile(now, (self._copies, 1))
        past = np.concatenate([self._past, now.T])
        self._past = remembered(past)
        return past.T
