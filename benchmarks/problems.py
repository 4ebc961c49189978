"""The problems that are measured on: sheets whose readings are known, skins of any size, presses simulated on one."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

import jaxeit as je
from calib.calibration.localisation.load_windows import LOAD_FIDELITY
from jaxeit.linalg import NestedDissection
from tests.oracles.disc import disc_potentials
from tests.oracles.rectangle import green

SIZES = (30, 60, 120, 240)  # cells a side, multiples of 10: the electrodes are nodes
SMOKE = 10
SIDE, PITCH, MARGIN = 0.2, 0.04, 0.02  # m
CONTACT, ELECTRODES = 0.1, 16  # of the disc


@dataclass(frozen=True, eq=False)
class Problem:
    """The testbed sheet with 25 point electrodes on a regular mesh; SI units, P1, sheet resistance 1.

    | meaning                                                          | shape         |
    |------------------------------------------------------------------|---------------|
    | pairs: the neighbours of the 5x5 grid, both drives and senses    | (40, 2)       |
    | drive, sense: pair of each reading; the two share no electrode   | (1372,)       |
    | pattern: drive+, drive-, sense+, sense-                          | (1372, 4)     |
    | electrode_nodes                                                  | (25,)         |
    | sigma: conductivity, varied so that no tool can profit from one  | (elements,)   |
    """

    cells: int

    @cached_property
    def mesh(self) -> je.meshing.Mesh:
        return je.meshing.structured(je.Rectangle(SIDE, SIDE), self.cells, self.cells)

    @cached_property
    def points(self) -> np.ndarray:
        line = MARGIN + PITCH * np.arange(5)
        return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)

    @cached_property
    def electrode_nodes(self) -> np.ndarray:
        column, row = np.rint(self.points / SIDE * self.cells).astype(int).T
        nodes = row * (self.cells + 1) + column
        if not np.allclose(self.mesh.nodes[nodes], self.points, atol=1e-12):
            raise ValueError(f"{self.cells} cells a side put no nodes at the electrodes; give a multiple of 10")
        return nodes

    @cached_property
    def pairs(self) -> np.ndarray:
        grid = np.arange(25).reshape(5, 5)
        along = np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()], 1)
        return np.concatenate([along, np.stack([grid[:-1].ravel(), grid[1:].ravel()], 1)])

    @cached_property
    def kept(self) -> np.ndarray:
        """(40, 40) whether drive and sense share no electrode."""
        shared = self.pairs[:, None, :, None] == self.pairs[None, :, None, :]
        return ~shared.any((2, 3))

    @cached_property
    def pattern(self) -> np.ndarray:
        drive, sense = np.nonzero(self.kept)
        return np.concatenate([self.pairs[drive], self.pairs[sense]], 1)

    @cached_property
    def sigma(self) -> np.ndarray:
        x, y = (self.mesh.chart_centroids / SIDE).T
        return 1 + 0.3 * np.sin(5 * x) * np.cos(4 * y)

    @property
    def skin(self) -> je.Skin:
        return square(self.points, self.pattern)

    def model(self, dtype: str = "float64", order: int = 1) -> je.Model:
        fidelity = je.Fidelity(order=order, dtype=dtype, solver=NestedDissection())
        return je.discretise(je.Scene(self.skin), fidelity, mesh=self.mesh)


def square(points: np.ndarray, pattern: np.ndarray, pads: tuple[je.Pad, ...] = ()) -> je.Skin:
    """The square sheet of unit conductivity with point electrodes at (electrodes, 2) places, 1 A."""
    electrodes = tuple(je.PointElectrode(tuple(point)) for point in points.tolist())
    return je.Skin("bench", je.Rectangle(SIDE, SIDE), 1.0, electrodes, je.Protocol(pattern, 1.0), pads)


# --- skins whose readings are known


@dataclass(frozen=True, eq=False)
class Case:
    """A skin of unit conductivity whose readings (readings,) in V are known."""

    name: str
    skin: je.Skin
    exact: np.ndarray


def rectangle() -> Case:
    problem = Problem(SMOKE)
    return Case("rectangle", problem.skin, exact_rectangle(problem))


def disc() -> Case:
    """The unit disc, half its rim covered by complete electrodes, adjacent drives and senses."""
    width = np.pi / ELECTRODES
    starts = (2 * width * np.arange(ELECTRODES) - width / 2) % (2 * np.pi)
    electrodes = tuple(je.BoundaryPatch(float(s), float(s + width), CONTACT) for s in starts)
    pattern = je.skin.adjacent(ELECTRODES)
    skin = je.Skin("bench", je.Disc(1.0), 1.0, electrodes, je.Protocol(pattern, 1.0), ())
    return Case("disc", skin, exact_disc(pattern))


def exact_rectangle(problem: Problem) -> np.ndarray:
    """Voltages of the homogeneous square. The series is along the axis on which two points lie farther apart."""
    source, sink, plus, minus = problem.pattern.T
    z = np.zeros((25, 25))
    for i, j in zip(*np.triu_indices(25, 1), strict=True):
        a, b = problem.points[i], problem.points[j]
        flip = slice(None, None, -1 if abs(a - b)[0] > abs(a - b)[1] else 1)
        z[i, j] = z[j, i] = green(SIDE, SIDE, a[flip], b[flip])
    return z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink]


def exact_disc(pattern: np.ndarray) -> np.ndarray:
    """Voltages of the homogeneous disc for adjacent drives, which are rotations of one; good to 1e-7."""
    first = disc_potentials(CONTACT, ELECTRODES)
    by_drive = np.stack([np.roll(first, turn) for turn in range(ELECTRODES)])
    source, _, plus, minus = pattern.T
    return by_drive[source, plus] - by_drive[source, minus]


# --- presses

BLANKS = 100  # untouched frames, to whose mean the coat is fitted


class Pressed(NamedTuple):
    """Readings (readings,) V of an untouched skin, their change (presses, readings) V, and the noise of one,
    60 dB below their rms, V."""

    untouched: np.ndarray
    change: np.ndarray
    noise: float

    @classmethod
    def of(cls, untouched: np.ndarray, change: np.ndarray) -> "Pressed":
        """Readings and changes, with the noise that belongs to them."""
        return cls(untouched, change, 1e-3 * float(np.sqrt(np.mean(untouched**2))))

    @property
    def std(self) -> np.ndarray:
        """The noise of each reading, (readings,) V."""
        return np.full(self.untouched.size, self.noise)

    def blank(self, rng: np.random.Generator) -> np.ndarray:
        """The mean of the untouched frames, with noise."""
        return self.untouched + self.noise / np.sqrt(BLANKS) * rng.normal(size=self.untouched.size)

    def frames(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The mean of the untouched frames, and the changes, with noise."""
        return self.blank(rng), self.change + self.noise * rng.normal(size=self.change.shape)


def fit_model(skin: str = "testbed") -> je.Model:
    """The mesh on which contacts are fitted to recordings of a skin."""
    return je.discretise(je.Scene(je.load_skin(skin)), LOAD_FIDELITY)


def uneven(seed: int) -> tuple[je.effects.AbstractEffect, ...]:
    """A coating and a contact layer of one seed."""
    return (
        je.effects.CoatingNonUniformity(0.15, 0.03, seed=2 * seed),
        je.effects.ContactGain(0.12, 0.015, seed=2 * seed + 1),
    )


def pressed(
    effects: tuple,
    places: np.ndarray,
    loads: np.ndarray,
    edge_length: float = 0.026,
    spread: float | je.effects.IndentationSpreading = 0.012,
    skin: str | je.Skin = "testbed",
    law: tuple[float, float, float] = (1.0, 20e3, 1.0),
    diameters: ArrayLike = 0.02,
) -> Pressed:
    """A skin pressed by tips at (presses, k, 2) m at once with (presses, k) N, on a mesh of its own.

    The pad spreads each tip to a Gaussian of standard deviation ``spread``, m, or is a half-space; ``law`` holds
    amplitude, half pressure (Pa) and exponent of `ContactPiezoresistance`. ``diameters``, m, are those of the tips of
    each press, (presses,), or of all.
    """
    pad = je.effects.LoadSpreading(spread) if isinstance(spread, float) else spread
    effects = (pad, *effects, je.effects.ContactPiezoresistance(*law))
    scene = je.Scene(je.load_skin(skin) if isinstance(skin, str) else skin, effects)
    model = je.discretise(scene, je.Fidelity.standard(edge_length=edge_length))
    untouched = np.asarray(je.forward(model))
    tips = jnp.broadcast_to(jnp.asarray(diameters, model.dtype), len(places))
    touched = np.asarray(_touched(model, jnp.asarray(places), jnp.asarray(loads), tips))
    return Pressed.of(untouched, touched - untouched)


def _forwards(model: je.Model, places: jax.Array, loads: jax.Array, diameters: jax.Array) -> jax.Array:
    def frame(press):
        loads_there = jax.vmap(lambda place: je.model.load_spread(model, place, press[2]))(press[0])
        return je.forward(model, je.conductivity(model, press[1] @ loads_there))

    return jax.lax.map(frame, (places, loads, diameters))


_jit: Any = eqx.filter_jit  # its type leaves out what it hands on to jax.jit
_touched = _jit(_forwards, compiler_options=je.compiler_options())  # compiled once for all seeds


def matched(found: np.ndarray, pair: np.ndarray) -> bool:
    """Whether both contacts of a pair (2, 2) m and nothing else are found, (k, 2) m, within half their distance, at
    most 15 mm."""
    reach = min(0.015, float(np.linalg.norm(pair[0] - pair[1])) / 2)
    away = np.linalg.norm(found[:, None] - pair, axis=-1)
    return len(found) == 2 and bool(min(away[[0, 1], [0, 1]].max(), away[[0, 1], [1, 0]].max()) < reach)
