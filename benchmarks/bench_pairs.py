"""Two objects of unequal contrast in a tank: which method keeps the weaker one.

Simulated: a round tank with 16 electrodes around it on a mesh of its own, with two discs of 0.15 of its radius, half to
1.2 radii apart, whose logarithms of conductivity are as 1 to the ratio; noise is 60 or 40 dB below the untouched
readings. A pair is kept if there are two regions, one within a quarter of the radius of each object. A region must rise
above its surroundings by a part of the highest, chosen so that at most 5 % of single objects show a second region.

Recorded, with ``--data``: the frames of `pyeidors_tank` with metal and plastic beside known electrodes. An object is
kept if the image is higher at its place than anywhere away from all objects; the least of these ratios is stated too.
And the four training frames of `ktc2023` with all electrodes, by Otsu's thresholds and the score of the challenge.
Lengths of priors and methods are parts of the radius. The image of `je.imaging.segment` is the logarithm of the
conductivity, which takes the place of a difference image; its classes take the place of Otsu's.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.tanks import load_tank

from . import bench_ktc as ktc
from .harness import Question, Run
from .rows import Row

RADIUS, COUNT, PIXELS, PAIRS, SEED = 0.1, 16, 32, 50, 3
RATIOS, NOISES = {"1:1": 1.0, "1:2": 0.5, "1:4": 0.25}, {"60 dB": 1e-3, "40 dB": 1e-2}
RISES = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.55)
MAX_FALSE_SECONDS = 0.05
HYPERPARAMETERS = (0.1, 0.3)
SEGMENT = "segment"


def ways(radius: float) -> dict[str, tuple[je.AbstractPrior, Any]]:
    """Prior and method by name."""
    return {
        "NOSER": (je.Noser(), je.OneStep()),
        "Tikhonov": (je.Tikhonov(), je.OneStep()),
        "Laplace": (je.Laplace(), je.OneStep()),
        "Gaussian": (je.GaussianSmooth(length=0.1 * radius), je.OneStep()),
        "GREIT": (je.Noser(), je.Greit(width=0.12 * radius, radius=0.2 * radius, edge=0.04 * radius)),
        "truncated SVD": (je.Noser(), je.TruncatedSvd()),
        "not negative": (je.Noser(), je.NonNegative()),
        "sparse Bayes": (je.Noser(), je.SparseBayes()),
        "total variation": (je.TotalVariation(), je.Reweighted()),
    }


class Way(NamedTuple):
    """A method prepared for a model: images of changes, (frames, readings) V, from a reference; their picture."""

    images: Callable[[np.ndarray, np.ndarray], np.ndarray]
    picture: Any


def prepared(model: je.Model, radius: float, name: str, strength: float | None, **where: Any) -> Way:
    """The way of a name with a hyperparameter; `je.imaging.segment` with its own weight."""
    if name == SEGMENT:
        basis = je.Pixels(PIXELS).on(model)

        def segmented(changes: np.ndarray, reference: np.ndarray) -> np.ndarray:
            frames = [reference + change for change in changes]
            return np.array([je.imaging.segment(model, reference, f, basis, borders=None).image for f in frames])

        return Way(segmented, basis)
    prior, method = ways(radius)[name]
    recon = je.prepare(model, prior, method, je.Pixels(PIXELS), hyperparameter=strength, **where)
    return Way(lambda changes, _: np.asarray(recon(jnp.asarray(changes))), recon)


class Simulated(NamedTuple):
    """Places of the pairs, (pairs, 2, 2) m; model; untouched readings; their changes by ratio and noise."""

    places: np.ndarray
    model: je.Model
    still: np.ndarray
    singles: dict[str, np.ndarray]
    pairs: dict[tuple[str, str], np.ndarray]


def simulated(count: int) -> Simulated:
    """Pairs, and the first of each alone."""
    rng, disc = np.random.default_rng(SEED), je.Disc(RADIUS)
    rim = je.skin.rim_electrodes(disc, COUNT, contact=1e-2)
    scene = je.Scene(je.Skin("tank", disc, 1.0, rim, je.Protocol(je.skin.adjacent(COUNT))))
    there = je.discretise(scene, je.Fidelity(edge_length=0.025, order=2))
    places: list[np.ndarray] = []
    while len(places) < count:
        pair = rng.uniform(-RADIUS, RADIUS, (2, 2))
        apart = np.linalg.norm(pair[0] - pair[1]) / RADIUS
        if (np.linalg.norm(pair, axis=1) < 0.8 * RADIUS).all() and 0.5 < apart < 1.2:
            places.append(pair)
    away = np.linalg.norm(np.asarray(there.centroids)[:, None, None] - np.array(places), axis=-1)
    discs = 1 / (1 + np.exp((away - 0.15 * RADIUS) / (0.01 * RADIUS)))  # (elements, pairs, 2)
    voltages = je.bind(je.forward, there)
    still = np.asarray(je.forward(there))

    def changes(ratio: float, noise: float) -> np.ndarray:
        sigma = np.exp(discs[..., 0] + ratio * discs[..., 1])
        change = np.array([voltages(jnp.asarray(column)) for column in sigma.T]) - still
        size = np.sqrt(2) * noise * np.sqrt(np.mean(still**2))
        return change + rng.normal(scale=size, size=change.shape)

    singles = {name: changes(0.0, noise) for name, noise in NOISES.items()}
    pairs = {(r, n): changes(ratio, noise) for r, ratio in RATIOS.items() for n, noise in NOISES.items()}
    return Simulated(np.array(places), je.discretise(scene, je.Fidelity.standard()), still, singles, pairs)


def regions(way: Way, image: np.ndarray, rise: float) -> np.ndarray:
    return np.asarray(je.contacts.find_regions(image, way.picture, level=0.02, least=rise).centres)


def kept(way: Way, one: Simulated) -> Row:
    """Share of pairs of which both are seen, by ratio and noise."""
    row: Row = {}
    for noise, frames in one.singles.items():
        alone = way.images(frames, one.still)
        few = (r for r in RISES if np.mean([len(regions(way, i, r)) > 1 for i in alone]) <= MAX_FALSE_SECONDS)
        rise = next(few, RISES[-1])
        for ratio in RATIOS:
            found = [regions(way, image, rise) for image in way.images(one.pairs[ratio, noise], one.still)]
            both = [
                len(f) == 2 and (np.linalg.norm(f[:, None] - p, axis=2).min(0) < 0.25 * RADIUS).all()
                for f, p in zip(found, one.places, strict=True)
            ]
            row[f"{ratio}, {noise}"] = float(np.mean(both))
    return row


class Recorded:
    """Frames with objects beside electrodes; the water of the challenge."""

    def __init__(self, folder: Path) -> None:
        files = sorted((folder / "pyeidors_tank" / "tank").glob("*/*/*.csv"))
        self.tanks = [load_tank(path, je.Disc(0.03)) for path in files]
        objects = [re.findall(r"electrode(\d+)_(metal|plastic)", path.parent.name) for path in files]
        self.objects = [[(int(k) - 1, 1 if what == "metal" else -1) for k, what in found] for found in objects]
        self.model = self.tanks[0].model()
        self.data = ktc.load(folder / "ktc2023")
        self.water_model = ktc.tank(self.data)
        self.water = ktc.homogeneous(self.water_model, self.data.reference, self.data.channel)

    def kept(self, name: str, strength: float | None) -> Row:
        way = prepared(self.model, 0.03, name, strength)
        ratios = np.concatenate([self._ratios(way, *one) for one in zip(self.tanks, self.objects, strict=True)])
        least = max(0.0, float(ratios.min()))  # below zero: an image of the other sign
        return {"kept": int(np.sum(ratios > 1)), "objects": len(ratios), "least_over_artefact": least}

    def _ratios(self, way: Way, tank: Any, objects: list[tuple[int, int]]) -> np.ndarray:
        """Of each object: the image at its place over that anywhere away from all."""
        first, last = tank.frames[0], tank.frames[-1]
        even = np.asarray(je.forward(self.model))
        scale = (even @ first) / (first @ first)
        inside = np.asarray(way.picture.areas) > 0
        (image,) = way.images(scale * (last - first)[None], scale * first)
        places = 0.65 * tank.skin.electrode_positions[[number for number, _ in objects]]
        apart = np.linalg.norm(np.asarray(way.picture.centres)[:, None] - places, axis=2) / 0.03
        away = inside & (apart.min(1) > 0.4)
        return np.array([
            np.max(sign * image[inside & (apart[:, k] < 0.25)]) / max(np.max(sign * image[away]), 1e-12)
            for k, (_, sign) in enumerate(objects)
        ])  # fmt: skip

    def score(self, name: str, strength: float | None) -> Row:
        if name == SEGMENT:
            labels = ktc.variation(self.water_model, je.Pixels(PIXELS).on(self.water_model), self.water, self.data)
        else:
            sigma = jnp.full_like(self.water_model.background, self.water.sigma)
            way = prepared(self.water_model, ktc.RADIUS, name, strength, sigma=sigma)
            images = way.images(self.data.frames - self.data.reference, self.data.reference)
            labels = [ktc.otsu_labels(ktc.on_grid(image, way.picture)) for image in images]
        scores = [float(je.metrics.ktc_score(a, b)) for a, b in zip(labels, self.data.truth, strict=True)]
        return {"challenge": float(np.mean(scores))}


def measure(run: Run) -> Iterator[Row]:
    one = simulated(run.sizes(PAIRS, 4))
    recorded = None if run.args.data is None else Recorded(run.args.data)
    strengths = run.sizes(HYPERPARAMETERS, HYPERPARAMETERS[:1])
    for name, strength in [*((name, s) for name in ways(RADIUS) for s in strengths), (SEGMENT, None)]:
        row = {"way": name, "hyperparameter": "its own" if strength is None else strength}
        row |= kept(prepared(one.model, RADIUS, name, strength), one)
        if recorded is not None:
            row |= recorded.kept(name, strength) | recorded.score(name, strength)
        print(row, flush=True)
        yield {"rows": [row]}


DATA: Row = {"type": Path, "help": "folder with pyeidors_tank/ and ktc2023/; default: simulated pairs only"}
main = Question("pairs", __doc__, {"rows": measure}, {"--data": DATA})

if __name__ == "__main__":
    main()
