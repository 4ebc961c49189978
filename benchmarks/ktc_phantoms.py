"""Phantoms of our own for the Kuopio Tomography Challenge 2023: shapes by seed, and frames of them on another mesh.

A set has several tanks. Each tank has its own faults, which no method is told, and one phantom of each shape. The
faults are as large as the challenge's training set shows them, where it does: offsets of the sensing pairs, gains of
the drives, and what even water leaves of the reference (`bench_ktc.homogeneous`: 7 %, 4 % without the offsets). Lengths
of shapes are over the radius of the tank.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxeit as je

RADIUS, ELECTRODES, GRID = 0.115, 32, 256
WATER, RESISTIVE, CONDUCTIVE = 0, 1, 2
LINE = np.linspace(-1, 1, GRID)
INSIDE = np.hypot(LINE, LINE[:, None]) <= 1

# --- shapes: corners, (corners, 2), around the origin

Outline = np.ndarray
FULL_TURN = np.linspace(0, 2 * np.pi, 64, endpoint=False)


def _around(angle: np.ndarray, radius: np.ndarray | float = 1.0) -> Outline:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)


def convex(rng: np.random.Generator) -> Outline:
    """A disc, an ellipse or a polygon of three to five corners."""
    what = rng.integers(3)
    if what < 2:
        return rng.uniform(0.18, 0.3) * _around(FULL_TURN) * [1, rng.uniform(0.5, 0.75) if what else 1]
    corners = int(rng.integers(3, 6))
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.15, 0.15, corners)) / corners
    return rng.uniform(0.24, 0.38) * _around(angle, rng.uniform(0.85, 1, corners))


def crescent(rng: np.random.Generator) -> Outline:
    """What a disc leaves of a disc: two arcs that meet in two tips."""
    tip, shift = np.radians(rng.uniform(45, 70)), rng.uniform(0.35, 0.5)
    x, y = np.cos(tip) - shift, np.sin(tip)
    outer, inner = (np.linspace(start, 2 * np.pi - start, 40) for start in (tip, np.arctan2(y, x)))
    hollow = _around(inner[-2:0:-1], np.hypot(x, y)) + np.array([shift, 0])
    return rng.uniform(0.3, 0.42) * np.concatenate([_around(outer), hollow])


def star(rng: np.random.Generator) -> Outline:
    """A star of four to six points."""
    points = int(rng.integers(4, 7))
    angle = np.pi * np.arange(2 * points) / points
    return rng.uniform(0.32, 0.45) * _around(angle, np.tile([1, rng.uniform(0.4, 0.55)], points))


def cross(rng: np.random.Generator) -> Outline:
    """A cross of two bars of one length."""
    half = rng.uniform(0.22, 0.35)
    quarter = np.array([[1, -half], [1, half], [half, half]])
    turns = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return rng.uniform(0.32, 0.42) * np.concatenate([quarter @ turn.T for turn in turns])


def sliver(rng: np.random.Generator) -> Outline:
    """A thin bar."""
    return 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [rng.uniform(0.7, 1.2), rng.uniform(0.08, 0.14)]


SHAPES: tuple[Callable[[np.random.Generator], Outline], ...] = (convex, crescent, star, cross, sliver)
OBJECTS = {shape.__name__: 1 for shape in SHAPES} | {"two": 2, "three": 3}
"""Number of pieces in a phantom of each kind."""

# --- phantoms


class Piece(NamedTuple):
    """Corners, (corners, 2) over the radius; class; conductivity over that of the water."""

    outline: Outline
    kind: int
    ratio: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points, (..., 2) over the radius, lie in it."""
        inside = je.Polygon(tuple(map(tuple, self.outline.tolist()))).contains(points.reshape(-1, 2))
        return np.asarray(inside).reshape(points.shape[:-1])


LEAST_GAP, WALL_GAP = 0.12, 0.06  # between pieces; from the wall
AT_WALL, TOUCHES = 0.2, 0.99  # share of pieces at the wall; how far their outermost corner is from the middle
SMALLER = {1: 1.0, 2: 0.85, 3: 0.75}  # lengths of each of so many pieces
RESISTIVE_RATIO, CONDUCTIVE_RATIO = (0.02, 0.2), (5.0, 50.0)


def phantom(kind: str, rng: np.random.Generator) -> tuple[Piece, ...]:
    """Pieces of a kind, apart from each other."""
    count, pieces = OBJECTS[kind], ()
    while len(pieces) < count:
        shape = next((one for one in SHAPES if one.__name__ == kind), None) or SHAPES[rng.integers(len(SHAPES))]
        outline = _placed(SMALLER[count] * shape(rng), rng)
        if outline is not None and all(_apart(outline, one.outline) for one in pieces):
            pieces += (_of_material(outline, rng),)
    return pieces


def _of_material(outline: Outline, rng: np.random.Generator) -> Piece:
    kind, ends = ((RESISTIVE, RESISTIVE_RATIO), (CONDUCTIVE, CONDUCTIVE_RATIO))[rng.integers(2)]
    return Piece(outline, kind, float(np.exp(rng.uniform(*np.log(ends)))))


def _placed(outline: Outline, rng: np.random.Generator) -> Outline | None:
    """Turned, and moved to a random place: until it touches the wall, or away from it; None where it would not fit."""
    turn = rng.uniform(0, 2 * np.pi)
    outline = outline @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    way, wall = _around(rng.uniform(0, 2 * np.pi, 1))[0], rng.random() < AT_WALL
    if wall:
        along, square = outline @ way, np.sum(outline**2, 1)
        return outline + way * np.min(np.sqrt(TOUCHES**2 - square + along**2) - along)
    outline = outline + np.sqrt(rng.random()) * way
    return outline if np.linalg.norm(outline, axis=1).max() < 1 - WALL_GAP else None


def _apart(first: Outline, second: Outline) -> bool:
    """Whether points along two outlines are apart; a piece in the hollow of another may be near its corners."""
    dense = [
        np.concatenate([np.linspace(a, b, 9) for a, b in zip(o, np.roll(o, 1, 0), strict=True)])
        for o in (first, second)
    ]
    clear = np.linalg.norm(dense[0][:, None] - dense[1], axis=2).min() > LEAST_GAP
    inside = [Piece(a, WATER, 1.0).contains(b).any() for a, b in ((first, second), (second, first))]
    return bool(clear) and not any(inside)


def truth(pieces: tuple[Piece, ...]) -> np.ndarray:
    """Classes on the challenge's 256 x 256 pixels, row 0 at +y."""
    points = np.stack(np.meshgrid(LINE, -LINE), -1)
    classes = np.full((GRID, GRID), WATER)
    for piece in pieces:
        classes[piece.contains(points) & INSIDE] = piece.kind
    return classes


# --- frames


@dataclass(frozen=True, eq=False)
class Data:
    """Frames of a tank.

    | meaning                                               | shape              | unit |
    |-------------------------------------------------------|--------------------|------|
    | pattern: drive+, drive-, sense+, sense-               | (2356, 4)          |      |
    | mean current, as the file tells it                    | ()                 | mA   |
    | reference: water only                                 | (2356,)            | V    |
    | frames                                                | (frames, 2356)     | V    |
    | truth: 0 water, 1 resistive, 2 conductive; row 0 = +y | (frames, 256, 256) |      |
    """

    pattern: np.ndarray
    current: float
    reference: np.ndarray
    frames: np.ndarray
    truth: np.ndarray

    @property
    def channel(self) -> np.ndarray:
        """Pair of sensing electrodes of each reading."""
        return np.unique(self.pattern[:, 2:], axis=0, return_inverse=True)[1].ravel()


def pattern() -> np.ndarray:
    """The challenge's: currents between even neighbours, then to electrodes 0, 8, 16 and 24 from all other even ones;
    voltages between neighbours, the driven ones included."""
    even = np.arange(0, ELECTRODES, 2)
    around = np.stack([even, np.roll(even, -1)], 1)
    drives = np.array([*around, *((one, to) for to in range(0, ELECTRODES, 8) for one in even if one != to)])
    senses = np.stack([np.arange(ELECTRODES - 1), np.arange(1, ELECTRODES)], 1)
    return np.concatenate([np.repeat(drives, len(senses), 0), np.tile(senses, (len(drives), 1))], 1)


CURRENT, SIGMA = 1.47, 0.78  # mA, mS: the level of the challenge's reference
CONTACT = 1e-4  # contact impedance times conductivity, m
ANGLE, WIDTH, CONTACTS = np.radians(0.4), 0.05, 0.5  # spreads: place; relative width; logarithm of the contact
DEPTH, OFFSET, DRIVE = 0.01, 0.026, 0.01  # slope of the depth to the wall; V of a pair; gain of a drive: not told
MOVED_CONTACT, MOVED_DEPTH, MOVED_OFFSET, MOVED_DRIVE = 0.05, 0.005, 0.001, 0.004  # from frame to frame
NOISE = 2e-4  # V
EDGE_LENGTH = 0.0125  # of the mesh; `bench_ktc.tank` has 0.03


def uneven_tank(rng: np.random.Generator, edge_length: float = EDGE_LENGTH) -> je.Model:
    """A tank of water whose electrodes, contacts and depth are off."""
    disc, half = je.Disc(RADIUS), 0.25 * 2 * np.pi / ELECTRODES
    middle = np.pi / 2 + 2 * np.pi * np.arange(ELECTRODES) / ELECTRODES + rng.normal(scale=ANGLE, size=ELECTRODES)
    half = half * (1 + rng.normal(scale=WIDTH, size=ELECTRODES))
    starts = RADIUS * ((middle - half) % (2 * np.pi))
    contact = CONTACT / SIGMA * np.exp(rng.normal(scale=CONTACTS, size=ELECTRODES))
    patches = tuple(
        je.BoundaryPatch(float(s), float(s + 2 * RADIUS * h), float(z))
        for s, h, z in zip(starts, half, contact, strict=True)
    )
    skin = je.Skin("uneven", disc, 1.0, patches, je.Protocol(pattern(), CURRENT))
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=edge_length))
    slope = DEPTH * _around(rng.uniform(0, 2 * np.pi, 1))[0]
    sigma = SIGMA * (1 + np.asarray(model.centroids) / RADIUS @ slope)
    return eqx.tree_at(lambda m: m.background, model, jnp.asarray(sigma))


CUTS = np.array([(i + 1 / 3, j + 1 / 3) for i in range(6) for j in range(6 - i)]) / 6
CORNER_SHARES = np.column_stack([1 - CUTS.sum(1), CUTS])  # of points within a triangle, alike over its area


def covered(model: je.Model, piece: Piece) -> np.ndarray:
    """Share of each triangle of a mesh that a piece covers, (elements,)."""
    corners = np.asarray(model.chart)[np.asarray(model.triangles)] / RADIUS
    return piece.contains(np.einsum("sc,ecd->esd", CORNER_SHARES, corners)).mean(1)


class Recorder:
    """Readings of a tank, with the faults of its instrument; ``there``: which drive and which pair each belongs to."""

    def __init__(self, model: je.Model, rng: np.random.Generator) -> None:
        self.model, self.rng, rows = model, rng, pattern()
        self.drive, self.pair = (np.unique(rows[:, k : k + 2], axis=0, return_inverse=True)[1].ravel() for k in (0, 2))
        self.gain = self._each(self.drive, DRIVE)
        self.offset = self._each(self.pair, OFFSET)
        self.read = eqx.filter_jit(
            lambda sigma, contact: je.forward(eqx.tree_at(lambda m: m.contact, model, contact), sigma)
        )

    def _each(self, of: np.ndarray, spread: float) -> np.ndarray:
        return self.rng.normal(scale=spread, size=of.max() + 1)[of]

    def frame(self, pieces: tuple[Piece, ...] = ()) -> np.ndarray:
        """Readings with pieces in the water, V."""
        logarithm = sum((np.log(piece.ratio) * covered(self.model, piece) for piece in pieces), np.zeros(1))
        depth = 1 + self.rng.normal(scale=MOVED_DEPTH)
        touch = np.exp(self.rng.normal(scale=MOVED_CONTACT, size=self.model.electrodes))
        sigma = jnp.asarray(depth * np.asarray(self.model.background) * np.exp(logarithm))
        clean = np.asarray(self.read(sigma, self.model.contact * jnp.asarray(touch)))
        gain = 1 + self.gain + self._each(self.drive, MOVED_DRIVE)
        offset = self.offset + self._each(self.pair, MOVED_OFFSET)
        return gain * clean + offset + self.rng.normal(scale=NOISE, size=len(clean))


def simulated(seed: int, kinds: tuple[str, ...] = tuple(OBJECTS), edge_length: float = EDGE_LENGTH) -> Data:
    """A tank with one phantom of each kind."""
    rng = np.random.default_rng(seed)
    phantoms = [phantom(kind, np.random.default_rng([seed, list(OBJECTS).index(kind)])) for kind in kinds]
    recorder = Recorder(uneven_tank(rng, edge_length), rng)
    reference = recorder.frame()
    frames = np.array([recorder.frame(pieces) for pieces in phantoms])
    return Data(pattern(), CURRENT, reference, frames, np.array([truth(pieces) for pieces in phantoms]))
