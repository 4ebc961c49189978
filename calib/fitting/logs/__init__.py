"""Logs without presses: one signal of all channels of a sensor, and the curve from that signal to force."""

from .blend import BestChannel, BlendChannels
from .fit import LogFit, fit_log, time_split
from .gaussian_process import SmoothChannels

__all__ = ["BestChannel", "BlendChannels", "LogFit", "SmoothChannels", "fit_log", "time_split"]
