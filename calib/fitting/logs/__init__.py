"""Logs without presses: one signal of all channels of a sensor, and the curve from that signal to force."""

from .blend import BestChannel, BlendChannels, WithPlace
from .combination import COMBINATIONS, AbstractCombination, Blend, OneChannel, SmoothSignal
from .directions import Travel, missing_direction, travel_of, unseen_direction
from .fit import LogFit, fit_log, time_split
from .gaussian_process import SmoothChannels
from .location import MIN_PLACES, LogLocation
from .model import LogModel, LogPrediction
from .noise import LogNoise, fit_log_noise
from .selection import FittedLog, fit_series, ways_of
from .series import LogSeries, series_of
from .tracking import LogTracker

__all__ = [
    "COMBINATIONS",
    "MIN_PLACES",
    "AbstractCombination",
    "BestChannel",
    "Blend",
    "BlendChannels",
    "FittedLog",
    "LogFit",
    "LogLocation",
    "LogModel",
    "LogNoise",
    "LogPrediction",
    "LogSeries",
    "LogTracker",
    "OneChannel",
    "SmoothChannels",
    "SmoothSignal",
    "Travel",
    "WithPlace",
    "fit_log",
    "fit_log_noise",
    "fit_series",
    "missing_direction",
    "series_of",
    "time_split",
    "travel_of",
    "unseen_direction",
    "ways_of",
]
