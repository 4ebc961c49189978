"""Calibrations, force maps and sessions for other programs: C headers, tables, bags of ROS 2, LeRobot datasets.

Example:
    import jax

    import calib
    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    mine = calib.load_calibration("calibration.h5")
    sizes = calib.export_c(mine, "skin.h", place=je.LevelCentroid(0.5))  # C99, for a microcontroller
    print(f"{sizes.flash} bytes of flash, {sizes.ram} of memory")
    print(calib.export_csv("forcemap.h5", "forces.csv"))  # of calib.apply, for spreadsheets and pandas
    bag = calib.export_mcap("forcemap.h5", "forcemap.mcap")  # messages of ROS 2
    print(bag.topics)
    data = calib.export_lerobot(["forcemap.h5"], "dataset", task="press the skin")
    print(f"{data.episodes} episode of {data.frames} frames, {data.fps} a second")
"""

from .c import HeaderSizes, export_c
from .csv_tables import TableSummary, export_csv
from .errors import ExportError
from .lerobot import DatasetSummary, export_lerobot
from .mcap import BagSummary, export_mcap

__all__ = [
    "BagSummary",
    "DatasetSummary",
    "ExportError",
    "HeaderSizes",
    "TableSummary",
    "export_c",
    "export_csv",
    "export_lerobot",
    "export_mcap",
]
