"""The uniform sheet of a skin, as a model to which the frames of the untouched skin are compared."""

from dataclasses import dataclass

import numpy as np

from ..report import ChannelTable
from .reading_order import OrderCheck, check_order, predict_readings

ROUNDING = 1e-6  # of the largest voltage: some roundings of single precision, in which the model is solved


@dataclass(frozen=True, eq=False)
class SkinModel:
    """Transfer matrix of the uniform sheet, and what is needed to predict its readings.

    | field     | meaning                                              | shape                    | unit |
    |-----------|------------------------------------------------------|--------------------------|------|
    | transfer  | from `transfer_matrix`                               | (electrodes, electrodes) | ohm  |
    | current   | drive current                                        |                          | A    |
    | positions | of the electrodes, to try the numberings of a grid   | (electrodes, 2)          | m    |
    | usual     | the skin's own pattern, if each row is one reading   | (readings, 4)            |      |
    """

    transfer: np.ndarray
    current: float
    positions: np.ndarray
    usual: np.ndarray

    @property
    def rounding(self) -> float:
        """Voltage (V) below which a predicted reading, a difference of large ones, may be rounding alone."""
        return ROUNDING * self.current * float(np.abs(self.transfer).max(initial=0.0))

    def predict(self, table: ChannelTable) -> np.ndarray:
        """Readings (readings,) of the uniform sheet, V."""
        return self.current * predict_readings(self.transfer, table.pattern, table.mixing)

    def check(self, voltage: np.ndarray, good: np.ndarray, table: ChannelTable) -> OrderCheck:
        """Compare a frame with the sheet under many orders of its readings: `check_order`."""
        return check_order(
            voltage,
            good,
            table.pattern,
            self.transfer,
            mixing=table.mixing,
            current=self.current,
            positions=self.positions,
            usual=self.usual,
        )

    def misfit(self, voltage: np.ndarray, good: np.ndarray, table: ChannelTable) -> tuple[float, float]:
        """How far a frame is from the sheet: one minus the cosine between them, and the logarithm of their ratio."""
        v, model = voltage[good], self.predict(table)[good]
        sizes = (float(np.linalg.norm(x)) for x in (v, model))
        of_v, of_model = (max(size, np.finfo(float).tiny) for size in sizes)
        return 1 - float(v @ model) / (of_v * of_model), abs(float(np.log(of_v / of_model)))

    def scale_and_offset(self, voltage: np.ndarray, good: np.ndarray, table: ChannelTable) -> tuple[float, float]:
        """Amplitude over that of the sheet, and what all readings have in addition (V), by least squares."""
        v, model = voltage[good], self.predict(table)[good]
        away = model - model.mean()
        power = float(away @ away)
        scale = float(away @ v) / power if power > 0 else float("nan")
        return scale, float(v.mean() - scale * model.mean())
