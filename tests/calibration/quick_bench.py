"""A bench of a few presses, which is simulated and calibrated within seconds."""

import numpy as np

import calib
import jaxeit as je
from calib.bench import Bench, Timing

SITES = np.stack(np.meshgrid([0.035, 0.065, 0.135, 0.165], [0.035, 0.065, 0.135, 0.165]), -1).reshape(-1, 2)
QUICK = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
EFFECTS = (
    je.effects.LoadSpreading(width=0.008),
    je.effects.ContactPiezoresistance(),
    je.effects.Noise(std=1e-6, stream=je.effects.StreamKind.EIT),
    je.effects.Noise(std=2.0, stream=je.effects.StreamKind.PRESSURE),
    je.effects.Noise(std=0.01, stream=je.effects.StreamKind.FORCE),
)


def bench(skin, sites, seed=0, **changes):
    timing = Timing(rest=0.6, ramp=0.6, hold=1.2, release=0.6, recovery=0.6)
    settings = {"timing": timing, "blank": 1.0, "eit_rate": 10.0, "pad_rate": 50.0, "eit_step": 1e-6, "seed": seed}
    return Bench(je.Scene(skin, EFFECTS), sites, np.array([20.0]), **(settings | changes), toml="simulated in a test")
