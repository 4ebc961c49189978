"""Recordings and force maps as a LeRobot dataset, version 3: its files, and the statistics that it keeps."""

from .dataset import DatasetSummary, export_lerobot

__all__ = ["DatasetSummary", "export_lerobot"]
