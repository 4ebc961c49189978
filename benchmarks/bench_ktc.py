"""Kuopio Tomography Challenge 2023: untrained methods on its four training frames, with electrodes taken away.

A water tank of 0.115 m radius with 32 electrodes around it, plastic and metal pieces in it (Räsänen et al. 2023). The
challenge has seven levels: level k takes the first 2 (k - 1) electrodes away, with every reading that uses one. Its
evaluation frames are not used here; the levels are made by leaving those readings of the training frames out.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.io import loadmat
from scipy.optimize import minimize_scalar

import jaxeit as je

from .clock import seconds
from .harness import Question, Run
from .rows import Row, grouped

RADIUS, ELECTRODES, GRID = 0.115, 32, 256
LEVELS, SMOKE_LEVELS = tuple(range(1, 8)), (1, 7)
WATER, RESISTIVE, CONDUCTIVE = 0, 1, 2
PUBLISHED = {"linear baseline": 10.30, "winners (trained networks), about": 15.0}


def otsu_labels(image: np.ndarray) -> np.ndarray:
    """The challenge's own segmentation: three classes by Otsu's thresholds, the largest taken for water; what lies
    below it is resistive, what lies above conductive."""
    classes = np.digitize(image, np.asarray(je.metrics.otsu_thresholds(image)))
    water = np.bincount(classes.ravel()).argmax()
    return np.where(classes < water, RESISTIVE, np.where(classes > water, CONDUCTIVE, WATER))


# --- the challenge


@dataclass(frozen=True, eq=False)
class Data:
    """The training set.

    | meaning                                               | shape         | unit |
    |-------------------------------------------------------|---------------|------|
    | pattern: drive+, drive-, sense+, sense-               | (2356, 4)     |      |
    | mean current, as the file tells it                    | ()            | mA   |
    | reference: water only                                 | (2356,)       | V    |
    | frames                                                | (4, 2356)     | V    |
    | truth: 0 water, 1 resistive, 2 conductive; row 0 = +y | (4, 256, 256) |      |
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


def load(folder: Path) -> Data:
    """The training set from the challenge's MATLAB files."""
    reference = loadmat(folder / "training" / "ref.mat")
    drive, sense = reference["Injref"], reference["Mpat"].astype(float)
    drives, senses = (np.stack([p.argmax(0), p.argmin(0)], 1) for p in (drive, sense))
    count = len(senses)
    frames = [loadmat(folder / "training" / f"data{k}.mat")["Uel"].ravel() for k in range(1, 5)]
    truth = [loadmat(folder / "groundtruth_training" / f"true{k}.mat")["truth"] for k in range(1, 5)]
    pattern = np.concatenate([np.repeat(drives, count, 0), np.tile(senses, (len(drives), 1))], 1)
    return Data(pattern, float(drive.max(0).mean()), reference["Uelref"].ravel(), np.array(frames), np.array(truth))


def tank(data: Data, edge_length: float = 0.03) -> je.Model:
    """Our own mesh of the tank: electrode 0 at +y, counter-clockwise, half of the rim covered; 1 S and mA."""
    disc = je.Disc(RADIUS)
    patches = je.skin.rim_electrodes(disc, ELECTRODES, contact=1e-4, start=np.pi / 2)
    protocol = je.Protocol(data.pattern, data.current)
    return je.discretise(je.Scene(je.Skin("ktc", disc, 1.0, patches, protocol)), je.Fidelity(edge_length=edge_length))


class Water(NamedTuple):
    """Water as `ref.mat` tells it: sigma in mS, contact in kilohm m, what model (and offsets) miss of the
    readings (readings,) in V, and its norm relative to theirs."""

    sigma: float
    contact: float
    missed: np.ndarray
    residual: float


LEAST_CONTACT, MOST_CONTACT = 1e-6, 1.0  # contact resistance times conductivity, m; below, the mesh sees none


def homogeneous(model: je.Model, readings: np.ndarray, channel: np.ndarray | None = None) -> Water:
    """Fit of one conductivity and one contact resistance; with ``channel`` also of an offset of each sensing pair.

    All currents are taken alike: pairs that were driven in both directions then agree in size to 0.7 % on average, to
    2.6 % with the currents of the file. Most of what is left (7.3 % to 4.1 %) is a fixed offset of each sensing pair,
    which differences of frames do not see. As ``voltages(sigma, contact) = voltages(1, contact sigma) / sigma``, all
    but the product of the two is linear.
    """

    def less_offsets(values):
        if channel is None:
            return values
        return values - (np.bincount(channel, values) / np.bincount(channel))[channel]

    def fitted(ratio):
        unit = less_offsets(np.asarray(_even(model, jnp.asarray(ratio))))
        resistance = (unit @ readings) / (unit @ unit)
        return 1 / resistance, less_offsets(readings) - resistance * unit

    ends = np.log([LEAST_CONTACT, MOST_CONTACT])
    best = minimize_scalar(lambda log: np.linalg.norm(fitted(np.exp(log))[1]), bounds=ends, method="bounded")
    sigma, missed = fitted(np.exp(best.x))
    return Water(sigma, np.exp(best.x) / sigma, missed, float(np.linalg.norm(missed) / np.linalg.norm(readings)))


@eqx.filter_jit
def _even(model, ratio):
    """Readings of even water of unit conductivity."""
    contact = jnp.full_like(model.contact, 1 / ratio)
    return je.forward(eqx.tree_at(lambda m: m.contact, model, contact), jnp.ones_like(model.background))


def with_level(data: Data, level: int) -> Data:
    """Frames with NaN where a reading uses one of the first 2 (level - 1) electrodes."""
    lost = (data.pattern < 2 * (level - 1)).any(1)
    frames = np.where(lost, np.nan, data.frames)
    return replace(data, reference=np.where(lost, np.nan, data.reference), frames=frames)


LINE = np.linspace(-1, 1, GRID)
INSIDE = np.hypot(LINE, LINE[:, None]) <= 1


def on_grid(values: np.ndarray, picture: Any) -> np.ndarray:
    """The challenge's 256 x 256 pixels, row 0 at +y, from those of an image by bilinear interpolation."""
    return np.where(INSIDE, je.imaging.on_grid(values, picture.picture, (GRID, GRID))[::-1], 0.0)


Method = Callable[[Data], list[np.ndarray]]  # frames to the labels of each


def linear(model: je.Model, image: je.model.BasisMap, water: Water, data: Data) -> list[np.ndarray]:
    """The recipe of the challenge: one step from even water with `Noser`, then Otsu."""
    sigma, used = jnp.full_like(model.background, water.sigma), jnp.asarray(np.isfinite(data.reference))
    recon = je.prepare(model, basis=image, hyperparameter=0.1, sigma=sigma, channels=used)
    images = np.asarray(recon(jnp.asarray(data.frames - data.reference)))
    return [otsu_labels(on_grid(image, recon)) for image in images]


def variation(model: je.Model, image: je.model.BasisMap, water: Water, data: Data) -> list[np.ndarray]:
    """`je.imaging.segment`, with water as the reference tells it and one weight for all levels."""
    filled = jnp.full_like(model.background, water.sigma), jnp.full_like(model.contact, 1 / water.contact)
    model = eqx.tree_at(lambda m: (m.background, m.contact), model, filled)
    how: dict[str, Any] = {"missed": water.missed, "penalty": je.imaging.IsotropicVariation()}
    found = [je.imaging.segment(model, data.reference, frame, image, **how) for frame in data.frames]
    return [np.where(INSIDE, one.classes[::-1], WATER) for one in found]


def methods(model: je.Model, water: Water, pixels: int = 40) -> dict[str, Method]:
    image = je.Pixels(pixels).on(model)
    return {way.__name__: partial(way, model, image, water) for way in (linear, variation)}


# --- results


def scored(data: Data, ways: dict[str, Method], level: int) -> Iterator[Row]:
    """Scores of every method at a level."""
    for name, way in ways.items():
        spent, found = seconds(way, with_level(data, level))
        scores = [float(je.metrics.ktc_score(a, b)) for a, b in zip(found, data.truth, strict=True)]
        row: Row = {"level": level, "method": name, "seconds": round(spent, 2)}
        yield row | {"scores": np.round(scores, 3).tolist(), "mean": round(float(np.mean(scores)), 3)}


def totals(rows: list[Row]) -> dict[str, float]:
    """Mean over levels, of the 21 points of the challenge (three frames at each of seven levels)."""
    by_method = grouped(rows, "method")
    return {name: round(21 * float(np.mean([row["mean"] for row in mine])), 2) for name, mine in by_method.items()}


def challenge(run: Run) -> Iterator[Row]:
    """All levels."""
    data = load(run.args.data)
    model = tank(data)
    ways = methods(model, homogeneous(model, data.reference, data.channel))
    if run.smoke:
        data = replace(data, frames=data.frames[:1], truth=data.truth[:1])
    yield {"published_of_21": PUBLISHED, "rows": []}
    for level in run.sizes(LEVELS, SMOKE_LEVELS):
        for row in scored(data, ways, level):
            print(row, flush=True)
            yield {"rows": [row], "of_21": totals([*run.data["rows"], row])}


DATA: Row = {"type": Path, "required": True, "help": "folder with training/ and groundtruth_training/"}
main = Question("ktc", __doc__, {"rows": challenge}, {"--data": DATA})

if __name__ == "__main__":
    main()
