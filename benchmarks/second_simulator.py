"""Skins of the second simulator: its sessions; skins under presses, and the true force maps of these."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

import calib
from tests.oracles import bench as oracle
from tests.oracles.bench import contact
from tests.oracles.bench.mesh import make_mesh
from tests.oracles.bench.session import coating, transfers
from tests.oracles.bench.sheet import Sheet, make_sheet, readings
from tests.oracles.bench.skin import SKINS, Skin, read_skin

from .problems import Pressed

SCATTER, SPACING = 0.1, 3e-3  # of the log of the protrusions; of the mesh, m
FORCES, TIPS = (4.0, 25.0), (0.006, 0.03)  # N, m
DISTANCE = 0.03  # m, of two contacts
MARGIN = 0.1  # of the sheet, on which no single tip is
AGED, AGED_FIELD = -0.3, 0.2  # change of the log gain from the first press to the last: its mean, standard deviation
LOOSE, LOOSE_AFTER, LOOSENED = 12, 2 / 3, 10.0  # bolt, part of the presses, and factor of its contact resistance
SUB = 5  # points along each side of a pixel at which the true stress is taken


class Press(NamedTuple):
    """Places (k, 2) m and forces (k,) N of tips, and their diameter, m."""

    places: np.ndarray
    forces: np.ndarray
    tip: float


class Wear(NamedTuple):
    """What a skin is like: standard deviations of the log of its coat and of the bolts' places, m; tips, m, or None:
    those of `TIPS`; whether its contact layer ages from press to press, and a bolt comes loose."""

    coat: float = 0.15
    misplaced: float = 0.0
    tip: float | None = None
    ages: bool = False


@contextmanager
def session_of(bench: oracle.Bench) -> Iterator[calib.Session]:
    """A session of a bench."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        oracle.write(path, oracle.simulate(bench))
        with calib.open_session(path) as session:
            yield session


def described(name: str) -> Skin:
    """A shipped skin, as the second simulator reads it."""
    return read_skin(SKINS / f"{name}.toml")


def presses(rng: np.random.Generator, count: int, tip: float | None = None, name: str = "testbed") -> list[Press]:
    """Single tips anywhere on a skin of a name."""
    made = alike(rng, count, 0.0, name)
    return [one._replace(tip=tip or size) for one, size in zip(made, rng.uniform(*TIPS, count), strict=True)]


def alike(rng: np.random.Generator, count: int, tip: float, name: str) -> list[Press]:
    """Single tips of one diameter, m, anywhere on a skin of a name but for its margin."""
    places = described(name).size * rng.uniform(MARGIN, 1 - MARGIN, (count, 1, 2))
    return [Press(place, force, tip) for place, force in zip(places, rng.uniform(*FORCES, (count, 1)), strict=True)]


def pairs(rng: np.random.Generator, count: int) -> list[Press]:
    """Two tips of equal force."""
    angle, middle = rng.uniform(0, np.pi, count), rng.uniform(0.045, 0.155, (count, 2))
    away = DISTANCE / 2 * np.stack([np.cos(angle), np.sin(angle)], 1)
    force, tip = rng.uniform(*FORCES, count), rng.uniform(*TIPS, count)
    return [
        Press(np.stack([m - a, m + a]), np.full(2, f), t) for m, a, f, t in zip(middle, away, force, tip, strict=True)
    ]


def drawn(skin: Skin, wear: Wear, own: np.random.Generator) -> tuple[np.ndarray, contact.Layer]:
    """Places of the bolts (bolts, 2) m, and the contact layer of a skin."""
    bolts = skin.bolts + wear.misplaced * own.standard_normal(skin.bolts.shape)
    return bolts, contact.make_layer(skin, bolts, SCATTER, own)


def relative_gain(seed: int, wear: Wear, places: np.ndarray, usual: Press, name: str = "testbed") -> np.ndarray:
    """Log of what the protrusions conduct under a usual press at each of some places (n, 2) m, up to a constant."""
    _, layer = drawn(described(name), wear, np.random.default_rng([seed, 11]))
    (force,) = usual.forces
    loads = np.array([force * contact.shares(layer, place, "flat", usual.tip, force) for place in places])
    return np.log(contact.conductances(layer, loads).sum(1))


def recorded(seed: int, given: list[Press], wear: Wear, name: str = "testbed") -> Pressed:
    """A skin of a seed under presses, of which each change is that from the untouched skin of its time."""
    skin, own = described(name), np.random.default_rng([seed, 11])
    bolts, layer = drawn(skin, wear, own)
    mesh = make_mesh(skin, bolts, SPACING)
    sigma = coating(mesh.points[mesh.triangles].mean(1), wear.coat, own) / skin.resistance
    sheet = make_sheet(mesh, sigma, skin.contact)
    loads = [
        sum(f * contact.shares(layer, place, "flat", p.tip, f) for place, f in zip(p.places, p.forces, strict=True))
        for p in given
    ]
    conducts, begin = contact.conductances(layer, np.array(loads)), len(given)
    if wear.ages:
        field, begin = np.log(coating(layer.places, AGED_FIELD, own)), round(LOOSE_AFTER * len(given))
        conducts *= np.exp(np.linspace(0, 1, len(given))[:, None] * (AGED + field))
    changes = [_changes(skin, layer, sheet, conducts[:begin])]
    if wear.ages:
        of_bolts = np.where(mesh.bolt[mesh.bolt >= 0] == LOOSE, LOOSENED, 1.0) * skin.contact
        changes.append(_changes(skin, layer, make_sheet(mesh, sigma, of_bolts[:, None, None]), conducts[begin:]))
    return Pressed.of(readings(sheet.untouched, skin.pattern, skin.current), np.concatenate(changes))


def _changes(skin: Skin, layer: contact.Layer, sheet: Sheet, conducts: np.ndarray) -> np.ndarray:
    """Change of the readings (presses, readings) V by the conductances of patches (presses, patches) S."""
    moved = transfers(layer, sheet, conducts) - sheet.untouched
    return np.array([readings(each, skin.pattern, skin.current) for each in moved])


def true_map(press: Press, centres: np.ndarray) -> np.ndarray:
    """Force on each pixel, N: Boussinesq's stress of the tips, all of which the sheet carries."""
    pitch = 2 * centres.min()
    step = pitch * ((np.arange(SUB) + 0.5) / SUB - 0.5)
    points = (centres[:, None] + np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)).reshape(-1, 2)
    there = contact.Layer(points, *3 * [np.zeros(len(points))])
    each = zip(press.places, press.forces, strict=True)
    parts = [f * contact.shares(there, place, "flat", press.tip, f) for place, f in each]
    return sum(parts).reshape(len(centres), -1).sum(1)
