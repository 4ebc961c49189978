"""What one frame tells of contacts: how many, where and how surely, by loads and by bumps.

For each seed the skin is coated anew (CoatingNonUniformity 0.15, ContactGain 0.12), on another mesh than that of the
fits. Touches of 20 N: single tips anywhere, two tips at a distance (equal, and one of a third), edges, which are rows
of nine tips, and three tips in a triangle.

kinds: noise 60 dB below the readings, the sheet of the fits is that of the mean of 100 untouched frames. "told": the
most probable kind is the true one, and for two both places are nearer than half their distance, at most 15 mm.
"covered": the ellipse of 90 % holds the place of the single, of both of two, or the middle of the edge. The finder of
bumps (`prepare_contacts`) sees the same frames; it tells one from two, and an edge is one. "reliability": how often
kinds of a stated probability are the true ones.

drawn: touches that are drawn as `LoadSettings` believes of them before a frame, each kind as often as the others, on
further sheets, each with loads of a width of its own; their reliability, and how often the most probable kind is true.

coverage: single tips of several shapes (Gaussian; flat, ring and tilted of 40 mm, which the pad spreads by 6 mm), noise
40, 60 and 80 dB below the readings, the sheet known or not: how often they are told as one.

ellipses: such tips on other sheets, fitted as single loads only: ellipses and intervals of 90 % of place and force, and
the root of the product of the half axes of the ellipse. A case lies outside of 85 to 95 % beyond chance where frames
that err apart from one another would show so few or so many covered in 2.5 %.

round: settings of the fit for a skin that only round tips touch (`LoadSettings.round_tips`), beside the usual ones, on
further sheets: singles and near pairs, and tips of the shapes above, which these settings do not know.

chest: the same singles, pairs and edges on a curved skin.

bound: pairs and edges as the fit believes frames to be: Gaussian loads on its own mesh, under its own law, with errors
drawn from the covariance that it marginalises (noise, gain, shapes). Of such frames the odds of the fit are the ratio
of likelihoods, but for Laplace's approximation, and no other rule tells more pairs at so many edges called several
(Neyman and Pearson 1933). "several": odds above one; "at_goal": above the odds that one in twenty edges exceeds.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain, pairwise, product
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform
from scipy.stats import binom, chi2, norm

import jaxeit as je
from jaxeit.contacts import LoadFitter, LoadKind, Loads, LoadShape
from jaxeit.contacts.loads.fits.comparison import evidences, load_shape
from jaxeit.contacts.loads.fits.kinds import FrameFits
from jaxeit.contacts.loads.fits.programs import sensitivities_of
from jaxeit.contacts.loads.pressure import pad_rows, padded_forms
from jaxeit.contacts.loads.search import FrameSearch

from .clock import seconds
from .harness import Question, Run
from .problems import Pressed, fit_model, matched, pressed, uneven
from .rows import Row, grouped, rounded

LOAD = 20.0  # N
DISTANCES, SHARES = (0.015, 0.02, 0.025, 0.03, 0.04), (1.0, 1 / 3)
NEAR = (0.012, 0.015, 0.02, 0.025, 0.03)  # m, of pairs where only round tips touch
LENGTHS = (0.02, 0.03, 0.04, 0.06)
TRIANGLE = 0.025  # m, from its middle to each of three tips
TIPS = 19  # of a touch at most
INSIDE, WITHIN = float(chi2.ppf(0.9, 2)), float(norm.ppf(0.95))
GOAL, CHANCE = (0.85, 0.95), 0.025  # of coverage; of each side
NOISES, SHAPES = (40, 60, 80), ("gaussian", "flat", "ring", "tilted")
TIP, TIP_SPREAD, RING = 0.018, 0.006, 0.015  # m: radius and spread of a flat tip, radius of a ring
TILT = 0.8  # relative change of pressure from the middle of a tilted tip to its rim
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)  # of stated probability
FIRST_SEED = 340
SEVERAL = (LoadKind.TWO, LoadKind.MORE)
KEPT = 0.95  # of edges, which the goal wants to stay one contact


class Touch(NamedTuple):
    """Name of what is measured, its kind, and the places (TIPS, 2) m and loads (TIPS,) N of its tips."""

    name: str
    kind: LoadKind
    places: np.ndarray
    loads: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        """Places (n, 2) m that are looked for: of a single and of an edge, the middle of all tips."""
        there = self.places[self.loads > 0]
        if self.kind in (LoadKind.EDGE, LoadKind.ONE):
            return np.average(there, axis=0, weights=self.loads[self.loads > 0])[None]
        return there


def touches(rng: np.random.Generator, singles: int, others: int, low: np.ndarray, high: np.ndarray) -> Iterator[Touch]:
    """All touches of a seed, on a sheet whose corners are at low and high."""
    yield from round_touches(rng, singles, others, DISTANCES, low, high)
    for length in LENGTHS:
        for middle, along in lines(rng, others, low, high):
            places = middle + np.linspace(-0.5, 0.5, 9)[:, None] * length * along
            yield as_touch(f"edge, {1e3 * length:.0f} mm", LoadKind.EDGE, places, np.full(9, LOAD / 9))
    for middle, along in lines(rng, others, low, high):
        turned = np.exp(2j * np.pi * np.arange(3) / 3) * complex(*along)
        places = middle + TRIANGLE * np.stack([turned.real, turned.imag], 1)
        yield as_touch("three", LoadKind.MORE, places, np.full(3, LOAD))


def round_touches(
    rng: np.random.Generator,
    singles: int,
    others: int,
    distances: tuple[float, ...],
    low: np.ndarray,
    high: np.ndarray,
) -> Iterator[Touch]:
    """Singles, and pairs at some distances."""
    for place in rng.uniform(low + 0.02, high - 0.02, (singles, 2)):
        yield as_touch("one", LoadKind.ONE, place[None], np.array([LOAD]))
    for share in SHARES:
        for distance in distances:
            for middle, along in lines(rng, others, low, high):
                places = middle + np.array([[-0.5], [0.5]]) * distance * along
                name = f"two, 1:{1 / share:.0f}, {1e3 * distance:.0f} mm"
                yield as_touch(name, LoadKind.TWO, places, LOAD * np.array([1.0, share]))


def lines(
    rng: np.random.Generator, count: int, low: np.ndarray, high: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Middles (2,) m and directions (2,) anywhere on a sheet."""
    for _ in range(count):
        angle = rng.uniform(0, np.pi)
        yield rng.uniform(low + 0.05, high - 0.05), np.array([np.cos(angle), np.sin(angle)])


def shaped(rng: np.random.Generator, shape: str, count: int) -> Iterator[Touch]:
    """Single touches of a shape on the testbed."""
    for place in rng.uniform(0.03, 0.17, (count, 2)):
        places, loads = _tip(shape, rng.uniform(0, 2 * np.pi))
        yield as_touch(shape, LoadKind.ONE, place + places, LOAD * loads / loads.sum())


def _tip(shape: str, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and loads that make up a tip; the plane is turned by an angle."""
    if shape == "gaussian":
        return np.zeros((1, 2)), np.ones(1)
    if shape == "ring":
        turned = angle + np.pi * np.arange(12) / 6
        return RING * np.stack([np.cos(turned), np.sin(turned)], 1), np.ones(12)
    i, j = (index.ravel() for index in np.mgrid[-2:3, -2:3])
    inside = np.abs(i + j) <= 2
    places = TIP / 2 * np.stack([i + j / 2, j * np.sqrt(3) / 2], 1)[inside]
    along = places @ [np.cos(angle), np.sin(angle)] / TIP
    return places, 1 + (TILT * along if shape == "tilted" else 0 * along)


def as_touch(name: str, kind: LoadKind, places: np.ndarray, loads: np.ndarray) -> Touch:
    """A touch of fewer than `TIPS` tips."""
    spare = TIPS - len(places)
    return Touch(name, kind, np.concatenate([places, np.repeat(places[-1:], spare, 0)]), np.pad(loads, (0, spare)))


def drawn(rng: np.random.Generator, count: int, low: np.ndarray, high: np.ndarray) -> list[Touch]:
    """Touches as the settings of the fit believe of them; loads too near, or an edge too short, count as one."""
    known, found = je.contacts.LoadSettings(), []
    while len(found) < count:
        kind = LoadKind(rng.choice(len(LoadKind), p=known.prior))
        places, loads = _drawn(rng, kind, known, low, high)
        if (places >= low).all() and (places <= high).all():
            found.append(as_touch(kind.name.lower(), _counted(kind, places, known), places, loads))
    return found


def _counted(kind: LoadKind, places: np.ndarray, known: je.contacts.LoadSettings) -> LoadKind:
    """The kind of loads whose places (n, 2), m, were drawn, where those near one another count as one."""
    if kind is LoadKind.NONE:
        return kind
    if kind is LoadKind.EDGE:
        return kind if np.linalg.norm(places[-1] - places[0]) > known.shortest else LoadKind.ONE
    near = pdist(places) < known.nearest
    count = connected_components(squareform(near))[0] if len(places) > 1 else 1
    return {1: LoadKind.ONE, 2: LoadKind.TWO, 3: LoadKind.MORE}[count]


def _drawn(
    rng: np.random.Generator, kind: LoadKind, known: je.contacts.LoadSettings, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2) m, which may lie beside the sheet, and loads (n,) N of a touch."""
    place, force = rng.uniform(low, high), known.force * np.exp(known.force_spread * rng.normal())
    if kind is LoadKind.NONE:
        return place[None], np.zeros(1)
    if kind is LoadKind.EDGE:
        return place + np.linspace(-1, 1, 9)[:, None] * known.length * rng.normal(size=2), np.full(9, force / 9)
    more = {LoadKind.ONE: 0, LoadKind.TWO: 1, LoadKind.MORE: 2}[kind]
    near = place + 2 * known.length * rng.normal(size=(more, 2))
    others = np.where(rng.uniform(size=(more, 1)) < 0.5, near, rng.uniform(low, high, (more, 2)))
    forces = force * np.exp(np.append(0, known.force_difference * rng.normal(size=more)))
    return np.concatenate([place[None], others]), forces


def corners(model: je.Model) -> tuple[np.ndarray, np.ndarray]:
    """Of the flat sheet, m: the lowest and the highest coordinates."""
    chart = np.asarray(model.chart, float)
    return chart.min(0), chart.max(0)


def simulated(seed: int, given: list[Touch], **how: Any) -> Pressed:
    """The frames of touches on the skin of a seed."""
    return pressed(uneven(seed), np.stack([t.places for t in given]), np.stack([t.loads for t in given]), **how)


class Seen(NamedTuple):
    """A touch, its loads as fitted, its contacts as the finder sees them, and the milliseconds of the fit."""

    touch: Touch
    loads: Loads
    bumps: Any
    ms: float


class Prepared(NamedTuple):
    """The fitter of a sheet, its frames (n, readings) V, and their contacts as the finder sees them."""

    fitter: LoadFitter
    frames: np.ndarray
    bumps: Any


def prepared(
    model: je.Model,
    found: Pressed,
    seed: int,
    decibels: int,
    known: bool,
    settings: je.contacts.LoadSettings | None = None,
) -> Prepared:
    """Fitter and frames, with noise so many decibels below the readings, the sheet known or not."""
    rng = np.random.default_rng([seed, decibels, known])
    found = found._replace(noise=found.noise * 10 ** ((60 - decibels) / 20))
    blank, frames = found.frames(rng)
    noise = found.std
    sheet = je.fit_background(model, blank) if known else None
    finder = je.prepare_contacts(model, noise=noise, sigma=sheet)
    fitter: LoadFitter = je.contacts.prepare_loads(model, settings, noise=noise, sigma=sheet)
    return Prepared(fitter, frames, finder(frames))


def seen(ready: Prepared, given: list[Touch]) -> Iterator[Seen]:
    """What fitter and finder see of touches."""
    fitter, frames, bumps = ready
    fitter(frames[0], jax.tree.map(lambda part: part[0], bumps))
    for number, (touch, frame) in enumerate(zip(given, frames, strict=True)):
        one = jax.tree.map(lambda part, k=number: part[k], bumps)
        spent, loads = seconds(lambda f=frame, c=one: jax.block_until_ready(fitter(f, c)))
        yield Seen(touch, loads, one, 1e3 * spent)


def judged(one: Seen) -> Row:
    """What is right about the loads of a touch."""
    touch, loads = one.touch, one.loads
    shape = loads.of(touch.kind)
    assert shape is not None
    place, order = _ordered(np.asarray(shape.position), touch.truth)
    told = loads.kind is touch.kind
    if touch.kind is LoadKind.TWO:
        told = told and matched(place, touch.truth)
    inside = [_square(shape, k, t) < INSIDE for k, t in zip(order, touch.truth, strict=True)]
    probability = np.asarray(loads.probability)
    return {
        "name": touch.name,
        "told": told,
        "as_several": float(probability[LoadKind.TWO] + probability[LoadKind.MORE]) > 0.5,
        "error_mm": 1e3 * float(np.linalg.norm(place - touch.truth, axis=1).mean()),
        "covered": float(np.mean(inside)),
        "probability": float(probability[touch.kind]),
        "by_bumps": _by_bumps(touch, one.bumps),
        "ms": one.ms,
    }


def _ordered(place: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Places in the order of the true ones, each of which takes the nearest that is left."""
    left, order = list(range(len(place))), []
    for true in truth[: len(place)]:
        order.append(min(left, key=lambda k, t=true: float(np.linalg.norm(place[k] - t))))
        left.remove(order[-1])
    return place[order], order


def _square(shape: LoadShape, number: int, truth: np.ndarray) -> float:
    away = np.asarray(shape.position[number]) - truth
    return float(away @ np.linalg.solve(np.asarray(shape.position_covariance[number]), away))


def _by_bumps(touch: Touch, found: Any) -> bool:
    """Whether the finder tells one from two; an edge is one."""
    there = np.asarray(found.position)[np.asarray(found.present)]
    if touch.kind is LoadKind.TWO:
        return matched(there, touch.truth)
    return len(there) == len(touch.truth)


def means(every: list[Row], key: str) -> list[Row]:
    """Means of rows that share a name."""
    rows = []
    for name, mine in grouped(every, key).items():
        found = {k: np.mean([row[k] for row in mine]) for k in mine[0] if k != key}
        rows.append({key: name, "frames": len(mine)} | rounded(found))
    return rows


def reliability(stated: np.ndarray, true: np.ndarray) -> list[Row]:
    """How often kinds are the true ones, by the probability that was stated for them: (frames, kinds) each."""
    rows = []
    for low, high in pairwise(BINS):
        here = (stated >= low) & ((stated < high) | (high == BINS[-1]))
        if here.any():
            mean, often = float(stated[here].mean()), float(true[here].mean())
            rows.append({"stated": round(mean, 4), "true": round(often, 4), "count": int(here.sum())})
    return rows


def kinds(run: Run, skin: str = "testbed", seeds: int = 3) -> tuple[list[Row], list[Row]]:
    """Rows of all touches of a skin, and the reliability of their probabilities."""
    seeds, singles, others = run.sizes((seeds, 10, 3), (1, 1, 1))
    model = fit_model(skin)
    low, high = corners(model)
    every, stated, true = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        given = list(touches(np.random.default_rng(seed), singles, others, low, high))
        for one in seen(prepared(model, simulated(seed, given, skin=skin), seed, 60, True), given):
            every.append(judged(one))
            stated.append(np.asarray(one.loads.probability))
            true.append(np.arange(len(LoadKind)) == one.touch.kind)
        print(f"{skin}, seed {seed}", flush=True)
    return means(every, "name"), reliability(np.stack(stated), np.stack(true))


def measure_kinds(run: Run) -> Iterator[Row]:
    rows, reliable = kinds(run)
    yield {"rows": [{"touch": row.pop("name")} | row for row in rows], "reliability": reliable}


def measure_chest(run: Run) -> Iterator[Row]:
    rows, _ = kinds(run, "chest", 1)
    yield {"chest": [{"touch": row.pop("name")} | row for row in rows]}


def measure_drawn(run: Run) -> Iterator[Row]:
    seeds, count = run.sizes((6, 40), (1, 2))
    model, known = fit_model(), je.contacts.LoadSettings()
    low, high = corners(model)
    stated, true = [], []
    for seed in range(FIRST_SEED + 90, FIRST_SEED + 90 + seeds):
        rng = np.random.default_rng(seed)
        width = known.width * np.exp(known.width_spread * np.clip(rng.normal(), -1.5, 1.5))
        given = drawn(rng, count, low, high)
        for one in seen(prepared(model, simulated(seed, given, spread=width), seed, 60, True), given):
            stated.append(np.asarray(one.loads.probability))
            true.append(np.arange(len(LoadKind)) == one.touch.kind)
        print(f"seed {seed}, width {1e3 * width:.0f} mm", flush=True)
    yield {"drawn": reliability(np.stack(stated), np.stack(true)), "drawn_kinds": list(told_kinds(stated, true))}


def told_kinds(stated: list[np.ndarray], true: list[np.ndarray]) -> Iterator[Row]:
    """For each kind: frames of it, how often it is the most probable, and how often it is true where it is."""
    best, kind = np.argmax(stated, 1), np.argmax(true, 1)
    for one in LoadKind:
        here, said = kind == one, best == one
        yield {
            "kind": one.name.lower(),
            "frames": int(here.sum()),
            "told": float(np.mean(said[here])) if here.any() else None,
            "right": float(np.mean(here[said])) if said.any() else None,
        }


def measure_round(run: Run) -> Iterator[Row]:
    seeds, singles, others, distances = run.sizes((6, 8, 3, NEAR), (1, 1, 1, NEAR[:1]))
    model, every = fit_model(), []
    low, high = corners(model)
    for seed in range(FIRST_SEED + 110, FIRST_SEED + 110 + seeds):
        rng = np.random.default_rng(seed)
        parts = [(list(round_touches(rng, singles, others, distances, low, high)), 0.012)]
        parts += [(list(chain(*(shaped(rng, shape, others) for shape in SHAPES[1:]))), TIP_SPREAD)]
        frames = [simulated(seed, given, spread=spread) for given, spread in parts]
        found = frames[0]._replace(change=np.concatenate([part.change for part in frames]))
        given = [touch for some, _ in parts for touch in some]
        usual, of_round = (
            [judged(one) for one in seen(prepared(model, found, seed, 60, True, settings), given)]
            for settings in (None, je.contacts.LoadSettings.round_tips())
        )
        every += [row | {"usually": other["told"]} for row, other in zip(of_round, usual, strict=True)]
        print(f"seed {seed}", flush=True)
    yield {"round": [{"touch": row.pop("name")} | row for row in means(every, "name")]}


def measure_bound(run: Run) -> Iterator[Row]:
    count, distances, lengths = run.sizes((40, NEAR, LENGTHS), (1, NEAR[:1], LENGTHS[:1]))
    model, rows = fit_model(), []
    low, high = corners(model)
    for only_round in (False, True):
        fitter = bound_fitter(model, je.contacts.LoadSettings.round_tips() if only_round else None)
        rng = np.random.default_rng(FIRST_SEED + 130)
        given = [(f"edge, {1e3 * length:.0f} mm", LoadKind.EDGE, length) for length in lengths]
        given += [(f"two, 1:1, {1e3 * distance:.0f} mm", LoadKind.TWO, distance) for distance in distances]
        odds = {
            name: np.array(
                [several_odds(fitter, kind, m, along, size, rng) for m, along in lines(rng, count, low, high)]
            )
            for name, kind, size in given
        }
        edges = np.concatenate([found for name, found in odds.items() if name.startswith("edge")])
        limit = float(np.quantile(edges, KEPT))
        for name, found in odds.items():
            row = {"touch": name, "only_round": only_round, "frames": count}
            rows.append(row | {"several": float(np.mean(found > 0)), "at_goal": float(np.mean(found > limit))})
        print(f"only round: {only_round}", flush=True)
    yield {"bound": rows}


def bound_fitter(model: je.Model, settings: je.contacts.LoadSettings | None) -> LoadFitter:
    """A fitter on the sheet as it is, with noise 60 dB below the readings."""
    v0 = np.asarray(je.forward(model))
    noise = np.full(len(v0), 1e-3 * np.sqrt(np.mean(v0**2)))
    fitter: LoadFitter = je.contacts.prepare_loads(model, settings, noise=noise, sigma=model.background)
    return fitter


def several_odds(
    fitter: LoadFitter, kind: LoadKind, middle: np.ndarray, along: np.ndarray, size: float, rng: np.random.Generator
) -> float:
    """Log odds of several loads against one or an edge, in a frame of a kind that is drawn from the fitter's belief.

    Fits also start from the true loads, so that none is lost to a search.
    """
    belief = fitter.belief
    usual = np.append(np.asarray(belief.prior_mean)[:1], np.log(LOAD))
    if kind is LoadKind.TWO:
        ends = middle + np.array([[-0.5], [0.5]]) * size * along
        rows = np.concatenate([ends, np.tile(usual, (2, 1))], 1)
    else:
        rows = np.concatenate([middle, usual, 0.5 * size * along])[None]
    true = sensitivities_of(belief.sheet, *belief.to_jax(pad_rows(rows), padded_forms(kind)))
    value = np.asarray(true.value, float)
    y = value + FrameFits(belief, value).error_factor(true) @ rng.normal(size=len(value))
    frame = FrameFits(belief, y)
    fits = FrameSearch(frame, fitter.starts, None).search()
    fits[kind] = min(fits[kind], frame.best_fit(kind, [rows]), key=lambda fit: fit.deviance)
    found = evidences(frame, fits)
    several, other = ([found[k] for k in found if (k in SEVERAL) is wanted] for wanted in (True, False))
    return float(np.logaddexp.reduce(several) - np.logaddexp.reduce(other))


def measure_coverage(run: Run) -> Iterator[Row]:
    seeds, count = run.sizes((4, 8), (1, 1))
    yield {"coverage": means(list(_cases(range(FIRST_SEED + 50, FIRST_SEED + 50 + seeds), count, _told)), "case")}


def measure_ellipses(run: Run) -> Iterator[Row]:
    seeds, count = run.sizes((6, 8), (1, 1))
    rows = means(list(_cases(range(FIRST_SEED + 60, FIRST_SEED + 60 + seeds), count, _covered)), "case")
    yield {"ellipses": rows, "ellipses_cases": list(summed(rows))}


def _cases(seeds: Iterable[int], count: int, measure: Callable[..., Iterable[Row]]) -> Iterator[Row]:
    """What a measure says of single tips of all shapes, at all levels of noise, on known and unknown sheets."""
    model = fit_model()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        given = [list(shaped(rng, shape, count)) for shape in SHAPES]
        spreads = [0.012, *[TIP_SPREAD] * (len(SHAPES) - 1)]
        parts = [simulated(seed, some, spread=spread) for some, spread in zip(given, spreads, strict=True)]
        found = parts[0]._replace(change=np.concatenate([part.change for part in parts]))
        touched = list(chain(*given))
        for decibels, known in product(NOISES, (True, False)):
            about = f"{decibels} dB, sheet {'known' if known else 'unknown'}"
            rows = measure(prepared(model, found, seed, decibels, known), touched)
            yield from ({"case": f"{touch.name}, {about}"} | row for touch, row in zip(touched, rows, strict=True))
        print(f"seed {seed}", flush=True)


def _told(ready: Prepared, given: list[Touch]) -> Iterator[Row]:
    yield from ({"told": judged(one)["told"]} for one in seen(ready, given))


def summed(rows: list[Row]) -> Iterator[Row]:
    """How many cases of coverage lie outside of the goal, and how many beyond chance."""
    for what in ("place", "force"):
        for sheet in ("known", "unknown"):
            mine = [(row[what], row["frames"]) for row in rows if row["case"].endswith(f"sheet {sheet}")]
            outside = [not GOAL[0] <= covered <= GOAL[1] for covered, _ in mine]
            beyond = [_beyond(round(covered * frames), frames) for covered, frames in mine]
            mean = float(np.average([covered for covered, _ in mine], weights=[frames for _, frames in mine]))
            counts = {"cases": len(mine), "outside": sum(outside), "beyond": sum(beyond)}
            yield {"what": f"{what}, sheet {sheet}", "covered": round(mean, 4)} | counts


def _beyond(covered: int, frames: int) -> bool:
    """Whether so many of some frames are covered by chance in fewer than `CHANCE`, at either end of the goal."""
    return bool(binom.cdf(covered, frames, GOAL[0]) < CHANCE or binom.sf(covered - 1, frames, GOAL[1]) < CHANCE)


def _covered(ready: Prepared, given: list[Touch]) -> Iterator[Row]:
    """Whether ellipse and interval of a single load hold place and force of each touch; no other kind is fitted."""
    for number, (touch, frame) in enumerate(zip(given, ready.frames, strict=True)):
        bumps = jax.tree.map(lambda part, k=number: part[k], ready.bumps)
        fits = FrameFits(ready.fitter.belief, ready.fitter.whitened(frame, 0))
        shape = load_shape(fits, FrameSearch(fits, ready.fitter.starts, bumps).one())
        area = float(np.linalg.det(np.asarray(shape.position_covariance[0], float)))
        yield held(shape, touch.truth[0], LOAD) | {"ellipse_mm": 1e3 * float(np.sqrt(INSIDE * np.sqrt(area)))}


def held(shape: LoadShape, place: np.ndarray, force: float) -> Row:
    """By how much a single load misses a place, mm, and whether its 90 % ellipse and interval hold place and force."""
    spread = float(np.sqrt(shape.covariance[3, 3]))
    return {
        "error_mm": 1e3 * float(np.linalg.norm(np.asarray(shape.position[0]) - place)),
        "place": _square(shape, 0, place) < INSIDE,
        "force": abs(np.log(float(shape.force[0]) / force)) < WITHIN * spread,
    }


def picture(data: Row) -> Figure:
    """How often two contacts are told apart, by their distance."""
    figure = Figure(figsize=(5.5, 3.5), layout="constrained")
    axes = figure.add_subplot()
    rows = {row["touch"]: row for row in data["rows"]}
    for share in SHARES:
        names = [f"two, 1:{1 / share:.0f}, {1e3 * distance:.0f} mm" for distance in DISTANCES]
        for way, style in (("told", "-o"), ("by_bumps", "--s")):
            label = f"1:{1 / share:.0f}, by {'loads' if way == 'told' else 'bumps'}"
            axes.plot(1e3 * np.array(DISTANCES), [100 * rows[name][way] for name in names], style, label=label)
    false = [rows[name] for name in rows if name == "one" or name.startswith("edge")]
    rate = np.average([row["as_several"] for row in false], weights=[row["frames"] for row in false])
    axes.set(xlabel="distance of two contacts, mm", ylabel="told apart, %", ylim=(-3, 103))
    axes.set_title(f"one frame, 60 dB; {100 * rate:.1f} % of singles and edges are called several", fontsize=9)
    axes.legend(fontsize=8)
    return figure


PARTS = {
    "kinds": measure_kinds,
    "drawn": measure_drawn,
    "round": measure_round,
    "bound": measure_bound,
    "coverage": measure_coverage,
    "ellipses": measure_ellipses,
    "chest": measure_chest,
}
main = Question("loads", __doc__, PARTS, picture=picture, file="separation.png")

if __name__ == "__main__":
    main()
