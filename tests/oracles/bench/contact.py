"""The tip, the foam and the protrusions: which patches touch the sheet, and how well.

A tip of any outline presses on foam.  The foam spreads the load as an elastic half-space does at a depth z
(Boussinesq), ``p(r) = 3 F z^3 / (2 pi (r^2 + z^2)^(5/2))``.  Beneath it stand square metal-coated protrusions on
a lattice, each a conductor that floats.  A quarter of a protrusion's face is a patch.  It touches from a load
of its own, w0; its specific contact resistance then falls as one over the load (many contact spots, Holm):

    g = gain * area * (w / area - w0 / area) / (rho pressure).
"""

from dataclasses import dataclass

import numpy as np

from .skin import Skin

PITCH, SIDE = 6e-3, 3.5e-3
DEPTH = 18e-3
"""Depth at which the foam's stress is taken, m."""
CONTACT, AT_PRESSURE = 1.6e-5, 64e3
"""Specific contact resistance, ohm m^2, at a pressure on the face, Pa."""
FIRST_TOUCH = 0.01
"""Median load at which a patch touches, N."""


@dataclass(frozen=True, eq=False)
class Layer:
    """The protrusions' patches, four in a row for each protrusion.

    | meaning                                                                                  |
    |------------------------------------------------------------------------------------------|
    | places: (patches, 2) centres, m; island: (patches,) the protrusion each belongs to       |
    | touch: (patches,) load of first touch, N; gain: (patches,); 0 where a bolt is in the way |
    """

    places: np.ndarray
    island: np.ndarray
    touch: np.ndarray
    gain: np.ndarray


def make_layer(skin: Skin, bolts: np.ndarray, scatter: float, rng: np.random.Generator) -> Layer:
    """Draw a layer of protrusions over the whole sheet."""
    counts = np.floor(skin.size / PITCH).astype(int)
    start = (skin.size - (counts - 1) * PITCH) / 2
    centres = (start + PITCH * np.indices(counts).reshape(2, -1).T)[:, None]
    places = (centres + SIDE / 4 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])).reshape(-1, 2)
    island = np.repeat(np.arange(len(centres)), 4)
    touch = FIRST_TOUCH * np.exp(3 * scatter * rng.standard_normal(len(places)))
    gain = np.exp(scatter * rng.standard_normal(len(centres)))[island]
    apart = np.linalg.norm(places[:, None] - bolts, axis=-1).min(1)
    return Layer(places, island, touch, np.where(apart > skin.radius + SIDE / 4, gain, 0.0))


def samples(layer: Layer, side: int = 3) -> np.ndarray:
    """Points spread evenly over each patch, (patches, side^2, 2)."""
    steps = ((np.arange(side) + 0.5) / side - 0.5) * SIDE / 2
    return layer.places[:, None] + np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


def shares(layer: Layer, place: np.ndarray, shape: str, tip: float, force: float) -> np.ndarray:
    """Share of the force that each patch carries, (patches,); the sheet carries all of it."""
    points, weights = tip_points(shape, tip, force)
    away = layer.places[:, None] - (place + points)
    square = (away**2).sum(-1) + DEPTH**2
    stress = (weights / (square**2 * np.sqrt(square))).sum(-1)
    return stress / stress.sum()


def tip_points(shape: str, tip: float, force: float, rings: int = 4, around: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature points of the tip's pressure, (n, 2) in m from its centre, and weights of sum one.

    ``hertz`` is a sphere whose contact grows with the force and fills the tip at 20 N; ``ellipse`` is half as
    wide as long; ``tilted`` carries all of the load on one side at the rim; the others lie even.
    """
    inner = 0.8 if shape == "ring" else 0.0
    radius = np.sqrt(inner**2 + (1 - inner**2) * (np.arange(rings) + 0.5) / rings)  # equal areas
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around
    unit = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)
    size, weights = np.array([tip / 2, tip / 2]), np.ones(len(unit))
    match shape:
        case "flat" | "ring":
            pass
        case "hertz":
            size = size * min(1.0, (force / 20) ** (1 / 3))
            weights = np.sqrt(1 - (unit**2).sum(1))
        case "tilted":
            weights = 1 + unit[:, 0]
        case "ellipse":
            size = size * [1.0, 0.5]
        case _:
            raise ValueError(f"tip shape {shape!r} is unknown; give flat, hertz, ring, tilted or ellipse")
    return unit * size, weights / weights.sum()


def conductances(layer: Layer, loads: np.ndarray) -> np.ndarray:
    """Conductance of each patch to the sheet, S, under ``loads`` (patches,) in N."""
    return layer.gain * np.maximum(loads - layer.touch, 0) / (CONTACT * AT_PRESSURE)


def joined(conductance: np.ndarray, island: np.ndarray) -> np.ndarray:
    """Conductance matrix between patches, S: those of one protrusion meet in a conductor that floats."""
    together = island[:, None] == island
    total = together @ conductance
    return np.diag(conductance) - together * np.outer(conductance, conductance) / np.maximum(total, 1e-300)
