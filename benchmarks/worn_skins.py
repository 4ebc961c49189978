"""Skins of the second simulator under presses, and the true force maps of these."""

from typing import NamedTuple

import numpy as np

from tests.oracles.bench import contact
from tests.oracles.bench.mesh import make_mesh
from tests.oracles.bench.session import coating, transfer_frames
from tests.oracles.bench.sheet import make_sheet, readings

from .bench_proposal import SCATTER, SPACING, Recorded, described

FORCES, TIPS = (4.0, 25.0), (0.006, 0.03)  # N, m
DISTANCE = 0.03  # m, of two contacts
SUB = 5  # points along each side of a pixel at which the true stress is taken


class Press(NamedTuple):
    """Places (k, 2) m and forces (k,) N of tips, and their diameter, m."""

    places: np.ndarray
    forces: np.ndarray
    tip: float


class Wear(NamedTuple):
    """What a skin is like: standard deviations of the log of its coat and of the bolts' places, m; tips, m, or None:
    those of `TIPS`."""

    coat: float = 0.15
    misplaced: float = 0.0
    tip: float | None = None


def presses(rng: np.random.Generator, count: int, tip: float | None = None) -> list[Press]:
    """Single tips anywhere."""
    return [
        Press(place[None], force[None], tip or size)
        for place, force, size in zip(
            rng.uniform(0.02, 0.18, (count, 2)), rng.uniform(*FORCES, count), rng.uniform(*TIPS, count), strict=True
        )
    ]


def pairs(rng: np.random.Generator, count: int) -> list[Press]:
    """Two tips of equal force."""
    angle, middle = rng.uniform(0, np.pi, count), rng.uniform(0.045, 0.155, (count, 2))
    away = DISTANCE / 2 * np.stack([np.cos(angle), np.sin(angle)], 1)
    force, tip = rng.uniform(*FORCES, count), rng.uniform(*TIPS, count)
    return [
        Press(np.stack([m - a, m + a]), np.full(2, f), t) for m, a, f, t in zip(middle, away, force, tip, strict=True)
    ]


def recorded(seed: int, given: list[Press], wear: Wear) -> Recorded:
    """A skin of a seed under presses, and the change that each makes."""
    skin, own = described("testbed"), np.random.default_rng([seed, 11])
    bolts = skin.bolts + wear.misplaced * own.standard_normal(skin.bolts.shape)
    layer, mesh = contact.make_layer(skin, bolts, SCATTER, own), make_mesh(skin, bolts, SPACING)
    sigma = coating(mesh.points[mesh.triangles].mean(1), wear.coat, own) / skin.resistance
    sheet = make_sheet(mesh, sigma, skin.contact)
    loads = [
        sum(f * contact.shares(layer, place, "flat", p.tip, f) for place, f in zip(p.places, p.forces, strict=True))
        for p in given
    ]
    volts = [readings(z, skin.pattern, skin.current) for z in transfer_frames(layer, sheet, np.array(loads))]
    untouched = readings(sheet.untouched, skin.pattern, skin.current)
    return Recorded(untouched, np.array(volts) - untouched)


def true_map(press: Press, centres: np.ndarray) -> np.ndarray:
    """Force on each pixel, N: Boussinesq's stress of the tips, all of which the sheet carries."""
    pitch = 2 * centres.min()
    step = pitch * ((np.arange(SUB) + 0.5) / SUB - 0.5)
    points = (centres[:, None] + np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)).reshape(-1, 2)
    there = contact.Layer(points, *3 * [np.zeros(len(points))])
    each = zip(press.places, press.forces, strict=True)
    parts = [f * contact.shares(there, place, "flat", press.tip, f) for place, f in each]
    return sum(parts).reshape(len(centres), -1).sum(1)
