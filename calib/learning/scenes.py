"""What a proposal is trained on: a skin with effects of drawn strength, and contacts of all kinds."""

import numpy as np

import jaxeit as je
from jaxeit import effects as fx

from ..bench import Bench, RandomScenes

SCENES = RandomScenes(
    counts=(0.05, 0.5, 0.3, 0.15),
    footprints=(0.25, 0.12, 0.08, 0.55),
    together=(0.6, 0.2, 0.1, 0.1),
    force=(0.5, 40.0),
    size=(0.003, 0.015),
    length=(0.006, 0.035),
    near=0.75,
    apart=(0.012, 0.05),
    strength=(0.5, 2.0),
    misplaced=5e-4,
)
"""Contacts from light to heavy, half of them round; pairs and edges of all lengths, most of them hard to tell apart."""
DECIBELS = 60.0  # by which the noise lies below the readings, times a drawn strength
EFFECTS = """
[[effects]]
type = "LoadSpreading"
width = 0.01  # m

[[effects]]
type = "CoatingNonUniformity"
std = 0.15

[[effects]]
type = "ContactGain"
std = 0.12

[[effects]]
type = "ContactPiezoresistance"

[[effects]]
type = "GainError"
std = 1e-3

[[effects]]
type = "Noise"
stream = "eit"
std = {noise!r}  # V
"""
PAD_EFFECTS = """
[[effects]]
type = "PadEdgeDip"

[[effects]]
type = "PadCrosstalk"

[[effects]]
type = "Noise"
stream = "pressure"
std = 5.0  # Pa
"""


def training_bench(skin: je.Skin) -> Bench:
    """The skin on a bench with everything uneven; the strengths are drawn for each skin about those given here."""
    untouched = np.asarray(je.forward(je.discretise(je.Scene(skin), je.Fidelity.draft(dtype="float32"))), float)
    noise = 10 ** (-DECIBELS / 20) * float(np.sqrt(np.mean(untouched**2)))
    text = EFFECTS.format(noise=noise) + (PAD_EFFECTS if skin.pads else "")
    effects = je.toml.parse_toml(text, "scenes of the training", je.model.read_effects)
    return Bench(je.Scene(skin, effects), np.zeros((0, 2)), np.zeros(0), toml=text)


def noise_of(bench: Bench) -> float:
    """Standard deviation of a reading's noise, V."""
    noises = [e for e in bench.scene.effects if isinstance(e, fx.Noise) and e.stream is fx.StreamKind.EIT]
    return float(noises[0].std)


def scenes_for(skin: je.Skin, fidelity: je.Fidelity) -> RandomScenes:
    """`SCENES`, with electrodes that stay where they are if the mesh around them cannot follow."""
    try:
        je.model.electrode_motion(je.discretise(je.Scene(skin), fidelity))
    except je.model.MotionError:
        return RandomScenes(**(vars(SCENES) | {"misplaced": 0.0}))
    return SCENES
