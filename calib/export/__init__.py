"""Calibrations, force maps and sessions for other programs: a C header for firmware, bags of ROS 2."""

from .c_header import HeaderSizes, export_c
from .errors import ExportError
from .mcap import BagSummary, export_mcap

__all__ = ["BagSummary", "ExportError", "HeaderSizes", "export_c", "export_mcap"]
