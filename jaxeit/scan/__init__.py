"""Which readings to take: choice of readings and event-driven scans."""

from .covariance import around, signal_covariance
from .event_driven import EventScan, EventScanSettings, ScanState, prepare_event_scan
from .selection import (
    AbstractSelection,
    Chosen,
    DOptimal,
    Sensitive,
    Volume,
    choose_readings,
    drives,
    in_frame,
    scan_time,
    shortened,
)

__all__ = [
    "AbstractSelection",
    "Chosen",
    "DOptimal",
    "EventScan",
    "EventScanSettings",
    "ScanState",
    "Sensitive",
    "Volume",
    "around",
    "choose_readings",
    "drives",
    "in_frame",
    "prepare_event_scan",
    "scan_time",
    "shortened",
    "signal_covariance",
]
