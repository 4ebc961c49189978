"""What contacts followed through time tell: two that come one after the other, crossing, edges, and what is learned.

For each seed the testbed is coated anew, on another mesh than that of the tracker, with noise 60 dB below the readings
and the sheet fitted to the mean of 100 untouched frames. Frames come at 100 Hz, the force of a tip rises within 0.1 s,
and the pads tell their forces, from the load on their rectangles, to 3 % and 0.1 N. "told": at the end there are as
many contacts as tips, each within half their distance of its own, at most 15 mm; of an edge, one. "kept": the number of
each contact is the same in all frames at full force. "covered": the ellipse of 90 % holds the place, in these frames.

coverage: single tips of several shapes (those of `bench_loads`), noise 40, 60 and 80 dB below the readings, the sheet
known or not: how often ellipses and intervals of 90 % hold place and force;
at 60 dB without forces on pads too.

What may have happened is asked at once, as in a recording, or by a bounded number of pieces after each frame, as live
does. "delay": from the first force of the last tip until as many contacts are told; "kept": from then on.
"""

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2, norm

import jaxeit as je
from calib.live.follower import PIECES
from jaxeit.tracking import Tracker, TrackerSettings, Tracking, prepare_tracker

from .bench_loads import NOISES, SHAPES, TIP_SPREAD, WITHIN, Touch, shaped
from .clock import seconds
from .harness import Question, Run, with_one_blas_thread
from .problems import fit_model, matched, pressed, uneven
from .rows import Row, group_means, rounded

RATE, RISE = 100.0, 0.1  # frames a second; s until a tip presses with its full force
LOAD, SPREAD = 15.0, 0.012  # N; m, width of the load of a tip
DISTANCES, LENGTHS = (0.015, 0.02, 0.025, 0.03, 0.04), (0.03, 0.04, 0.06)  # m
GAP, SPEED = 0.04, 0.1  # m between contacts that cross, and m/s
TIPS = 9  # of an edge
PAD_ERROR = (0.03, 0.1)  # relative, and N
CELLS = 40  # along each side of a pad, whose forces are summed
INSIDE = float(chi2.ppf(0.9, 2))
HELD, FIRST_SHAPES = 16, 620  # frames of a tip of another shape; first seed of their skins
PRESSES = 40  # of a seed, one after the other, from which the gain of the contact layer is learned


class Scene(NamedTuple):
    """Name, places (frames, k, 2) m and loads (frames, k) N of tips, whether they are one contact, how the pad spreads
    each (to a standard deviation, m, or as a half-space does), and their diameter, m."""

    name: str
    places: np.ndarray
    loads: np.ndarray
    edge: bool = False
    spread: float | je.effects.IndentationSpreading = SPREAD
    diameter: float = 0.02

    def truth(self, frame: int) -> np.ndarray:
        """Places (n, 2) m of the contacts of a frame: of an edge, its middle."""
        there = self.places[frame][self.loads[frame] > 0]
        return there.mean(0)[None] if self.edge and len(there) else there


class Shown(NamedTuple):
    """A difference frame V, seconds since the last one, and forces on pads with their standard errors N."""

    frame: np.ndarray
    seconds: float
    forces: np.ndarray
    errors: np.ndarray


def rising(frames: int, begin: int, end: int | None = None) -> np.ndarray:
    """Force of a tip that presses between two frames, (frames,) N."""
    time = np.arange(frames)
    down = 1.0 if end is None else np.clip((end - time) / (RATE * RISE), 0, 1)
    return LOAD * np.clip((time - begin) / (RATE * RISE), 0, 1) * down


def _line(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    angle = rng.uniform(0, np.pi)
    return rng.uniform(0.06, 0.14, 2), np.array([np.cos(angle), np.sin(angle)])


def sequence(rng: np.random.Generator, distance: float) -> Scene:
    """A tip, and 0.15 s later a second one at a distance."""
    middle, along = _line(rng)
    places = middle + np.array([[-0.5], [0.5]]) * distance * along
    loads = np.stack([rising(40, 2), rising(40, 17)], 1)
    return Scene(f"two in sequence, {1e3 * distance:.0f} mm", np.broadcast_to(places, (40, 2, 2)), loads)


def crossing(rng: np.random.Generator) -> Scene:
    """Two tips that slide past each other."""
    time = np.arange(90) / RATE
    run = SPEED * np.clip(time - 0.15, 0, 0.7) - 0.035
    left, right = rng.uniform(0.075, 0.125, 2)
    there = [
        np.stack([left + run, np.full(90, right - GAP / 2)], 1),
        np.stack([left - run, np.full(90, right + GAP / 2)], 1),
    ]
    loads = np.stack([rising(90, 2), rising(90, 5)], 1)
    return Scene("crossing at 40 mm, 100 mm/s", np.stack(there, 1), loads)


def edge(rng: np.random.Generator, length: float) -> Scene:
    """A row of tips pressed at once."""
    middle, along = _line(rng)
    places = middle + np.linspace(-0.5, 0.5, TIPS)[:, None] * length * along
    loads = np.repeat(rising(25, 2)[:, None] / TIPS, TIPS, 1)
    return Scene(f"edge, {1e3 * length:.0f} mm", np.broadcast_to(places, (25, TIPS, 2)), loads, edge=True)


def presses(rng: np.random.Generator, count: int) -> Scene:
    """Presses at random places, one after the other."""
    frames = 26
    places = np.repeat(rng.uniform(0.02, 0.18, (count, 1, 2)), frames, 0)
    return Scene("presses", places, np.tile(rising(frames, 1, 23), count)[:, None])


def pad_loads(skin: je.Skin, scene: Scene) -> np.ndarray:
    """Force on each pad, (frames, pads) N, of which each is a rectangle."""
    out = []
    for pad in skin.pads:
        low, high = np.min(pad.outline, 0), np.max(pad.outline, 0)
        if isinstance(scene.spread, float):
            share = norm.cdf((high - scene.places) / scene.spread) - norm.cdf((low - scene.places) / scene.spread)
            on_pad = share.prod(2)
        else:
            on_pad = _half_space_share(scene, scene.spread, low, high)
        out.append((on_pad * scene.loads).sum(1))
    return np.stack(out, 1)


def _half_space_share(
    scene: Scene, spread: je.effects.IndentationSpreading, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Share (frames, k) of each load of a half-space on a rectangle, by the midpoint rule."""
    middles = (np.arange(CELLS) + 0.5) / CELLS
    points = jnp.asarray(low + np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2) * (high - low))
    places, index = np.unique(scene.places.reshape(-1, 2), axis=0, return_inverse=True)
    ideal, width = jnp.zeros(len(points)), jnp.asarray(scene.diameter)
    means = [spread(ideal, je.effects.Indenter(jnp.asarray(place), width), points).mean() for place in places]
    share: np.ndarray = np.prod(high - low) * np.array(means)[index.ravel()].reshape(scene.loads.shape)
    return share


class Bench:
    """A skin of one seed, its tracker, and how frames of a scene are simulated on it."""

    def __init__(
        self,
        model: je.Model,
        seed: int,
        decibels: int = 60,
        known: bool = True,
        settings: TrackerSettings | None = None,
    ):
        self.skin, self._seed, self._effects = je.load_skin("testbed"), seed, uneven(seed)
        self.rng = np.random.default_rng([seed, 7])
        blank = pressed(self._effects, np.full((1, 1, 2), 0.1), np.zeros((1, 1)))
        blank = blank._replace(noise=blank.noise * 10 ** ((60 - decibels) / 20))
        untouched, _ = blank.frames(self.rng)
        self.noise = blank.std
        sheet = je.fit_background(model, untouched) if known else None
        self.tracker: Tracker = prepare_tracker(model, self.skin, settings, noise=self.noise, sigma=sheet)

    def changes(self, scene: Scene) -> np.ndarray:
        """How the readings change in the frames of a scene, without noise, (frames, readings) V."""
        how = {"spread": scene.spread, "diameters": scene.diameter}
        return pressed(self._effects, scene.places, scene.loads, **how).change

    def frames(self, scene: Scene, changes: np.ndarray | None = None, pads: bool = True) -> list[Shown]:
        """What the tracker is shown of a scene, whose `changes` may be given; without pads it is told no forces."""
        shown = []
        for change, exact in zip(
            self.changes(scene) if changes is None else changes, pad_loads(self.skin, scene), strict=True
        ):
            frame = change + self.noise * self.rng.normal(size=change.size)
            errors = np.hypot(PAD_ERROR[0] * exact, PAD_ERROR[1]) if pads else np.full(len(exact), np.inf)
            heard = np.where(np.isfinite(errors), errors, 0) * self.rng.normal(size=errors.size)
            shown.append(Shown(frame, 1 / RATE, exact + heard, errors))
        return shown

    def followed(
        self, frames: Sequence[Shown], now: Tracking | None = None, pieces: int | None = None
    ) -> Iterator[tuple[int, Tracking, float]]:
        """The number of each frame, what is known after it, and the seconds of the update.

        `pieces`: of a look into an unexpected frame, after each frame; None: it is looked into at once.
        """
        now = self.tracker.start() if now is None else now
        for number, shown in enumerate(frames):
            spent, now = seconds(lambda n=now, f=shown: self.tracker.step(n, *f, whole=pieces is None))
            yield number, now, spent
            for _ in range(pieces or 0):
                now = self.tracker.look(now)


def _nearest(now: Tracking, truth: np.ndarray) -> list[tuple[float, bool]]:
    """Distance, m, of each true place from the nearest contact, and whether its ellipse of 90 % holds the place."""
    out = []
    for place in truth:
        track = min(now.tracks, key=lambda t, p=place: float(np.linalg.norm(t.position - p)))
        away = track.position - place
        out.append((float(np.linalg.norm(away)), float(away @ np.linalg.solve(track.covariance, away)) < INSIDE))
    return out


def judged(bench: Bench, scene: Scene) -> Row:
    """What was told of a scene."""
    numbers: list[tuple[int, ...]] = []
    away: list[tuple[float, bool]] = []
    spent: list[float] = []
    for frame, now, took in bench.followed(bench.frames(scene)):
        full = scene.loads[frame] > 0.99 * scene.loads.max()
        if full.all() and now.tracks:
            away += _nearest(now, scene.truth(frame))
            numbers.append(now.numbers)
            spent.append(took)
    truth, places = scene.truth(len(scene.places) - 1), np.array([t.position for t in now.tracks]).reshape(-1, 2)
    told = len(places) == 1 if scene.edge else matched(places, truth)
    return {
        "scene": scene.name,
        "told": float(told),
        "kept": float(len(set(numbers)) == 1),
        "error_mm": 1e3 * float(np.mean([error for error, _ in away])) if away else None,
        "covered": float(np.mean([inside for _, inside in away])) if away else None,
        "ms": 1e3 * float(np.median(spent)) if spent else None,
    }


def scenes(run: Run) -> Iterator[Row]:
    """Each kind of scene on several skins."""
    seeds, trials = run.sizes((4, 5), (1, 1))
    model = fit_model()
    rows: list[Row] = []
    for seed in range(400, 400 + seeds):
        bench, rng = Bench(model, seed), np.random.default_rng(seed)
        for _ in range(trials):
            every = [crossing(rng), *(sequence(rng, d) for d in DISTANCES), *(edge(rng, length) for length in LENGTHS)]
            rows += [judged(bench, scene) for scene in every]
        print(f"seed {seed}", flush=True)
    yield {"seeds": seeds, "scenes": group_means(rows, "scene", count="trials")}


def delayed(bench: Bench, scene: Scene, frames: list[Shown], pieces: int | None) -> Row:
    """What was told of a scene by one of the schedules."""
    begin = int(np.argmax((scene.loads > 0).all(1)))
    states = [now for _, now, _ in bench.followed(frames, pieces=pieces)]
    counts = np.array([len(now.numbers) for now in states])
    told = np.flatnonzero((counts == len(scene.places[0])) & (np.arange(len(counts)) >= begin))
    full = states[told[0] :] if len(told) else []
    final = np.array([t.position for t in states[-1].tracks]).reshape(-1, 2)
    return {
        "scene": scene.name,
        "schedule": "at once" if pieces is None else f"{pieces} pieces a frame",
        "told": float(matched(final, scene.truth(len(states) - 1))),
        "kept": float(len({now.numbers for now in full}) == 1),
        "error_mm": 1e3 * float(np.mean([e for e, _ in _nearest(states[-1], scene.truth(-1))])) if len(final) else None,
        "delay_ms": 1e3 / RATE * float(told[0] - begin) if len(told) else None,
    }


def schedules(run: Run) -> Iterator[Row]:
    """The same frames with looks into unexpected ones at once, and piece by piece."""
    seeds, trials = run.sizes((2, 3), (1, 1))
    model = fit_model()
    rows: list[Row] = []
    for seed in range(600, 600 + seeds):
        bench, rng = Bench(model, seed), np.random.default_rng(seed)
        for _ in range(trials):
            for scene in [crossing(rng), *(sequence(rng, d) for d in run.sizes((0.02, 0.03, 0.04), (0.03,)))]:
                frames = bench.frames(scene)
                rows += [delayed(bench, scene, frames, pieces) for pieces in (None, PIECES)]
        print(f"seed {seed}", flush=True)
    yield {"schedules": group_means(rows, "scene", "schedule", count="trials")}


def times(run: Run) -> Iterator[Row]:
    """Wall and processor time of ordinary frames with one and two contacts, in turn, and of pieces of looks."""
    (repeats,) = run.sizes((300,), (3,))
    scene = sequence(np.random.default_rng(700), 0.04)
    (spent,) = step_times([Bench(fit_model(), 700)], scene, repeats)
    rows = []
    for count, (wall, used) in spent.items():
        row = {"contacts": count, "p50_ms": np.median(wall), "p99_ms": np.quantile(wall, 0.99)}
        rows.append(row | {"processor_p50_ms": np.median(used), "processor_p10_ms": np.quantile(used, 0.1)})
    yield {"times": [rounded(row, 3) for row in rows]}


def step_times(benches: Sequence[Bench], scene: Scene, repeats: int) -> list[dict[int, np.ndarray]]:
    """Wall and processor time (2, repeats), ms, of ordinary frames with one and two contacts; all benches in turn."""
    known = []
    for bench in benches:
        frames = bench.frames(scene)
        known.append({len(now.numbers): (now, frames[number]) for number, now, _ in bench.followed(frames)})
    spent: list[dict[int, list[tuple[float, float]]]] = [{count: [] for count in (1, 2)} for _ in benches]
    for _ in range(repeats):
        for count in (1, 2):
            for bench, states, found in zip(benches, known, spent, strict=True):
                now, shown = states[count]
                begin = time.process_time()
                wall, _ = seconds(lambda b=bench, n=now, f=shown: b.tracker.step(n, *f, whole=False))
                found[count].append((wall, time.process_time() - begin))
    return [{count: 1e3 * np.transpose(of_count) for count, of_count in found.items()} for found in spent]


def learning(run: Run) -> Iterator[Row]:
    """Presses at unknown places, one after the other: place and force, as the gain of the contact layer is learned."""
    seeds, count = run.sizes((4, PRESSES), (1, 2))
    model = fit_model()
    rows: list[Row] = []
    for seed in range(500, 500 + seeds):
        bench = Bench(model, seed)
        for learns in (True, False):
            scene = presses(np.random.default_rng(seed), count)
            now, per_press = bench.tracker.start(), len(scene.places) // count
            for press in range(count):
                part = Scene(scene.name, *(a[press * per_press : (press + 1) * per_press] for a in scene[1:3]))
                errors, inside, extra = [], [], 0
                begin = now if learns else bench.tracker.start()
                for frame, now, _ in bench.followed(bench.frames(part), begin):
                    extra = max(extra, len(now.tracks) - 1)
                    if part.loads[frame, 0] > 0.99 * LOAD and now.tracks:
                        ((error, held),) = _nearest(now, part.truth(frame))
                        errors.append(error)
                        inside.append(held)
                rows.append(
                    {
                        "learned": "yes" if learns else "no",
                        "presses": _stage(press),
                        "error_mm": 1e3 * float(np.mean(errors)) if errors else None,
                        "covered": float(np.mean(inside)) if inside else None,
                        "false_seconds": float(extra > 0),
                        "missed": float(not errors),
                    }
                )
        print(f"seed {seed}", flush=True)
    yield {"presses": group_means(rows, "learned", "presses", sd_of="none")}


def coverage(run: Run) -> Iterator[Row]:
    """Single tips of several shapes, each followed while it presses and rests."""
    seeds, count = run.sizes((3, 4), (1, 1))
    model = fit_model()
    rows: list[Row] = []
    for seed in range(FIRST_SHAPES, FIRST_SHAPES + seeds):
        rng, changes = np.random.default_rng(seed), {}
        touches = [touch for shape in SHAPES for touch in shaped(rng, shape, count)]
        for decibels in NOISES:
            for known in (True, False):
                bench = Bench(model, seed, decibels, known)
                for number, touch in enumerate(touches):
                    scene = _held(touch)
                    if number not in changes:
                        changes[number] = bench.changes(scene)
                    for pads in (True, False) if decibels == 60 else (True,):
                        row = _covered(bench, scene, touch, changes[number], pads)
                        rows.append({"shape": touch.name, "decibels": decibels, "sheet": _sheet(known)} | row)
        print(f"shapes, seed {seed}", flush=True)
    keys = ("shape", "decibels", "sheet", "pads")
    yield {"coverage": group_means(rows, *keys, count="trials", sd_of="none")}


def _sheet(known: bool) -> str:
    return "known" if known else "unknown"


def _held(touch: Touch) -> Scene:
    """A tip that presses within four frames and rests for twelve."""
    loads = np.minimum(np.arange(HELD) / 4, 1)[:, None] * touch.loads * LOAD / touch.loads.sum()
    places = np.broadcast_to(touch.places, (HELD, *touch.places.shape))
    return Scene(touch.name, places, loads, spread=SPREAD if touch.name == "gaussian" else TIP_SPREAD)


def _covered(bench: Bench, scene: Scene, touch: Touch, changes: np.ndarray, pads: bool) -> Row:
    """Whether ellipse and interval of 90 % hold place and force of a tip, in the frames at full force."""
    place: list[tuple[float, bool]] = []
    force, several = [], 0
    for frame, now, _ in bench.followed(bench.frames(scene, changes, pads)):
        several = max(several, len(now.tracks) - 1)
        if scene.loads[frame].sum() > 0.99 * LOAD and now.tracks:
            place += _nearest(now, touch.truth)
            track = max(now.tracks, key=lambda t: t.force)
            force.append(abs(np.log(track.force / LOAD)) < WITHIN * track.log_force_error)
    return {
        "pads": "yes" if pads else "no",
        "error_mm": 1e3 * float(np.mean([error for error, _ in place])) if place else None,
        "place": float(np.mean([inside for _, inside in place])) if place else None,
        "force": float(np.mean(force)) if force else None,
        "several": float(several > 0),
    }


def _stage(press: int) -> str:
    edges = (0, 5, 10, 20, PRESSES)
    place = int(np.searchsorted(edges, press, side="right"))
    return f"{edges[place - 1]} to {edges[place] - 1}"


main = Question(
    "tracking",
    __doc__,
    {"scenes": scenes, "schedules": schedules, "times": times, "learning": learning, "coverage": coverage},
)

if __name__ == "__main__":
    with_one_blas_thread()  # small matrices: threads that wait for one another cost ten times as much
    main()
