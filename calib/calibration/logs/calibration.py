"""The calibration of a sensor without EIT: channels over time to newtons, and its file."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from ...fitting.cross_validation.selection import Candidate
from ...fitting.curves import CURVES
from ...fitting.logs import LogModel, LogPrediction, LogTracker, travel_of, unseen_direction
from ...session import SessionError, read_archive, write_archive
from .evaluation import LogEvaluation
from .readings import reading, readings, require_later
from .shift import LogShift
from .storage import fields_of_log, location_name, log_archive

FORMAT = "log-calibration"


@dataclass(frozen=True, eq=False)
class LogCalibration:
    """Everything needed to turn the channels of a sensor into force, with its provenance.

    | meaning                                                                                      |
    |----------------------------------------------------------------------------------------------|
    | model: combination of the channels, curve and noise, fitted to the whole recordings          |
    | kept: numbers of the channels that the model uses, among those of the stream                 |
    | columns: number of channels of the stream                                                    |
    | stream, unit: the stream of the channels, and their unit                                     |
    | evaluation: of the same kind of model, fitted to the first half of each log, on the second   |
    | provenance: sessions, their hashes, versions, recipe, date                                   |
    | simulated: whether any of the sessions was simulated                                         |
    | notes: remarks for the reader of the results                                                 |
    | shift: how the sensor has moved since, by the last recalibration; None: it was not recalibrated |
    | why, tried: reason for the choice of channels and curve, and the candidates                  |

    Example:
        with calib.open_session("later.h5") as log:
            stream = log.stream(sensor.stream)
            said = sensor.predict(stream.time, stream.read())
        print(said.force[-1], said.low[-1], said.high[-1], said.valid.all())  # N
        sensor.save("sensor.h5")
    """

    model: LogModel
    kept: Int[np.ndarray, " channels"]
    columns: int
    stream: str
    unit: str
    evaluation: LogEvaluation
    provenance: dict[str, str]
    simulated: bool
    notes: tuple[str, ...] = ()
    shift: LogShift | None = None
    why: str = ""
    tried: tuple[Candidate, ...] = ()

    def __repr__(self) -> str:
        channels = f"{len(self.kept)} of {self.columns}"
        return f"LogCalibration({self.stream!r} in {self.unit}, channels={channels}, curve={self.curve_name!r})"

    def predict(
        self,
        time: ArrayLike,
        values: ArrayLike,
        place: ArrayLike | None = None,
    ) -> LogPrediction:
        """Force, standard error, 90 % interval and validity at times (n,) ns, from all channels of the stream.

        Times must rise. A force is not valid where a channel or the place lies outside the range that was calibrated.

        Args:
            values: (n, columns) in the sensor's unit, NaN where missing; of a sensor of one channel also (n,).
            place: of the contact (n, 2) m, as the stage tells it; only for a calibration that `needs_place`.

        Raises:
            SessionError: if the number of channels is not that of the calibrated sensor, times do not rise or are not
                in ns, lengths differ, or the place is needed and not given.
        """
        self._require_place(place)
        times, table, where = readings(time, values, place, self.columns, self.stream)
        return self._moved(self.model.predict(times, table[:, self.kept], where))

    def _require_place(self, place: object) -> None:
        if self.needs_place and place is None:
            raise SessionError(
                "the calibration depends on the place of contact, and none is given: record the stream stage, or "
                "calibrate with --location none"
            )

    def _moved(self, found: LogPrediction) -> LogPrediction:
        return found if self.shift is None else self.shift.applied(found, float(self.model.noise.multiple))

    def tracker(self) -> "CalibrationTracker":
        """`predict` for one reading after the other, as a running sensor sends them."""
        return CalibrationTracker(self)

    @property
    def needs_place(self) -> bool:
        """Whether the force depends on the place of contact."""
        return self.model.location is not None

    def unseen(self, force: Float[np.ndarray, " n"]) -> str:
        """What forces (n,) N over time do that those of the calibration did not, in a sentence; empty: nothing."""
        return unseen_direction(self.model.travel, travel_of(force))

    @property
    def recorded(self) -> str:
        """ISO time of the newest log that the calibration rests on; empty if it is not known."""
        names = ("recalibrated_utc", "recorded_utc", "created_utc")
        return next((self.provenance[name] for name in names if name in self.provenance), "")

    @property
    def groups(self) -> str:
        """What standard errors of the curve are over, in words."""
        return "places" if self.needs_place else "blocks of time"

    @property
    def location_name(self) -> str:
        """Name of the field of gain; "inputs": the place is an input beside the channels; "none": it is not used."""
        return location_name(self.model.location)

    @property
    def curve_name(self) -> str:
        """Name of the curve."""
        return CURVES.name_of(self.model.curve.curve)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters of the curve."""
        own = "N" if self.model.combination.in_newtons else self.unit
        return tuple(unit.replace("Pa", own) for unit in self.model.curve.curve.units)

    def save(self, path: str | Path) -> None:
        """Write the calibration, whole or not at all, as HDF5 in the format log-calibration.

        Raises:
            OSError: if the file cannot be written.
        """
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        write_archive(path, FORMAT, *log_archive(fields))


class CalibrationTracker:
    """`LogCalibration.predict` for one reading after the other."""

    def __init__(self, calibration: LogCalibration):
        self._calibration, self._tracker = calibration, LogTracker(calibration.model)
        self._last = -math.inf  # time of the last reading, ns

    def step(self, time: float, values: ArrayLike, place: ArrayLike | None = None) -> LogPrediction:
        """Force, standard error, interval and validity of one reading (columns,), at a time (ns) that rises.

        Raises:
            SessionError: as for `LogCalibration.predict`; the reading then leaves the tracker as it was.
        """
        known = self._calibration
        known._require_place(place)
        at, row, where = reading(time, values, place, known.columns, known.stream)
        require_later(at, self._last)
        self._last = at
        return known._moved(self._tracker.step(at, row[known.kept], where))


def load_log_calibration(path: str | Path) -> LogCalibration:
    """Read a calibration that `LogCalibration.save` wrote.

    Raises:
        SessionError: if the file is damaged or of another kind.
    """
    archive = read_archive(path, FORMAT)
    name = Path(path).name
    try:
        return LogCalibration(**fields_of_log(archive))
    except (KeyError, IndexError) as error:
        raise SessionError(f"{name}: {error.args[0]}: missing from the calibration; calibrate again") from None
    except (ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise SessionError(f"{name}: its numbers do not fit each other ({why}); calibrate again") from None
