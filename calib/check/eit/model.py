"""The uniform sheet of a skin, as a model to which the frames of the untouched skin are compared."""

from dataclasses import dataclass

import numpy as np

import jaxeit as je

from ..report import ChannelTable
from .reading_order import OrderCheck, check_order, predict_readings

MIN_SOUND_READINGS = 10  # for a comparison with the model
ROUNDING = 1e-6  # of the largest voltage: some roundings of single precision, in which the model is solved


def are_enough(good: np.ndarray) -> bool:
    """Whether so many readings are sound, of flags (readings,), that a frame can be compared with the model."""
    return bool(good.sum() >= max(MIN_SOUND_READINGS, len(good) // 4))


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

    @classmethod
    def of(cls, skin: je.Skin, transfer: np.ndarray, current: float | None = None) -> "SkinModel":
        """The model of a skin from its transfer matrix; ``current``: A, default that of its protocol."""
        current = skin.protocol.current if current is None else current
        return cls(transfer, current, skin.electrode_positions, skin.protocol.pairs)

    @property
    def rounding(self) -> float:
        """Voltage (V) below which a predicted reading, a difference of large ones, may be rounding alone."""
        return ROUNDING * self.current * float(np.abs(self.transfer).max(initial=0.0))

    def predict(self, scan: ChannelTable | je.skin.Protocol) -> np.ndarray:
        """Readings (readings,) of the uniform sheet, V."""
        return self.current * predict_readings(self.transfer, scan.pattern, scan.mixing)

    def check(self, voltage: np.ndarray, good: np.ndarray, scan: ChannelTable | je.skin.Protocol) -> OrderCheck:
        """Compare a frame with the sheet under many orders of its readings: `check_order`."""
        return check_order(
            voltage,
            good,
            scan.pattern,
            self.transfer,
            mixing=scan.mixing,
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
