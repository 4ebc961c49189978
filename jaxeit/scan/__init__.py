"""Which readings to take: design of scans, choice of readings and event-driven scans."""

from .contact_information import DesignSettings, PlaceSensitivity, place_sensitivity
from .covariance import around, signal_covariance
from .criteria import CRITERIA, AbstractCriterion, PlaceError, PlaceVolume
from .design import ScanDesign, design_scan
from .event_driven import EventScan, EventScanSettings, ScanState, prepare_event_scan
from .placement import Placement, PlacementLimits, move_electrodes
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
    "CRITERIA",
    "AbstractCriterion",
    "AbstractSelection",
    "Chosen",
    "DOptimal",
    "DesignSettings",
    "EventScan",
    "EventScanSettings",
    "PlaceError",
    "PlaceSensitivity",
    "PlaceVolume",
    "Placement",
    "PlacementLimits",
    "ScanDesign",
    "ScanState",
    "Sensitive",
    "Volume",
    "around",
    "choose_readings",
    "design_scan",
    "drives",
    "in_frame",
    "move_electrodes",
    "place_sensitivity",
    "prepare_event_scan",
    "scan_time",
    "shortened",
    "signal_covariance",
]
