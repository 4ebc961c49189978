"""A simulated bench: an indenter presses a skin at many places, and all streams are recorded as on a real bench.

The simulation uses another mesh than `calib.calibrate`, so that the calibration cannot compensate for the
discretisation error of the simulation (no inverse crime). For training, frames of random contacts take the place of the
presses (`RandomScenes`).

Example:
    from dataclasses import replace

    import jax
    import numpy as np

    import calib
    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    print(calib.bench.presets())
    bench = calib.load_bench("paper_bench")
    lines = np.linspace(0.02, 0.18, 7)  # m
    sites = np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
    quick = calib.bench.Timing(rest=0.6, ramp=0.4, hold=1.4, release=0.4, recovery=0.8)  # s
    short = replace(bench, sites=sites, timing=quick, blank=5.0, eit_rate=10.0, pad_rate=50.0)
    finer = je.Fidelity.draft(edge_length=0.05)  # than that of the calibration
    calib.simulate(short, "session.h5", fidelity=finer)
    # for a test
    calib.simulate(replace(short, sites=sites[::4] + 0.006, seed=2), "other.h5", fidelity=finer)
    print(f"{len(sites)} presses in {short.duration:.0f} s")
"""

from .bench import Bench, BenchError, Companion, Timing, load_bench, presets
from .costs import PartCost, measure_costs, render_costs
from .dataset import grid, simulate_contacts, write_data_set
from .simulation import SIMULATION, simulate
from .training.random_scenes import Footprint, RandomScenes
from .training.training_frames import FrameSet, TrainingFrames, open_training_frames

__all__ = [
    "SIMULATION",
    "Bench",
    "BenchError",
    "Companion",
    "Footprint",
    "FrameSet",
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
