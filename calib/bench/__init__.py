"""A simulated bench: an indenter presses a skin at many places, and all streams are recorded as on a real bench.

The simulation uses another mesh than `calib.calibrate`, so that the calibration cannot compensate for the
discretisation error of the simulation (no inverse crime). For training, frames of random contacts take the place of the
presses (`RandomScenes`).
"""

from .bench import Bench, BenchError, Companion, Timing, load_bench, presets
from .costs import PartCost, measure_costs, render_costs
from .dataset import grid, simulate_contacts, write_data_set
from .random_scenes import Footprint, RandomScenes
from .simulation import SIMULATION, simulate
from .training_frames import TrainingFrames, open_training_frames

__all__ = [
    "SIMULATION",
    "Bench",
    "BenchError",
    "Companion",
    "Footprint",
    "PartCost",
    "RandomScenes",
    "Timing",
    "TrainingFrames",
    "grid",
    "load_bench",
    "measure_costs",
    "open_training_frames",
    "presets",
    "render_costs",
    "simulate",
    "simulate_contacts",
    "write_data_set",
]
