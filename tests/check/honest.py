"""Honest sessions of the simulated bench: small ones, with varied scenes, effects, skins, places and seeds."""

from dataclasses import replace

import numpy as np

import jaxeit as je
from calib.bench import Bench, Timing, load_bench, presets

QUICK = Timing(rest=0.6, ramp=0.4, hold=1.0, release=0.4, recovery=0.8)
SKINS = ("testbed", "chest")
FORCES = np.array([5.0, 10.0, 20.0])
"""Force of each of the sixteen presses in turn, N."""
KEPT = 0.75  # probability that an effect of the scene is kept
ALWAYS = ("ContactPiezoresistance", "Noise", "Quantisation")  # a sheet that shows no touch is not an honest session


def honest_bench(number: int) -> Bench:
    """Session `number` of an endless series: its scene, effects, skin, places, forces, rates and seeds vary with it."""
    rng = np.random.default_rng(number)
    names = presets()
    bench = load_bench(names[number % len(names)])
    skin = je.load_skin(SKINS[int(rng.random() < 0.2)])
    kept = tuple(_reseeded(e, rng) for e in bench.scene.effects if rng.random() < KEPT or type(e).__name__ in ALWAYS)
    if not any(isinstance(e, je.effects.ContactPiezoresistance) for e in kept):
        kept += (je.effects.ContactPiezoresistance(), je.effects.Noise(std=1e-5))
    hold = max(float(rng.uniform(0.8, 2.0)), 1.0) + max((c.delay for c in bench.companions), default=0.0)
    return replace(
        bench,
        scene=je.Scene(skin, kept),
        sites=_sites(skin, rng, bench),
        forces=np.round(rng.uniform(3.0, 25.0, rng.integers(1, 4)), 1),
        timing=replace(QUICK, ramp=float(rng.uniform(0.2, 0.8)), hold=hold),
        blank=float(rng.uniform(1.0, 5.0)),
        eit_rate=float(rng.uniform(10.0, 50.0)),
        pad_rate=float(rng.uniform(50.0, 200.0)),
        eit_step=3e-6,
        seed=int(rng.integers(2**31)),
        toml=f"honest session {number}",
    )


def _reseeded(effect, rng):
    """The effect with a seed of its own, if it has one."""
    return replace(effect, seed=int(rng.integers(2**20))) if hasattr(effect, "seed") else effect


def _sites(skin, rng, bench):
    """Two or more presses on every pad and some anywhere, with room for the companions and the slide of a bench."""
    reach = np.array([bench.slide, *(c.offset for c in bench.companions), (0.0, 0.0)])
    (low, high), margin = np.asarray(skin.domain.bounds), 0.015
    out = []
    for pad in (*skin.pads, *skin.pads, None, None):
        corners = np.asarray([low, high]) if pad is None else np.asarray(pad.outline)
        out += _inside(skin, rng, corners.min(0) + margin, corners.max(0) - margin, reach)
    return np.array(out)


def _inside(skin, rng, low, high, reach):
    """One place between two corners whose tips all stay on the sheet; none if fifty draws find none."""
    for _ in range(50):
        place = rng.uniform(low, high)
        if skin.domain.contains(place + reach).all():
            return [place.round(4)]
    return []


def sixteen_presses(skin: je.Skin, *, blank: float, pad_rate: float) -> Bench:
    """Sixteen presses with noise; off the middles of the pads, so that no move of the stage leaves all on their pads.

    ``blank`` is the time before the first press, s; ``pad_rate`` the rate of pressure and force, Hz.
    """
    effects = (
        je.effects.LoadSpreading(),
        je.effects.CoatingNonUniformity(std=0.15, length=0.03, seed=3),
        je.effects.ContactPiezoresistance(),
        je.effects.Noise(std=1e-5),
        je.effects.Noise(std=5.0, stream=je.effects.StreamKind.PRESSURE),
        je.effects.Noise(std=0.01, stream=je.effects.StreamKind.FORCE),
    )
    x, y = np.meshgrid([0.025, 0.065, 0.12, 0.17], [0.03, 0.07, 0.125, 0.165])
    timing = Timing(rest=0.6, ramp=0.4, hold=1.1, release=0.4, recovery=0.8)
    return Bench(
        je.Scene(skin, effects), np.stack([x.ravel(), y.ravel()], 1), FORCES, timing=timing, blank=blank,
        eit_rate=20.0, pad_rate=pad_rate, eit_step=3e-6, seed=5, toml="x",
    )  # fmt: skip
