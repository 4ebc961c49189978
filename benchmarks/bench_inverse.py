"""One-step reconstruction (NOSER) of every tool on the same work, in one run: preparation and application."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

import jaxeit as je

from .clock import limits, require_agreement, seconds
from .comparison import Comparison, inverse_work
from .harness import Question, Run
from .problems import SMOKE, Problem
from .rows import Row
from .tools import IN_DATA, Reconstruction

MAX_FLOAT32_DIFFERENCE = 1e-4  # of float32 images by matrices built in float64; those built in float32 are 2 % off
CALLS, BLOCK, BUDGET = 2000, 100, 12.0  # calls whose times are taken, in turns of a block; s for a slow one
SINGLE, STREAM, AFTER_WORK, BATCH = "single", "stream", "single, after other work", "batch"
STREAMED = 100_000  # frames, of which few enough are slow that they need so many to be counted
QUICKEST = "jaxeit, on_host(),"
LACKING = "jaxeit, on_host(), one reading is NaN,"
BY_HAND = "NumPy and SciPy, through pair sums,"
ASKED = 100  # readings of a frame of the event-driven scan
FEW = f"jaxeit, on_host(), {ASKED} readings are there,"
STILL = "as much time in the first cache"
ELSEWHERE = np.zeros(1 << 25, np.uint8)  # bytes that other work touches: sixteen times what a core keeps to itself
TOGETHER, LOOP = 1000, 100
LATE_MS = 0.1
QUANTILES = {"min": 0.0, "p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


@dataclass(frozen=True, eq=False)
class Way:
    """A way to apply a reconstruction: a call, and the images it must give.

    ``bytes`` are what it cannot but touch, ``passes`` times in a call of so many ``frames``.
    """

    call: Callable[[], np.ndarray | jax.Array]
    expected: np.ndarray
    bytes: int
    frames: int = 1
    passes: int = 1


Ways = dict[str, Way]


class Given:
    """A reconstructor as the ways in one precision have it, and the bytes that each way must touch."""

    def __init__(self, recon: je.Reconstructor, dtype: str, values: int) -> None:
        self.on_host, self.recon = recon.on_host(dtype), recon.astype(dtype)
        self.matrix, self.factor = np.asarray(self.recon.matrix), np.asarray(self.recon.factor)
        readings = jnp.eye(recon.readings, dtype=self.recon.factor.dtype)
        # From readings to weighted sums, (sums, readings): P^T W
        self.weighted_sums = sp.csr_array(np.asarray(self.recon.whitening.sums(readings)).T)
        w, ends = self.recon.whitening, values * self.factor.itemsize
        self.ours = sum(a.nbytes for a in (self.factor, w.lines, w.sign, w.weight, w.channels)) + ends
        self.dense = self.matrix.nbytes + ends
        self.compressed = self.factor.nbytes + self.weighted_sums.data.nbytes + self.weighted_sums.indices.nbytes + ends


def in_a_loop(recon: je.Reconstructor) -> Callable[[jax.Array], jax.Array]:
    """One frame after the other inside a compiled program: what an image costs without the call."""
    leaves, rest = eqx.partition(recon, eqx.is_array)
    run = jax.jit(lambda leaves, frames: jax.lax.map(eqx.combine(leaves, rest), frames))
    return lambda frames: jax.block_until_ready(run(leaves, frames))


def as_long_as(call: Callable[[], Any]) -> Callable[[], np.ndarray]:
    """Products that stay in the first cache, as many as take as long at the median: what slows these is the machine."""
    matrix, vector = np.ones((16, 64), np.float32), np.ones(64, np.float32)

    def products(count: int) -> np.ndarray:
        for _ in range(count):
            matrix.dot(vector)
        return np.ones(1)

    many = 20
    runs = call, partial(products, many)
    target, taken = np.median([[seconds(run)[0] for run in runs] for _ in range(2000)], 0)
    return partial(products, max(round(many * float(target / taken)), 1))


def both_precisions(ways: Callable[[str], Ways]) -> Ways:
    return {f"{name} {dtype}": way for dtype in ("float64", "float32") for name, way in ways(dtype).items()}


def single_ways(recon: je.Reconstructor, frame: np.ndarray) -> Ways:
    """Ways to apply a reconstructor to one frame, whole, with one reading lost, and with few readings."""
    place = np.arange(len(frame))
    asked = np.random.default_rng(1).permutation(place) < ASKED
    kept = (place >= 0, place != len(frame) // 2, asked)
    images = [np.asarray(recon.without(~there).matrix) @ np.where(there, frame, 0) for there in kept]
    exact, mended, little = images

    def ways(dtype: str) -> Ways:
        given = Given(recon, dtype, len(frame) + len(exact))
        whole, broken, few = (np.where(there, frame, np.nan).astype(dtype) for there in kept)
        on_device, many, mine = jnp.asarray(whole), jnp.tile(whole, (LOOP, 1)), given.recon
        compiled, looped, wait = mine.compiled(), in_a_loop(mine), jax.block_until_ready
        return {
            QUICKEST: Way(lambda: given.on_host(whole), exact, given.compressed),
            LACKING: Way(lambda: given.on_host(broken), mended, given.compressed),
            FEW: Way(lambda: given.on_host(few), little, given.compressed),
            "jaxeit, NumPy in and out,": Way(lambda: np.asarray(mine(whole)), exact, given.ours),
            "jaxeit, JAX array,": Way(lambda: wait(mine(on_device)), exact, given.ours),
            "jaxeit, compiled(), NumPy in and out,": Way(lambda: np.asarray(compiled(whole)), exact, given.ours),
            "jaxeit, compiled(), JAX array,": Way(lambda: wait(compiled(on_device)), exact, given.ours),
            "jaxeit, in a compiled loop,": Way(lambda: looped(many), np.tile(exact, (LOOP, 1)), given.ours, LOOP, LOOP),
            "jaxeit, one reading is NaN,": Way(lambda: np.asarray(mine(broken)), mended, given.ours),
            "NumPy, Q dv,": Way(lambda: given.matrix @ whole, exact, given.dense),
            BY_HAND: Way(lambda: given.factor @ (given.weighted_sums @ whole), exact, given.compressed),
        }

    return both_precisions(ways)


def batch_ways(recon: je.Reconstructor, frames: np.ndarray) -> Ways:
    """Ways to apply it to a batch of frames, (frames, readings), and to one of which a frame lacks a reading."""
    exact, broken, lost, last = frames @ np.asarray(recon.matrix).T, frames.copy(), 7, len(frames) - 1
    broken[last, lost], mended = np.nan, exact.copy()
    mended[last] = np.asarray(recon.without(jnp.arange(recon.readings) == lost).matrix) @ frames[last]

    def ways(dtype: str) -> Ways:
        given, n = Given(recon, dtype, frames.size + exact.size), len(frames)
        whole, lacking, mine = frames.astype(dtype), broken.astype(dtype), given.recon
        factor, sums = given.factor, given.weighted_sums
        return {
            QUICKEST: Way(lambda: given.on_host(whole), exact, given.ours, n),
            "jaxeit, NumPy in and out,": Way(lambda: np.asarray(mine(whole)), exact, given.ours, n),
            "jaxeit, one reading of one frame is NaN,": Way(lambda: np.asarray(mine(lacking)), mended, given.ours, n),
            "NumPy, Q dv,": Way(lambda: whole @ given.matrix.T, exact, given.dense, n),
            BY_HAND: Way(lambda: (sums @ whole.T).T @ factor.T, exact, given.ours, n),
        }

    return both_precisions(ways)


def stream_ways(ways: Ways) -> Ways:
    """The quickest ways, and what tells how much of their slow calls is the machine's doing."""
    found = {f"{name} float32": ways[f"{name} float32"] for name in (QUICKEST, LACKING, BY_HAND)}
    return found | {STILL: Way(as_long_as(found[f"{QUICKEST} float32"].call), np.ones(1), 0)}


def require_images(ways: Ways) -> dict[str, float]:
    """First calls, which compile: how far the images are from Q dv; stops where they are others."""
    found: dict[str, float] = {}
    for name, way in ways.items():
        outputs = {name: np.asarray(way.call()), "Q dv": way.expected}
        found |= require_agreement(outputs, "Q dv", {name: MAX_FLOAT32_DIFFERENCE} if "float32" in name else {})
    return found


def latencies(
    ways: Ways, calls: int, block: int, budget: float, between: Callable[[], Any] | None = None
) -> dict[str, np.ndarray]:
    """Seconds per frame of each call: all ways in turn, a block of calls each; a slow one stops after its budget.

    The calls of a block follow one another, as the frames of a robot do that has nothing else to do, after one which
    does not count; or each follows other work, ``between``.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(calls // block):
        for name, way in ways.items():
            left = budget - sum(times[name])
            if between is None and left > 0:
                way.call()
            times[name] += _block(way.call, block, left, between or (lambda: None))
    return {name: np.array(taken) / ways[name].frames for name, taken in times.items()}


def _block(call: Callable[[], Any], calls: int, left: float, between: Callable[[], Any]) -> list[float]:
    taken: list[float] = []
    while len(taken) < calls and sum(taken) < left:
        between()
        taken.append(seconds(call)[0])
    return taken


def other_work() -> None:
    """What a robot does between two frames: the caches hold other things thereafter."""
    np.add(ELSEWHERE, 1, out=ELSEWHERE)


def application_rows(ways: Ways, times: Mapping[str, np.ndarray], byte_per_s: float) -> Iterator[Row]:
    """ms per frame; the least time is that of a copy of as many bytes from memory."""
    for name, way in ways.items():
        ms, least = 1e3 * times[name], 1e3 * way.passes / way.frames * way.bytes / byte_per_s
        found = zip(QUANTILES, np.quantile(ms, [*QUANTILES.values()]) if len(ms) else (), strict=False)
        row: Row = {"way": name, "frames": way.frames, "calls": len(ms), "above": int(np.sum(ms > LATE_MS))}
        row |= {f"{key}_ms": round(float(value), 5) for key, value in found}
        yield row | {"bytes": way.bytes, "least_ms": round(least, 5)}


def application(run: Run) -> Iterator[Row]:
    """Single frames and a batch, with a reconstructor from any mesh: its size does not depend on it.

    Not at real-time priority: Linux stops what has it for 50 ms of each second.
    """
    problem, rng, smoke = Problem(SMOKE), np.random.default_rng(0), run.smoke
    byte_per_s = run.data.setdefault("limits", limits())["byte_per_s"]
    recon = Reconstruction(problem, True).reconstructor(problem.sigma)
    frames = rng.normal(size=(60 if smoke else TOGETHER, recon.readings))
    print("application; largest difference of the images")
    singles = single_ways(recon, frames[0])
    by_one = {name: way for name, way in singles.items() if way.frames == 1}
    calls, streamed = (CALLS // 10, STREAMED // 100) if smoke else (CALLS, STREAMED)
    plan: dict[str, tuple[Ways, int, int, Callable[[], None] | None]] = {
        SINGLE: (singles, calls, BLOCK, None),
        STREAM: (stream_ways(singles), streamed, BLOCK, None),
        AFTER_WORK: (by_one, calls // 4, 1, other_work),
        BATCH: (batch_ways(recon, frames), 3 if smoke else 20, 1, None),
    }
    out = {}
    for kind, (ways, calls, block, between) in plan.items():
        found = require_images(ways)
        times = latencies(ways, calls, block, 1.0 if smoke else BUDGET, between)
        out[kind] = [row | {"difference": found[row["way"]]} for row in application_rows(ways, times, byte_per_s)]
    yield {"application": out}


PREPARATION = Comparison("inverse", IN_DATA, "reconstruction matrices", inverse_work, 7, ("pixels", "elements"))
main = Question("inverse", __doc__, {"preparation": PREPARATION, "application": application})

if __name__ == "__main__":
    main()
