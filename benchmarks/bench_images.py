"""Where every method says the contacts are: the testbed of the paper, simulated on another mesh, six seeds.

python -m benchmarks.bench_images [--smoke] [--seeds 6] [--only TEXT]

For each seed the sheet is coated anew (CoatingNonUniformity 0.15, ContactGain 0.12), pressed to 20 N by a
20 mm tip on the 15 x 15 grid, and pressed at two places at once; noise is 60 dB below the readings.  Columns:
localisation by each estimator and inward bias (mean over the grid, mm; the uneven contact gain alone moves the centre
of what is pressed by about 0.5 mm away from the rim), CV of the image's sum (ddof 0), false
second contacts on single presses, pairs of which both are found and nothing else (within half their distance, at
most 15 mm), milliseconds a frame (one at a time, from Python) and to prepare.  Image methods find contacts by
`find_regions`, whose ``level`` is chosen so that on the singles of the first seed at most 5 % show a second one.
"Sheet known": linearised at the conductivity that `fit_background` finds in an untouched frame, a mean of 100 with the
same noise; else at the even sheet.  Methods that work on each frame anew have 24 x 24 pixels, the others 40 x 40; total
variation has the first two seeds.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from . import _common as c

LOAD = 20.0  # N
DISTANCES, SHARES = (0.02, 0.03, 0.04, 0.06), (1.0, 1 / 3)
LEVELS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
HYPERPARAMETER = 0.1
ITERATIVE: dict[str, Any] = {"basis": je.Pixels(24)}
BLANKS = 100  # untouched frames, of which the coat is fitted to the mean
METHODS: dict[str, dict[str, Any]] = {
    "back-projection": {"method": je.BackProjection()},
    "one step, Tikhonov": {"prior": je.Tikhonov()},
    "one step, NOSER": {},
    "one step, Laplace": {"prior": je.Laplace()},
    "one step, Gaussian": {"prior": je.GaussianSmooth(noser=True)},
    "one step, bumps (the paper's second reading)": {"prior": je.Tikhonov(), "basis": je.Bumps()},
    "truncated SVD": {"method": je.TruncatedSvd()},
    "GREIT": {"method": je.Greit()},
    "GREIT, sheet known": {"method": je.Greit(), "sheet_known": True},
    "not negative": {"method": je.NonNegative()} | ITERATIVE,
    "sparse Bayes": {"method": je.SparseBayes()} | ITERATIVE,
    "total variation": {"prior": je.TotalVariation(), "method": je.Reweighted(), "seeds": 2} | ITERATIVE,
}


class Simulated:
    """The presses of one seed.

    | meaning                                                          | shape                  | unit |
    |------------------------------------------------------------------|------------------------|------|
    | sites of single presses                                          | (sites, 2)             | m    |
    | pairs pressed at once, once for each of SHARES                   | (distances, pairs, 2, 2) | m  |
    | frames: singles, then pairs by distance and share; less untouched | (presses, readings)   | V    |
    | noise of a reading; blank: mean of untouched frames              | (readings,)            | V    |
    """

    def __init__(self, seed: int, grid: int, pairs: int) -> None:
        effects = (
            je.LoadSpreading(0.012),
            je.CoatingNonUniformity(0.15, 0.03, seed=2 * seed),
            je.ContactGain(0.12, 0.015, seed=2 * seed + 1),
            je.ContactPiezoresistance(1.0, 20e3, 1.0),
        )
        model = je.discretise(je.Scene(je.load_skin("testbed"), effects), je.Fidelity.standard(edge_length=0.026))
        rng = np.random.default_rng(seed)
        line = np.linspace(0.01, 0.19, grid)
        self.sites = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        centre, angle = rng.uniform(0.05, 0.15, (pairs, 2)), rng.uniform(0, np.pi, pairs)
        along = np.stack([np.cos(angle), np.sin(angle)], -1) / 2
        far = np.array(DISTANCES)[:, None, None]
        self.pairs = np.stack([centre - far * along, centre + far * along], -2)
        v0 = np.asarray(je.forward(model))
        self.noise = np.full(v0.size, 1e-3 * np.sqrt(np.mean(v0**2)))
        self.blank = v0 + self.noise / np.sqrt(BLANKS) * rng.normal(size=v0.size)
        places, loads = self._presses()
        frames = np.asarray(_pressed(model, jnp.asarray(places), jnp.asarray(loads)))
        self.frames = frames - v0 + self.noise * rng.normal(size=frames.shape)

    def _presses(self) -> tuple[np.ndarray, np.ndarray]:
        """Two places of each press, and the loads there; the second of a single is not loaded."""
        places, shares = [np.repeat(self.sites[:, None], 2, 1)], [np.tile([1.0, 0.0], (len(self.sites), 1))]
        for pairs in self.pairs:
            places += [pairs] * len(SHARES)
            shares += [np.tile([1.0, share], (len(pairs), 1)) for share in SHARES]
        return np.concatenate(places), LOAD * np.concatenate(shares)

    @property
    def singles(self) -> np.ndarray:
        return self.frames[: len(self.sites)]

    def doubles(self, found: list) -> Iterator[tuple[float, float, list, np.ndarray]]:
        """Distance, share, what was found in those frames, and the pairs."""
        count, start = self.pairs.shape[1], len(self.sites)
        for distance, pairs in zip(DISTANCES, self.pairs, strict=True):
            for share in SHARES:
                yield distance, share, found[start : start + count], pairs
                start += count


def _forwards(model: je.Model, places: jax.Array, loads: jax.Array) -> jax.Array:
    """Readings of presses at (n, k, 2) places with (n, k) loads."""

    def frame(press):
        spread = jax.vmap(lambda place: je.load_spread(model, place, 0.02))(press[0])
        return je.forward(model, je.conductivity(model, press[1] @ spread))

    return jax.lax.map(frame, (places, loads))


_jit: Any = eqx.filter_jit  # its type leaves out what it hands on to jax.jit
_pressed = _jit(_forwards, compiler_options=je.compiler_options())  # compiled once for all seeds


Found = list[np.ndarray]  # contacts of each frame, (k, 2) m


def matched(found: Found, places: np.ndarray) -> np.ndarray:
    """Frames in which both contacts are found and nothing else."""
    reach = min(0.015, float(np.linalg.norm(places[0, 0] - places[0, 1])) / 2)
    return np.array([len(f) == 2 and _both(f, pair, reach) for f, pair in zip(found, places, strict=True)])


def _both(found: np.ndarray, pair: np.ndarray, reach: float) -> bool:
    away = np.linalg.norm(found[:, None] - pair, axis=-1)
    return bool(min(away[[0, 1], [0, 1]].max(), away[[0, 1], [1, 0]].max()) < reach)


def in_regions(recon: Any, images: np.ndarray, level: float) -> Found:
    return [je.find_regions(image, recon, level=level, least=(1 - level) / 2).centres for image in images]


def chosen_level(recon: Any, images: np.ndarray) -> float:
    """The lowest with at most 5 % false second contacts in images of singles; the highest if there is none."""
    for level in LEVELS:
        if np.mean([len(f) > 1 for f in in_regions(recon, images, level)]) <= 0.05:
            return level
    return LEVELS[-1]


@dataclass(frozen=True)
class Seen:
    """What a method makes of the frames of a seed: places of singles by estimator, sums of singles, contacts of all."""

    places: dict[str, np.ndarray]
    sums: np.ndarray
    found: Found


def by_image(model: je.Model, simulated: list[Simulated], settings: dict[str, Any]) -> dict[str, Any]:
    usual: dict[str, Any] = {"basis": je.Pixels(40), "hyperparameter": HYPERPARAMETER, "noise": simulated[0].noise}
    settings = usual | settings
    simulated, sheet_known = simulated[: settings.pop("seeds", None)], settings.pop("sheet_known", False)
    settings["basis"] = settings["basis"].on(model)
    spent, recons = prepared(partial(je.prepare, model, **settings), model, simulated, sheet_known)
    level = chosen_level(recons[0], np.asarray(recons[0](simulated[0].singles)))

    def seen(one: Simulated, recon: Any) -> Seen:
        images = recon(one.frames)
        singles = images[: len(one.sites)]
        places = {k: np.asarray(e(singles, recon)) for k, e in je.ESTIMATORS.items()}
        sums = np.asarray(je.image_sum(singles, recon.areas))
        return Seen(places, sums, in_regions(recon, np.asarray(images), level))

    return scored(simulated, recons, seen) | {"level": level, "prepare_ms": 1e3 * spent}


def by_fit(model: je.Model, simulated: list[Simulated], sheet_known: bool) -> dict[str, Any]:
    prepare = partial(je.prepare_contacts, model, noise=simulated[0].noise)
    spent, finders = prepared(prepare, model, simulated, sheet_known)

    def seen(one: Simulated, finder: je.ContactFinder) -> Seen:
        contacts = finder(one.frames)
        singles = slice(len(one.sites))
        places = {"parametric": np.asarray(je.strongest(contacts))[singles]}
        there = zip(np.asarray(contacts.position), np.asarray(contacts.present), strict=True)
        return Seen(places, np.asarray(contacts.strength.sum(-1))[singles], [p[here] for p, here in there])

    return scored(simulated, finders, seen) | {"prepare_ms": 1e3 * spent}


def prepared(prepare: Callable, model: je.Model, simulated: list[Simulated], sheet_known: bool) -> tuple[float, list]:
    """Seconds to prepare once all is compiled, and what is prepared for each seed."""
    coats = [je.fit_background(model, one.blank) if sheet_known else None for one in simulated]
    prepare(sigma=coats[0])
    spent, first = c.seconds(lambda: prepare(sigma=coats[0]))
    return spent, [first, *(prepare(sigma=coat) if sheet_known else first for coat in coats[1:])]


def scored(simulated: list[Simulated], methods: list, seen: Callable[[Simulated, Any], Seen]) -> dict[str, Any]:
    """Means over the seeds, and their standard deviations where the name ends in _sd."""
    seeds = [dict(_scores(one, seen(one, method))) for one, method in zip(simulated, methods, strict=True)]
    names = seeds[0]
    mean: dict[str, Any] = {name: float(np.nanmean([seed[name] for seed in seeds])) for name in names}
    spread = {
        f"{name}_sd": float(np.nanstd([seed[name] for seed in seeds], ddof=1)) for name in names if len(seeds) > 1
    }
    return mean | spread | {"seeds": len(simulated), "frame_ms": frame_time(methods[0], simulated[0].singles)}


def _scores(one: Simulated, seen: Seen) -> Iterator[tuple[str, float]]:
    for name, estimate in seen.places.items():
        yield f"{name}_mm", 1e3 * float(np.nanmean(je.localisation_error(estimate, one.sites)))
    best = seen.places["half" if "half" in seen.places else "parametric"]
    yield "inward_mm", 1e3 * float(np.nanmean(je.inward_bias(best, one.sites, np.array([0.1, 0.1]))))
    yield "cv", float(je.coefficient_of_variation(seen.sums, ddof=0))
    yield "false_seconds", float(np.mean([len(f) > 1 for f in seen.found[: len(one.sites)]]))
    for distance, share, found, pairs in one.doubles(seen.found):
        yield f"pairs_{1e3 * distance:.0f}mm_1:{1 / share:.0f}", float(matched(found, pairs).mean())


def frame_time(apply: Callable, frames: np.ndarray, budget: float = 1.0) -> float:
    """Median, ms, one frame at a time: in NumPy where that can be had, which takes less time than a call of JAX."""
    apply = apply.on_host() if isinstance(apply, je.Reconstructor) else apply
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
    parser.add_argument("--only", default="", metavar="TEXT", help="measure anew methods whose name contains TEXT")
    args = parser.parse_args(argv)
    c.set_up()
    seeds, grid, pairs = (1, 4, 4) if args.smoke else (args.seeds, 15, 24)
    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    simulated = [Simulated(seed, grid, pairs) for seed in range(seeds)]
    data: dict[str, Any] = {"circumstances": c.circumstances(), "seeds": seeds, "rows": []}
    methods = {name: METHODS[name] for name in (["one step, NOSER"] if args.smoke else METHODS)}
    fits = {
        "contacts, fitted": partial(by_fit, model, simulated, False),
        "contacts, fitted, sheet known": partial(by_fit, model, simulated, True),
    }
    images = {name: partial(by_image, model, simulated, settings) for name, settings in methods.items()}
    before = {row["method"]: row for row in c.stored("images")["rows"]} if args.only else {}
    for name, measure in (fits | images).items():
        data["rows"].append({"method": name} | measure() if args.only in name else before[name])
        print(name, flush=True)
    if not args.smoke:
        c.write("images", c.closed(data))
    print(table(data["rows"]), flush=True)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
