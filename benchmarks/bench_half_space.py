"""Contacts on a skin whose cover spreads loads as an elastic half-space: what a fit gains that knows it.

The testbed is coated anew for each seed, on another mesh than that of the fits, under a half-space 10 mm deep
(`IndentationSpreading`). Noise is 60 dB below the readings, and the sheet is fitted to the mean of 100 untouched
frames. Every frame is fitted twice, one fit after the other: loads "taken for Gaussian" (`LoadSettings.depth` of 0),
and of the "half-space" (10 mm).

frames: one frame of flat round tips of 20 N: single ones of 5 to 30 mm, two of 10 mm at a distance, and edges, which
are rows of nine tips of 5 mm. "told" as in `bench_loads`: the most probable kind is the true one, and for two both
places are near. "several": two loads or more are more probable than all else, a false one for a single and an edge.
"se": standard error, as if frames erred apart
from one another; "nearer": mean and standard error of the difference of the errors of place of the same frame.

tracked: two tips of 10 mm, the second 0.15 s after the first, and edges, followed with the forces of the pads; as the
scenes of `bench_tracking`.

times: an ordinary frame of a tracker with one and with two contacts, the two trackers in turn, and the ratio of both.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import jaxeit as je
from jaxeit.contacts import LoadKind, LoadSettings
from jaxeit.tracking import TrackerSettings

from .bench_learning import DEPTH
from .bench_loads import LOAD, Seen, Touch, as_touch, corners, judged, lines, prepared, seen
from .bench_tracking import Bench, Scene, edge, judged as judged_scene, rising, sequence, step_times
from .harness import Question, Run, with_one_blas_thread
from .problems import fit_model, pressed, uneven
from .rows import Row, group_means, grouped, rounded

FIRST_SEED = 9700
SEEDS, SINGLES, OTHERS = 6, 8, 4  # skins; single tips and others of each kind on each
DIAMETERS, TIP, EDGE_TIP = (0.005, 0.03), 0.01, 0.005  # m: of single tips, of pairs, and of those of an edge
DISTANCES, LENGTHS = (0.02, 0.03, 0.04), (0.03, 0.04, 0.06)  # m
TIPS = 9  # of an edge
SPREADING = je.effects.IndentationSpreading(DEPTH)
TAKEN, KNOWN = "taken for Gaussian", "half-space"
WAYS = {TAKEN: LoadSettings(depth=0.0), KNOWN: LoadSettings(depth=DEPTH)}


class Tipped(NamedTuple):
    """A touch, and the diameter of its tips, m."""

    touch: Touch
    diameter: float


def touches(rng: np.random.Generator, sizes: tuple[int, int], low: np.ndarray, high: np.ndarray) -> Iterator[Tipped]:
    """Touches of a seed on a sheet whose corners are at low and high; sizes: how many singles, and others of a kind."""
    singles, others = sizes
    for place in rng.uniform(low + 0.02, high - 0.02, (singles, 2)):
        yield Tipped(as_touch("one", LoadKind.ONE, place[None], np.array([LOAD])), rng.uniform(*DIAMETERS))
    for distance in DISTANCES:
        for middle, along in lines(rng, others, low, high):
            places = middle + np.array([[-0.5], [0.5]]) * distance * along
            name = f"two, {1e3 * distance:.0f} mm"
            yield Tipped(as_touch(name, LoadKind.TWO, places, np.full(2, LOAD)), TIP)
    for length in LENGTHS:
        for middle, along in lines(rng, others, low, high):
            places = middle + np.linspace(-0.5, 0.5, TIPS)[:, None] * length * along
            name = f"edge, {1e3 * length:.0f} mm"
            yield Tipped(as_touch(name, LoadKind.EDGE, places, np.full(TIPS, LOAD / TIPS)), EDGE_TIP)


def measure_frames(run: Run) -> Iterator[Row]:
    seeds, sizes = run.sizes((SEEDS, (SINGLES, OTHERS)), (1, (1, 1)))
    model, every = fit_model(), []
    low, high = corners(model)
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        given = list(touches(np.random.default_rng(seed), sizes, low, high))
        every += list(fitted(model, seed, given))
        print(f"seed {seed}", flush=True)
    yield {"frames": list(summaries(every))}


def fitted(model: je.Model, seed: int, given: list[Tipped]) -> Iterator[Row]:
    """What both fits say of each touch on the skin of a seed."""
    some = [one.touch for one in given]
    places, loads = (np.stack(parts)[:, :TIPS] for parts in ([t.places for t in some], [t.loads for t in some]))
    tips = np.array([one.diameter for one in given])
    found = pressed(uneven(seed), places, loads, spread=SPREADING, diameters=tips)
    ways = [seen(prepared(model, found, seed, 60, True, settings), some) for settings in WAYS.values()]
    for both in zip(*ways, strict=True):
        yield from ({"load": way} | of_frame(one) for way, one in zip(WAYS, both, strict=True))


def of_frame(one: Seen) -> Row:
    """What is right about the loads of a touch, and how well those of its kind explain the frame."""
    shape = one.loads.of(one.touch.kind)
    assert shape is not None
    return judged(one) | {"misfit": float(shape.misfit)}


def summaries(every: list[Row]) -> Iterator[Row]:
    """Means of the frames of each kind under each of the fits."""
    for (name, way), rows in grouped(every, "name", "load").items():
        other = [row["error_mm"] for row in every if row["name"] == name and row["load"] == TAKEN]
        errors = np.array([row["error_mm"] for row in rows])
        found = {key: np.mean([row[key] for row in rows]) for key in ("told", "as_several", "covered", "misfit")}
        found |= {f"{key}_se": share_error(found[key], len(rows)) for key in ("told", "as_several")}
        compared = {"error_mm": errors} | ({} if way == TAKEN else {"nearer_mm": np.array(other) - errors})
        for key, values in compared.items():
            found |= {key: values.mean(), f"{key}_se": standard_error(values)}
        found["ms"] = np.median([row["ms"] for row in rows])
        yield {"touch": name, "load": way, "frames": len(rows)} | rounded(found)


def share_error(share: float, count: int) -> float:
    """Standard error of a share of so many frames, by Laplace's rule, under which it is not zero for all or none."""
    usual = (share * count + 1) / (count + 2)
    return float(np.sqrt(usual * (1 - usual) / count))


def standard_error(values: np.ndarray) -> float:
    """That of the mean of some numbers; zero of a single one."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def half_space_scenes(rng: np.random.Generator) -> Iterator[Scene]:
    """What is followed: a single tip, two in sequence, and an edge."""
    diameter, places = rng.uniform(*DIAMETERS), np.broadcast_to(rng.uniform(0.03, 0.17, (1, 2)), (25, 1, 2))
    yield Scene("one", places, rising(25, 2)[:, None], edge=True, spread=SPREADING, diameter=diameter)
    for distance in DISTANCES[:2]:
        yield sequence(rng, distance)._replace(spread=SPREADING, diameter=TIP)
    yield edge(rng, LENGTHS[0])._replace(spread=SPREADING, diameter=EDGE_TIP)


def measure_tracked(run: Run) -> Iterator[Row]:
    seeds, trials = run.sizes((SEEDS, OTHERS), (1, 1))
    model, rows = fit_model(), []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        rng, benches = np.random.default_rng([seed, 1]), trackers(model, seed)
        for scene in (scene for _ in range(trials) for scene in half_space_scenes(rng)):
            for way, bench in benches.items():
                rows.append({"load": way} | judged_scene(bench, scene))
        print(f"tracked, seed {seed}", flush=True)
    means = group_means(rows, "scene", "load", count="trials")
    yield {"tracked": [row | {"error_mm_se": row.get("error_mm_sd", 0.0) / np.sqrt(row["trials"])} for row in means]}


def trackers(model: je.Model, seed: int) -> dict[str, Bench]:
    """Both trackers of the skin of a seed, which see the same frames."""
    return {way: Bench(model, seed, settings=TrackerSettings(loads=loads)) for way, loads in WAYS.items()}


def measure_times(run: Run) -> Iterator[Row]:
    (repeats,) = run.sizes((300,), (3,))
    benches = trackers(fit_model(), FIRST_SEED)
    scene = sequence(np.random.default_rng(FIRST_SEED), 0.04)._replace(spread=SPREADING, diameter=TIP)
    flat, deep = step_times(list(benches.values()), scene, repeats)
    yield {"times": [times_row(count, flat[count], deep[count]) for count in flat]}


def times_row(count: int, flat: np.ndarray, deep: np.ndarray) -> Row:
    """Medians of wall and processor time, (2, repeats) ms, of both trackers, and their ratios in turn."""
    found = {"gaussian_ms": flat[0], "half_space_ms": deep[0], "wall_ratio": deep[0] / flat[0]}
    return {"contacts": count} | rounded(
        {name: np.median(values) for name, values in (found | {"processor_ratio": deep[1] / flat[1]}).items()}, 3
    )


PARTS = {"frames": measure_frames, "tracked": measure_tracked, "times": measure_times}
main = Question("half-space", __doc__, PARTS)

if __name__ == "__main__":
    with_one_blas_thread()  # small matrices: threads that wait for one another cost ten times as much
    main()
