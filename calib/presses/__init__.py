"""Presses of a recording: streams on one clock, corrections, detection, windows and the table of presses."""

from .corrections import (
    BASELINES,
    CORRECTIONS,
    AbstractBaseline,
    AbstractCorrection,
    CorrectionError,
    LowPass,
    PreOnly,
    TwoSided,
)
from .detection import DetectionLimits, find_presses
from .pooled import PooledPresses, PressData, pool_presses
from .streams import PressError
from .table import PressMeasurements, Processing, measure
from .windows import WindowLengths

__all__ = [
    "BASELINES",
    "CORRECTIONS",
    "AbstractBaseline",
    "AbstractCorrection",
    "CorrectionError",
    "DetectionLimits",
    "LowPass",
    "PooledPresses",
    "PreOnly",
    "PressData",
    "PressError",
    "PressMeasurements",
    "Processing",
    "TwoSided",
    "WindowLengths",
    "find_presses",
    "measure",
    "pool_presses",
]
