"""Logs without presses: one signal of all channels of a sensor, and the curve from that signal to force."""

from .blend import BestChannel, BlendChannels
from .combination import COMBINATIONS, AbstractCombination, Blend, OneChannel, SmoothSignal
from .fit import LogFit, fit_log, time_split
from .gaussian_process import SmoothChannels
from .model import LogModel, LogPrediction
from .selection import FittedLog, fit_series, ways_of
from .series import LogSeries, series_of

__all__ = [
    "COMBINATIONS",
    "AbstractCombination",
    "BestChannel",
    "Blend",
    "BlendChannels",
    "FittedLog",
    "LogFit",
    "LogModel",
    "LogPrediction",
    "LogSeries",
    "OneChannel",
    "SmoothChannels",
    "SmoothSignal",
    "fit_log",
    "fit_series",
    "series_of",
    "time_split",
    "ways_of",
]
