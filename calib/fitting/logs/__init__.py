"""Logs without presses: one signal of all channels of a sensor, and the curve from that signal to force.

Example:
    import jax
    import numpy as np

    import calib
    from calib.fitting import SoftL1, logs

    jax.config.update("jax_enable_x64", True)

    rng = np.random.default_rng(0)
    time = 1e7 * np.arange(2000)  # ns: 20 s at 100 Hz
    force = 10 * np.sin(2e-9 * np.pi * time / 4) ** 2  # N
    channels = np.outer(force, [3.0, -1.0, 0.2]) + rng.normal(0, 0.3, (2000, 3))  # a sensor's own unit

    fit = logs.fit_log(calib.Affine(), time, channels, force, channels=logs.BestChannel())
    print(fit.source, f"held out: {fit.held_out.rmse:.2f} N")

    series = logs.series_of([(time, channels, force)])  # or several logs of one sensor
    ways = {name: logs.ways_of(3, most=128)[name] for name in ("best channel", "blend")}
    found = logs.fit_series(series, series.complete, [calib.Affine(), calib.PowerLaw()], ways, SoftL1())
    print(found.why)
    now = found.model.predict(time[-3:], channels[-3:])
    print(now.force, now.low, now.high, now.valid)  # N
"""

from .blend import BestChannel, BlendChannels, WithPlace
from .combination import COMBINATIONS, AbstractCombination, Blend, OneChannel, SmoothSignal
from .directions import Travel, missing_direction, travel_of, unseen_direction
from .fit import LogFit, fit_log, time_split
from .gaussian_process import SmoothChannels
from .location import MIN_PLACES, LogLocation
from .log_tracker import LogTracker
from .model import LogModel, LogPrediction
from .noise import LogNoise, fit_log_noise
from .selection import FittedLog, fit_series, ways_of
from .series import LogSeries, series_of

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
