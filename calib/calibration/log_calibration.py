"""The calibration of a sensor without EIT: channels over time to newtons, and its file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..fitting.curves import CURVES
from ..fitting.logs import LogModel, LogPrediction
from ..fitting.selection import Candidate
from ..session import SessionError, read_archive, write_archive
from .log_evaluation import LogEvaluation
from .log_storage import fields_of_log, log_archive

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
    | why, tried: reason for the choice of channels and curve, and the candidates                  |
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
    why: str = ""
    tried: tuple[Candidate, ...] = ()

    def predict(self, time: np.ndarray, values: Float[np.ndarray, "n columns"]) -> LogPrediction:
        """Force, standard error, 90 % interval and validity at times (n,) ns, from all channels of the stream.

        Times must rise. A model with memory begins with a sensor at rest. A force is not valid where a channel lies
        outside the range that was calibrated.

        Raises:
            SessionError: if the number of channels is not that of the calibrated sensor.
        """
        if values.ndim != 2 or values.shape[1] != self.columns:
            raise SessionError(
                f"/streams/{self.stream}: {values.shape[-1]} channels, but the calibration is of {self.columns}; "
                "give the calibration of this sensor"
            )
        return self.model.predict(time, values[:, self.kept])

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
        """Write the calibration, whole or not at all, as HDF5 in the format log-calibration."""
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        write_archive(path, FORMAT, *log_archive(fields))


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
