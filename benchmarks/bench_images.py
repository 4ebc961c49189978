"""Where every method says the contacts are: the testbed of the paper, simulated on another mesh, six seeds.

python -m benchmarks.bench_images [--smoke] [--seeds 6]

For each seed the sheet is coated anew (CoatingNonUniformity 0.15, ContactGain 0.12), pressed to 20 N by a
20 mm tip on the 15 x 15 grid, and pressed at two places at once; noise is 60 dB below the readings.  Columns:
localisation by each estimator and inward bias (mean over the grid, mm), CV of the image's sum (ddof 0), false
second contacts on single presses, pairs of which both are found and nothing else (within half their distance, at
most 15 mm), milliseconds a frame (one at a time, from Python) and to prepare.  Image methods find contacts by
`find_regions`, whose ``level`` is chosen so that on the singles of the first seed at most 5 % show a second one.
Methods that work on each frame anew have 24 x 24 pixels and the first seed, the others 40 x 40 and all.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from . import _common as c

DISTANCES, SHARES = (0.02, 0.03, 0.04, 0.06), (1.0, 1 / 3)
LEVELS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
HYPERPARAMETER = 0.1
ITERATIVE: dict[str, Any] = {"basis": je.Pixels(24), "seeds": 1}
METHODS: dict[str, dict[str, Any]] = {
    "back-projection": {"method": je.BackProjection()},
    "one step, Tikhonov": {"prior": je.Tikhonov()},
    "one step, NOSER": {},
    "one step, Laplace": {"prior": je.Laplace()},
    "one step, Gaussian": {"prior": je.GaussianSmooth(noser=True)},
    "one step, bumps (the paper's second reading)": {"prior": je.Tikhonov(), "basis": je.Bumps()},
    "truncated SVD": {"method": je.TruncatedSvd()},
    "GREIT": {"method": je.Greit()},
    "not negative": {"method": je.NonNegative()} | ITERATIVE,
    "sparse Bayes": {"method": je.SparseBayes()} | ITERATIVE,
    "total variation": {"prior": je.TotalVariation(), "method": je.Reweighted()} | ITERATIVE,
}


class Simulated:
    """The presses of one seed: singles (225), and pairs (distance, share, pair)."""

    def __init__(self, seed: int, grid: int, pairs: int) -> None:
        effects = (
            je.LoadSpreading(0.012),
            je.CoatingNonUniformity(0.15, 0.03, seed=2 * seed),
            je.ContactGain(0.12, 0.015, seed=2 * seed + 1),
            je.ContactPiezoresistance(1.0, 20e3, 1.0),
        )
        self.model = je.discretise(je.Scene(je.load_skin("testbed"), effects), je.Fidelity.standard(edge_length=0.026))
        rng = np.random.default_rng(seed)
        line = np.linspace(0.01, 0.19, grid)
        self.sites = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        centre, angle = rng.uniform(0.05, 0.15, (pairs, 2)), rng.uniform(0, np.pi, pairs)
        along = np.stack([np.cos(angle), np.sin(angle)], -1) / 2
        far = np.array(DISTANCES)[:, None, None]
        self.pairs = np.stack([centre - far * along, centre + far * along], -2)  # (distances, pairs, 2, 2)
        v0 = np.asarray(je.forward(self.model))
        self.noise = np.full(v0.size, 1e-3 * np.sqrt(np.mean(v0**2)))
        self.singles = self._recorded(self.sites[:, None], np.ones((len(self.sites), 1)), v0, rng)
        self.doubles = {
            (d, share): self._recorded(places, np.tile([1.0, share], (pairs, 1)), v0, rng)
            for d, places in zip(DISTANCES, self.pairs, strict=True)
            for share in SHARES
        }

    def _recorded(self, sites, shares, v0, rng) -> np.ndarray:
        model = self.model

        def frame(args):
            places, share = args
            loads = jax.vmap(lambda place: je.load_spread(model, place, 0.02))(places)
            return je.forward(model, je.conductivity(model, 20.0 * share @ loads))

        frames = jax.jit(partial(jax.lax.map, frame))((jnp.asarray(sites), jnp.asarray(shares)))
        return np.asarray(frames) - v0 + self.noise * rng.normal(size=(len(sites), v0.size))


Found = list[np.ndarray]  # contacts of each frame, (k, 2) m


def matched(found: Found, places: np.ndarray) -> np.ndarray:
    """Frames in which both contacts are found and nothing else."""
    reach = min(0.015, np.linalg.norm(places[0, 0] - places[0, 1]) / 2)
    return np.array([len(f) == 2 and _both(f, pair, reach) for f, pair in zip(found, places, strict=True)])


def _both(found: np.ndarray, pair: np.ndarray, reach: float) -> bool:
    away = np.linalg.norm(found[:, None] - pair, axis=-1)
    return bool(min(away[[0, 1], [0, 1]].max(), away[[0, 1], [1, 0]].max()) < reach)


def by_regions(recon: Any, frames: np.ndarray, level: float) -> Found:
    return _regions(recon, np.asarray(recon(frames)), level)


def _regions(recon: Any, images: np.ndarray, level: float) -> Found:
    return [je.find_regions(image, recon, level=level, least=(1 - level) / 2).centres for image in images]


def chosen_level(recon: Any, singles: np.ndarray) -> float:
    """The lowest with at most 5 % false second contacts; the highest if there is none."""
    images = np.asarray(recon(singles))
    for level in LEVELS:
        if np.mean([len(f) > 1 for f in _regions(recon, images, level)]) <= 0.05:
            return level
    return LEVELS[-1]


def places_in(recon: Any, frames: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Positions by every estimator, and the sums of the images."""
    images = recon(frames)
    return {k: np.asarray(e(images, recon)) for k, e in je.ESTIMATORS.items()}, np.asarray(
        je.image_sum(images, recon.areas)
    )


def by_image(model: je.Model, simulated: list[Simulated], settings: dict[str, Any]) -> dict[str, Any]:
    settings = {"basis": je.Pixels(40), "hyperparameter": HYPERPARAMETER, "noise": simulated[0].noise} | settings
    simulated = simulated[: settings.pop("seeds", None)]
    settings["basis"] = settings["basis"].on(model)
    prepare = partial(je.prepare, model, **settings)
    prepare()
    spent, recon = c.seconds(prepare)
    level = chosen_level(recon, simulated[0].singles)
    find = partial(by_regions, recon, level=level)
    return scored(simulated, partial(places_in, recon), find) | {
        "level": level,
        "seeds": len(simulated),
        "prepare_ms": 1e3 * spent,
        "frame_ms": frame_time(recon, simulated[0].singles),
    }


def by_fit(model: je.Model, simulated: list[Simulated]) -> dict[str, Any]:
    prepare = partial(je.prepare_contacts, model, noise=simulated[0].noise)
    spent, finder = c.seconds(prepare)

    def places(frames):
        contacts = finder(frames)
        return {"parametric": np.asarray(je.strongest(contacts))}, np.asarray(contacts.strength.sum(-1))

    def find(frames):
        contacts = finder(frames)
        return [p[here] for p, here in zip(np.asarray(contacts.position), np.asarray(contacts.present), strict=True)]

    return scored(simulated, places, find) | {
        "seeds": len(simulated),
        "prepare_ms": 1e3 * spent,
        "frame_ms": frame_time(finder, simulated[0].singles),
    }


def scored(simulated: list[Simulated], places: Callable, find: Callable[[np.ndarray], Found]) -> dict[str, Any]:
    """Means over the seeds, and their standard deviations where the name ends in _sd."""
    seeds = [dict(_scores(one, places, find)) for one in simulated]
    names = seeds[0]
    mean = {name: float(np.nanmean([seed[name] for seed in seeds])) for name in names}
    return mean | {
        f"{name}_sd": float(np.nanstd([seed[name] for seed in seeds], ddof=1)) for name in names if len(seeds) > 1
    }


def _scores(one: Simulated, places: Callable, find: Callable[[np.ndarray], Found]) -> Iterator[tuple[str, float]]:
    found, sums = places(one.singles)
    for name, estimate in found.items():
        yield f"{name}_mm", 1e3 * float(np.nanmean(je.localisation_error(estimate, one.sites)))
    best = found.get("half", found.get("parametric"))
    yield "inward_mm", 1e3 * float(np.nanmean(je.inward_bias(best, one.sites, np.array([0.1, 0.1]))))
    yield "cv", float(je.coefficient_of_variation(sums, ddof=0))
    yield "false_seconds", float(np.mean([len(f) > 1 for f in find(one.singles)]))
    for (distance, share), frames in one.doubles.items():
        pairs = one.pairs[DISTANCES.index(distance)]
        yield f"pairs_{1e3 * distance:.0f}mm_1:{1 / share:.0f}", float(matched(find(frames), pairs).mean())


def frame_time(apply: Callable, frames: np.ndarray, budget: float = 1.0) -> float:
    """Median, ms, one frame at a time."""
    jax.block_until_ready(apply(frames[0]))
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 5 or (time.perf_counter() - start < budget and len(times) < 200):
        times.append(c.seconds(lambda k: jax.block_until_ready(apply(frames[k % len(frames)])), len(times))[0])
    return 1e3 * float(np.median(times))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown, a line per method."""
    pairs = [name for name in rows[-1] if name.startswith("pairs") and not name.endswith("_sd")]
    heads = [
        "method",
        "peak",
        "half",
        "quarter",
        "positive",
        "fit",
        "inward",
        "CV",
        "false 2nd",
        *pairs,
        "frame ms",
        "prepare ms",
    ]
    names = [
        *(f"{k}_mm" for k in ("peak", "half", "quarter", "positive", "parametric", "inward")),
        "cv",
        "false_seconds",
    ]
    lines = [
        "| " + " | ".join(head.removeprefix("pairs_").replace("_", " ") for head in heads) + " |",
        "|---" * len(heads) + "|",
    ]
    for row in rows:
        cells = [f"{row[name]:.3g}" if name in row else "" for name in [*names, *pairs, "frame_ms", "prepare_ms"]]
        lines.append("| " + " | ".join([row["method"], *cells]) + " |")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one seed, few presses and methods; nothing written")
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    seeds, grid, pairs = (1, 4, 4) if args.smoke else (args.seeds, 15, 24)
    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    simulated = [Simulated(seed, grid, pairs) for seed in range(seeds)]
    data: dict[str, Any] = {"circumstances": c.circumstances(), "seeds": seeds, "rows": []}
    methods = {name: METHODS[name] for name in (["one step, NOSER"] if args.smoke else METHODS)}
    fits = {"contacts, fitted": partial(by_fit, model, simulated)}
    images = {name: partial(by_image, model, simulated, settings) for name, settings in methods.items()}
    for name, measure in (fits | images).items():
        data["rows"].append({"method": name} | measure())
        print(name, flush=True)
        if not args.smoke:
            c.write("images", c.closed(data))
    print(table(data["rows"]), flush=True)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
