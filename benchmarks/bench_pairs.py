"""Two objects of unequal contrast in a tank: which method keeps the weaker one.

Simulated: a round tank with 16 electrodes around it on a mesh of its own, with two discs of 0.15 of its radius, half to
1.2 radii apart, whose logarithms of conductivity are as 1 to the ratio; noise is 60 or 40 dB below the untouched
readings. A pair is kept if there are two regions, one within a quarter of the radius of each object. A region must rise
above its surroundings by a part of the highest, chosen so that at most 5 % of single objects show a second region.

Recorded, with ``--data``: the frames of `pyeidors_tank` with metal and plastic beside known electrodes. An object is
kept if the image is higher at its place than anywhere away from all objects; the least of these ratios is stated too.
And the four training frames of `ktc2023` with all electrodes, by Otsu's thresholds and the score of the challenge.
Lengths of priors and methods are parts of the radius. Methods are the linear ones; `bench_images` has the others.
"""

import re
from collections.abc import Iterator
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


def ways(radius: float) -> dict[str, tuple[je.AbstractPrior, Any]]:
    """Prior and method by name."""
    return {
        "NOSER": (je.Noser(), je.OneStep()),
        "Tikhonov": (je.Tikhonov(), je.OneStep()),
        "Laplace": (je.Laplace(), je.OneStep()),
        "Gaussian": (je.GaussianSmooth(length=0.1 * radius), je.OneStep()),
        "GREIT": (je.Noser(), je.Greit(width=0.12 * radius, radius=0.2 * radius, edge=0.04 * radius)),
        "truncated SVD": (je.Noser(), je.TruncatedSvd()),
    }


class Simulated(NamedTuple):
    """Places of the pairs, (pairs, 2, 2) m; model; changes of the readings by ratio and noise."""

    places: np.ndarray
    model: je.Model
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
    return Simulated(np.array(places), je.discretise(scene, je.Fidelity.standard()), singles, pairs)


def regions(recon: Any, image: np.ndarray, rise: float) -> np.ndarray:
    return np.asarray(je.contacts.find_regions(image, recon, level=0.02, least=rise).centres)


def kept(recon: Any, one: Simulated) -> Row:
    """Share of pairs of which both are seen, by ratio and noise."""
    row: Row = {}
    for noise, frames in one.singles.items():
        alone = np.asarray(recon(frames))
        few = (r for r in RISES if np.mean([len(regions(recon, i, r)) > 1 for i in alone]) <= MAX_FALSE_SECONDS)
        rise = next(few, RISES[-1])
        for ratio in RATIOS:
            found = [regions(recon, image, rise) for image in np.asarray(recon(one.pairs[ratio, noise]))]
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

    def kept(self, name: str, hyperparameter: float) -> Row:
        prior, method = ways(0.03)[name]
        recon = je.prepare(self.model, prior, method, je.Pixels(PIXELS), hyperparameter=hyperparameter)
        ratios = np.concatenate([self._ratios(recon, *one) for one in zip(self.tanks, self.objects, strict=True)])
        return {"kept": int(np.sum(ratios > 1)), "objects": len(ratios), "least_over_artefact": float(ratios.min())}

    def _ratios(self, recon: Any, tank: Any, objects: list[tuple[int, int]]) -> np.ndarray:
        """Of each object: the image at its place over that anywhere away from all."""
        first, last = tank.frames[0], tank.frames[-1]
        even = np.asarray(je.forward(self.model))
        inside = np.asarray(recon.areas) > 0
        image = np.asarray(recon(jnp.asarray((even @ first) / (first @ first) * (last - first))))
        places = 0.65 * tank.skin.electrode_positions[[number for number, _ in objects]]
        apart = np.linalg.norm(np.asarray(recon.centres)[:, None] - places, axis=2) / 0.03
        away = inside & (apart.min(1) > 0.4)
        return np.array([
            np.max(sign * image[inside & (apart[:, k] < 0.25)]) / max(np.max(sign * image[away]), 1e-12)
            for k, (_, sign) in enumerate(objects)
        ])  # fmt: skip

    def score(self, name: str, hyperparameter: float) -> Row:
        prior, method = ways(ktc.RADIUS)[name]
        sigma = jnp.full_like(self.water_model.background, self.water.sigma)
        basis = je.Pixels(PIXELS)
        recon = je.prepare(self.water_model, prior, method, basis, hyperparameter=hyperparameter, sigma=sigma)
        images = np.asarray(recon(jnp.asarray(self.data.frames - self.data.reference)))
        labels = [ktc.otsu_labels(ktc.on_grid(image, recon)) for image in images]
        scores = [float(je.metrics.ktc_score(a, b)) for a, b in zip(labels, self.data.truth, strict=True)]
        return {"challenge": float(np.mean(scores))}


def measure(run: Run) -> Iterator[Row]:
    one = simulated(run.sizes(PAIRS, 4))
    recorded = None if run.args.data is None else Recorded(run.args.data)
    for name, (prior, method) in ways(RADIUS).items():
        for strength in run.sizes(HYPERPARAMETERS, HYPERPARAMETERS[:1]):
            recon = je.prepare(one.model, prior, method, je.Pixels(PIXELS), hyperparameter=strength)
            row = {"way": name, "hyperparameter": strength} | kept(recon, one)
            if recorded is not None:
                row |= recorded.kept(name, strength) | recorded.score(name, strength)
            print(row, flush=True)
            yield {"rows": [row]}


DATA: Row = {"type": Path, "help": "folder with pyeidors_tank/ and ktc2023/; default: simulated pairs only"}
main = Question("pairs", __doc__, {"rows": measure}, {"--data": DATA})

if __name__ == "__main__":
    main()
