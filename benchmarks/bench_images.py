"""Localisation with every imaging method: the testbed of the paper, simulated on another mesh, six seeds.

For each seed the sheet is coated anew (CoatingNonUniformity 0.15, ContactGain 0.12), pressed to 20 N by a 20 mm tip
on the 15 x 15 grid, and pressed at two places at once; noise is 60 dB below the readings. Columns: localisation by
each estimator and inward bias (mean over the grid, mm; the uneven contact gain alone moves the centre of a press by
about 0.5 mm away from the rim), CV of the image's sum (ddof 0), share of single presses with a false second contact,
share of pairs of which both contacts and nothing else are found (within half their distance, at most 15 mm),
milliseconds per frame (one at a time, from Python) and for the preparation. Image methods find contacts by
`find_regions`, whose ``level`` is chosen so that on the singles of the first seed at most 5 % show a second one.
"Sheet known": linearised at the conductivity that `fit_background` finds in the mean of 100 untouched frames with the
same noise; otherwise at an even sheet. Iterative methods have 24 x 24 pixels, the others 40 x 40; total variation
uses the first two seeds.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle, product
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxeit as je
from calib.calibration.localisation.press_images import REPORTED_ESTIMATORS

from .clock import in_turns, seconds, spread
from .harness import Question, Run, stored
from .problems import matched, pressed, uneven
from .rows import Row, averaged

LOAD = 20.0  # N
DISTANCES, SHARES = (0.02, 0.03, 0.04, 0.06), (1.0, 1 / 3)
LEVELS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
MAX_FALSE_SECONDS = 0.05  # of the single presses may show a second contact
USUAL: Row = {"basis": je.Pixels(40), "hyperparameter": 0.1}
ITERATIVE: Row = {"basis": je.Pixels(24)}
FITS: dict[str, Row] = {"contacts, fitted": {}, "contacts, fitted, sheet known": {"sheet_known": True}}
METHODS: dict[str, Row] = {
    "back-projection": {"method": je.imaging.BackProjection()},
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
SMOKE = (*FITS, "one step, NOSER")

Found = list[np.ndarray]  # contacts of each frame, (k, 2) m


class Simulated:
    """The presses of one seed.

    | meaning                                                           | shape               | unit |
    |-------------------------------------------------------------------|---------------------|------|
    | sites of single presses                                           | (sites, 2)          | m    |
    | pairs pressed at once: name of distance and share, and places     | (pairs, 2, 2)       | m    |
    | frames: singles, then the pairs by name; less untouched           | (presses, readings) | V    |
    | noise of a reading; blank: mean of untouched frames               | (readings,)         | V    |
    """

    def __init__(self, seed: int, grid: int, pairs: int) -> None:
        rng, line = np.random.default_rng(seed), np.linspace(0.01, 0.19, grid)
        self.sites = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        centre, angle = rng.uniform(0.05, 0.15, (pairs, 2)), rng.uniform(0, np.pi, pairs)
        along = np.stack([np.cos(angle), np.sin(angle)], -1) / 2
        self.pairs: dict[str, np.ndarray] = {}
        places, loads = [np.repeat(self.sites[:, None], 2, 1)], [np.tile([LOAD, 0.0], (len(self.sites), 1))]
        for far, share in product(DISTANCES, SHARES):  # the second of a single is not loaded
            places.append(np.stack([centre - far * along, centre + far * along], -2))
            loads.append(np.tile([LOAD, share * LOAD], (pairs, 1)))
            self.pairs[f"pairs_{1e3 * far:.0f}mm_1:{1 / share:.0f}"] = places[-1]
        found = pressed(uneven(seed), np.concatenate(places), np.concatenate(loads))
        self.noise = np.full(found.untouched.size, found.noise)
        self.blank, self.frames = found.frames(rng)

    @property
    def singles(self) -> np.ndarray:
        return self.frames[: len(self.sites)]


def in_regions(recon: Any, images: np.ndarray, level: float) -> Found:
    return [je.contacts.find_regions(image, recon, level=level, least=(1 - level) / 2).centres for image in images]


def chosen_level(recon: Any, images: np.ndarray) -> float:
    """The lowest level with few enough false second contacts on single presses; the highest if no level has."""
    for level in LEVELS:
        if np.mean([len(f) > 1 for f in in_regions(recon, images, level)]) <= MAX_FALSE_SECONDS:
            return level
    return LEVELS[-1]


class Seen(NamedTuple):
    """Results of a method for a seed: places of singles by estimator, sums of their images, contacts of all frames."""

    places: dict[str, np.ndarray]
    sums: np.ndarray
    found: Found


def by_image(recon: Any, one: Simulated, level: float) -> Seen:
    images = recon(one.frames)
    singles = images[: len(one.sites)]
    places = {k: np.asarray(e(singles, recon)) for k, e in REPORTED_ESTIMATORS.items()}
    sums = np.asarray(je.metrics.image_sum(singles, recon.areas))
    return Seen(places, sums, in_regions(recon, np.asarray(images), level))


def by_fit(finder: je.contacts.ContactFinder, one: Simulated) -> Seen:
    contacts = finder(one.frames)
    singles = slice(len(one.sites))
    places = {"parametric": np.asarray(je.contacts.strongest(contacts))[singles]}
    there = zip(np.asarray(contacts.position), np.asarray(contacts.present), strict=True)
    return Seen(places, np.asarray(contacts.strength.sum(-1))[singles], [p[here] for p, here in there])


def measured(name: str, model: je.Model, simulated: Sequence[Simulated]) -> Row:
    """The row of a method; its preparation is timed once all is compiled."""
    fit = name in FITS
    settings: Row = ({} if fit else USUAL) | (FITS | METHODS)[name]
    simulated, sheet_known = simulated[: settings.pop("seeds", None)], settings.pop("sheet_known", False)
    if "basis" in settings:
        settings["basis"] = settings["basis"].on(model)
    prepare = partial(je.prepare_contacts if fit else je.prepare, model, noise=simulated[0].noise, **settings)
    coats = [je.fit_background(model, one.blank) for one in simulated] if sheet_known else [None]
    prepare(sigma=coats[0])
    spent, first = seconds(lambda: prepare(sigma=coats[0]))
    ready = [first, *(prepare(sigma=coat) for coat in coats[1:])] if sheet_known else [first] * len(simulated)
    about = {} if fit else {"level": chosen_level(first, np.asarray(first(simulated[0].singles)))}
    see: Callable[[Any, Simulated], Seen] = by_fit if fit else partial(by_image, **about)
    found = [dict(scores(one, see(method, one))) for method, one in zip(ready, simulated, strict=True)]
    times = {"frame_ms": frame_time(first, simulated[0].singles), "prepare_ms": 1e3 * spent}
    return averaged(found) | {"seeds": len(found)} | times | about


def scores(one: Simulated, seen: Seen) -> Iterator[tuple[str, float]]:
    for name, estimate in seen.places.items():
        yield f"{name}_mm", 1e3 * float(np.nanmean(je.localisation_error(estimate, one.sites)))
    best = seen.places["half" if "half" in seen.places else "parametric"]
    yield "inward_mm", 1e3 * float(np.nanmean(je.metrics.inward_bias(best, one.sites, np.array([0.1, 0.1]))))
    yield "cv", float(je.metrics.coefficient_of_variation(seen.sums, ddof=0))
    yield "false_seconds", float(np.mean([len(f) > 1 for f in seen.found[: len(one.sites)]]))
    rest = iter(seen.found[len(one.sites) :])
    for name, pairs in one.pairs.items():
        yield name, float(np.mean([matched(next(rest), pair) for pair in pairs]))


def frame_time(apply: Callable, frames: np.ndarray) -> float:
    """Median time of one frame, ms; images are computed in NumPy, which takes less time than a call of JAX."""
    apply = apply.on_host() if isinstance(apply, je.Reconstructor) else apply
    turns = cycle(frames)
    jax.block_until_ready(apply(next(turns)))
    times = in_turns({"frame": lambda: jax.block_until_ready(apply(next(turns)))}, 200, budget=1.0)["frame"]
    return spread(times)["median_ms"]


def measure(run: Run) -> Iterator[Row]:
    """A row for each method; with `--methods` those not named stay as stored."""
    seeds, grid, pairs = run.sizes((6, 15, 24), (1, 4, 4))
    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    simulated = [Simulated(seed, grid, pairs) for seed in range(seeds)]
    before = {row["method"]: row for row in stored(run.args.section)["rows"]} if run.args.methods else {}
    rows = []
    for name in run.sizes((*FITS, *METHODS), SMOKE):
        rows.append({"method": name} | measured(name, model, simulated) if run.args.methods in name else before[name])
        print(name, flush=True)
    yield {"seeds": seeds, "rows": rows}


OPTIONS: Row = {"--methods": {"default": "", "metavar": "TEXT", "help": "measure methods whose name contains TEXT"}}
main = Question("images", __doc__, {"rows": measure}, OPTIONS)

if __name__ == "__main__":
    main()
