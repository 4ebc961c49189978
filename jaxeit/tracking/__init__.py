"""Contacts followed through time, by frames and pad forces together."""

from .compilation import compile_tracker
from .settings import TrackerSettings
from .smoothing import Smoother, TimedTracks
from .tracker import Tracker, prepare_tracker
from .tracks import Track, Tracking

__all__ = [
    "Smoother",
    "TimedTracks",
    "Track",
    "Tracker",
    "TrackerSettings",
    "Tracking",
    "compile_tracker",
    "prepare_tracker",
]
