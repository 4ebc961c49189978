"""Calibrations, force maps and sessions for other programs: a C header, bags of ROS 2, and LeRobot datasets."""

from .c import HeaderSizes, export_c
from .errors import ExportError
from .lerobot import DatasetSummary, export_lerobot
from .mcap import BagSummary, export_mcap

__all__ = ["BagSummary", "DatasetSummary", "ExportError", "HeaderSizes", "export_c", "export_lerobot", "export_mcap"]
