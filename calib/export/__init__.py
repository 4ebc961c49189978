"""Calibrations for other programs: a C header for firmware."""

from .c_header import HeaderSizes, export_c
from .errors import ExportError

__all__ = ["ExportError", "HeaderSizes", "export_c"]
