"""A calibration as one header of C99: curves, fields of location, places in the image, and the frame's code."""

from .header import HeaderSizes, export_c

__all__ = ["HeaderSizes", "export_c"]
