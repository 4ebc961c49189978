"""A simulated bench: an indenter walks over a skin and everything is recorded, as on a real one.

The mesh that simulates is not the mesh that `calib.calibrate` inverts with, so that neither knows
the other's discretisation error.
"""

from .dataset import grid, simulate_contacts, write_data_set
from .explain import Part, explain, render
from .plan import Bench, BenchError, Companion, Timing, load_bench, presets
from .recording import simulate

__all__ = [
    "Bench",
    "BenchError",
    "Companion",
    "Part",
    "Timing",
    "explain",
    "grid",
    "load_bench",
    "presets",
    "render",
    "simulate",
    "simulate_contacts",
    "write_data_set",
]
