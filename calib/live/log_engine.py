"""Compute the force of one reading after the other, for a sensor whose calibration is that of a log."""

import time

import numpy as np

from ..calibration.logs.calibration import LogCalibration
from ..fitting.logs import LogPrediction
from .engine import ReceivedFrame
from .results import LogResult

REST_CHANGE = 2.0  # standard errors, by which the force may change while the zero is measured
TOGETHER = 1_000  # ns between readings that one read of the link brought, which have one time of arrival


class LogEngine:
    """Turns readings into forces with one calibration of a log. Only the thread that created it may use it.

    Its zero is that of the calibration, until the operator asks for another one: then the mean force over `rest` s is
    taken off, once it has not changed meanwhile.
    """

    unsearched = 0

    def __init__(self, calibration: LogCalibration, rest: float = 2.0):
        self._calibration, self._rest = calibration, rest
        self._number, self._zero = 0, 0.0
        self._resting: list[tuple[int, float, float]] | None = None  # arrivals, forces and errors since the request
        self.restless = False
        self._warm_up()
        self._tracker = calibration.tracker()
        self._time: int | None = None  # of the last reading, ns

    def _warm_up(self) -> None:
        """Compile the programs, with readings in the middle of the calibrated ranges."""
        tracker, middle = self._calibration.tracker(), np.full(self._calibration.columns, np.nan)
        middle[self._calibration.kept] = self._calibration.model.reach.mean(0)
        place = np.zeros(2) if self._calibration.needs_place else None
        for k in range(3):
            tracker.step(1e9 * k, middle, place)

    @property
    def state(self) -> str:
        """What the engine does now, for the operator."""
        if self._resting is None:
            return "running"
        return f"{'waiting for the sensor to be at rest' if self.restless else 'measuring the zero'}: do not touch it"

    doubt = ""  # of places: a log has none
    faults: tuple[str, ...] = ()  # of EIT, and of pads against EIT
    layer = None  # of contacts, which a log does not locate

    @property
    def health(self) -> str:
        """How far off the calibration is: not known without known forces."""
        return ""

    def tare(self) -> None:
        """Measure the zero."""
        self._resting, self.restless = [], False

    def has_wrong_zero(self, now: int) -> bool:
        """Whether the zero must be measured again: no force tells it here."""
        del now
        return False

    def use_spare_time(self, seconds: float) -> None:
        """Nothing waits for spare time."""

    def step(self, arrival: ReceivedFrame, dropped: int = 0) -> LogResult | None:
        """Process one reading; None while the zero is being measured."""
        place = arrival.beside[:2] if self._calibration.needs_place else None
        self._time = arrival.host if self._time is None else max(arrival.host, self._time + TOGETHER)
        found = self._tracker.step(float(self._time), arrival.values, place)
        if self._resting is not None:
            self._measure_zero(arrival.host, found)
            return None
        self._number += 1
        return LogResult(
            number=self._number,
            host=arrival.host,
            latency=(time.monotonic_ns() - arrival.host) / 1e9,
            force=found.force - self._zero,
            standard_error=found.standard_error,
            low=found.low - self._zero,
            high=found.high - self._zero,
            valid=found.valid,
            missing=int((~np.isfinite(arrival.values[self._calibration.kept])).sum()),
            dropped=dropped,
        )

    def _measure_zero(self, host: int, found: LogPrediction) -> None:
        assert self._resting is not None
        if np.isfinite(found.force[0]):
            self._resting.append((host, float(found.force[0]), float(found.standard_error[0])))
        if not self._resting or host - self._resting[0][0] < 1e9 * self._rest:
            return
        _, force, error = np.array(self._resting, float).T
        first, second = (part.mean() for part in np.array_split(force, 2))
        self.restless = bool(abs(second - first) > REST_CHANGE * error.mean())
        if self.restless:
            self._resting = self._resting[len(self._resting) // 2 :]
        else:
            self._zero, self._resting = float(force.mean()), None
