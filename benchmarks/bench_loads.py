"""What one frame tells of contacts: how many, where and how surely, by loads and by bumps.

For each seed the testbed is coated anew (CoatingNonUniformity 0.15, ContactGain 0.12), on another mesh than that of the
fits, with noise 60 dB below the readings; the sheet of the fits is that of the mean of 100 untouched frames. Touches of
20 N: single tips anywhere, two tips at a distance (equal, and one of a third), and edges, which are rows of nine tips.
"told": the most probable kind is the true one, and for two both places are nearer than half their distance, at most
15 mm. "covered": the ellipse of 90 % holds the place of the single, of both of two, or the middle of the edge. The
finder of bumps (`prepare_contacts`) sees the same frames; it tells one from two, and an edge is one.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import chi2

import jaxeit as je
from calib.calibration.localisation.load_windows import FIDELITY
from jaxeit.contacts import LoadKind, Loads, LoadShape

from .clock import seconds
from .harness import Question, Run
from .problems import matched, pressed, uneven
from .rows import Row, grouped

LOAD = 20.0  # N
DISTANCES, SHARES = (0.015, 0.02, 0.025, 0.03, 0.04), (1.0, 1 / 3)
LENGTHS = (0.02, 0.03, 0.04, 0.06)
TIPS = 9  # of an edge
INSIDE = float(chi2.ppf(0.9, 2))


class Touch(NamedTuple):
    """Name of what is measured, its kind, and the places (TIPS, 2) m and loads (TIPS,) N of its tips."""

    name: str
    kind: LoadKind
    places: np.ndarray
    loads: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        """Places (n, 2) m that are looked for: of an edge, its middle."""
        there = self.places[self.loads > 0]
        return there.mean(0)[None] if self.kind is LoadKind.EDGE else there


def touches(rng: np.random.Generator, singles: int, others: int) -> Iterator[Touch]:
    """All touches of a seed."""
    for place in rng.uniform(0.02, 0.18, (singles, 2)):
        yield _touch("one", LoadKind.ONE, place[None], np.array([LOAD]))
    for share in SHARES:
        for distance in DISTANCES:
            for middle, along in _lines(rng, others):
                places = middle + np.array([[-0.5], [0.5]]) * distance * along
                name = f"two, 1:{1 / share:.0f}, {1e3 * distance:.0f} mm"
                yield _touch(name, LoadKind.TWO, places, LOAD * np.array([1.0, share]))
    for length in LENGTHS:
        for middle, along in _lines(rng, others):
            places = middle + np.linspace(-0.5, 0.5, TIPS)[:, None] * length * along
            yield _touch(f"edge, {1e3 * length:.0f} mm", LoadKind.EDGE, places, np.full(TIPS, LOAD / TIPS))


def _lines(rng: np.random.Generator, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for _ in range(count):
        angle = rng.uniform(0, np.pi)
        yield rng.uniform(0.05, 0.15, 2), np.array([np.cos(angle), np.sin(angle)])


def _touch(name: str, kind: LoadKind, places: np.ndarray, loads: np.ndarray) -> Touch:
    spare = TIPS - len(places)
    return Touch(name, kind, np.concatenate([places, np.repeat(places[-1:], spare, 0)]), np.pad(loads, (0, spare)))


def measured(model: je.Model, seed: int, given: list[Touch]) -> Iterator[Row]:
    """What both see of each touch of a seed."""
    rng = np.random.default_rng([seed, 1])
    found = pressed(uneven(seed), np.stack([t.places for t in given]), np.stack([t.loads for t in given]))
    blank, frames = found.frames(rng)
    noise, sheet = np.full(blank.size, found.noise), je.fit_background(model, blank)
    finder = je.prepare_contacts(model, noise=noise, sigma=sheet)
    fitter = je.contacts.prepare_loads(model, noise=noise, sigma=sheet)
    bumps = finder(frames)
    fitter(frames[0], jax.tree.map(lambda part: part[0], bumps))
    for number, (touch, frame) in enumerate(zip(given, frames, strict=True)):
        one = jax.tree.map(lambda part, k=number: part[k], bumps)
        spent, loads = seconds(lambda f=frame, c=one: jax.block_until_ready(fitter(f, c)))
        yield {"name": touch.name, "ms": 1e3 * spent, **_judged(touch, loads), "by_bumps": _by_bumps(touch, one)}


def _judged(touch: Touch, loads: Loads) -> Row:
    shape = {LoadKind.ONE: loads.one, LoadKind.TWO: loads.two, LoadKind.EDGE: loads.edge}[touch.kind]
    place, order = _ordered(np.asarray(shape.position), touch.truth)
    told = loads.kind is touch.kind
    if touch.kind is LoadKind.TWO:
        told = told and matched(place, touch.truth)
    inside = [_square(shape, k, t) < INSIDE for k, t in zip(order, touch.truth, strict=True)]
    return {
        "told": told,
        "as_two": loads.kind is LoadKind.TWO,
        "error_mm": 1e3 * float(np.linalg.norm(place - touch.truth, axis=1).mean()),
        "covered": float(np.mean(inside)),
        "probability": float(loads.probability[touch.kind]),
    }


def _ordered(place: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places in the order of the true ones, and that order."""
    order = np.arange(len(place))
    best = min((order, order[::-1]), key=lambda k: float(np.linalg.norm(place[k] - truth, axis=1).sum()))
    return place[best], best


def _square(shape: LoadShape, number: int, truth: np.ndarray) -> float:
    away = np.asarray(shape.position[number]) - truth
    own = np.asarray(shape.covariance)[4 * number :, 4 * number :][:2, :2]
    return float(away @ np.linalg.solve(own, away))


def _by_bumps(touch: Touch, seen: Any) -> bool:
    """Whether the finder tells one from two; an edge is one."""
    there = np.asarray(seen.position)[np.asarray(seen.present)]
    if touch.kind is LoadKind.TWO:
        return matched(there, touch.truth)
    return len(there) == 1


def measure(run: Run) -> Iterator[Row]:
    seeds, singles, others = run.sizes((4, 40, 10), (1, 2, 1))
    model = je.discretise(je.Scene(je.load_skin("testbed")), FIDELITY)
    every: list[Row] = []
    for seed in range(100, 100 + seeds):
        every += measured(model, seed, list(touches(np.random.default_rng(seed), singles, others)))
        print(f"seed {seed}", flush=True)
    rows = []
    for name, mine in grouped(every, "name").items():
        means = {key: round(float(np.mean([row[key] for row in mine])), 4) for key in mine[0] if key != "name"}
        rows.append({"touch": name, "frames": len(mine)} | means)
    yield {"seeds": seeds, "rows": rows}


main = Question("loads", __doc__, {"rows": measure})

if __name__ == "__main__":
    main()
