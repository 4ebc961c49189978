"""Contacts followed through time, by frames and pad forces together."""

from .settings import TrackerSettings
from .tracker import Track, Tracker, Tracking, prepare_tracker

__all__ = ["Track", "Tracker", "TrackerSettings", "Tracking", "prepare_tracker"]
