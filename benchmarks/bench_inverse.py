"""One-step reconstruction (NOSER) of every tool on the same work, in one run: preparation and application.

python -m benchmarks.bench_inverse [--smoke] [--no-memory] [--application-only]
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve

import jaxeit as je

from . import _common as c
from . import bench_jacobian
from .peers import adjoint, eidors, pyeit

PIXELS = bench_jacobian.PIXELS
HYPERPARAMETER = 0.1
PRIOR = je.Noser(floor=1e-12)  # the others know no floor; ours would lift the pixels in the corners
ELEMENTS_LARGEST = 60  # beyond, EIDORS and pyEIT take minutes for the dense system elements x elements
IN_DATA, IN_IMAGE = "by hand in data space", "by hand in image space"
EIDORS_AGREE = 1e-7
FLOAT32_IMAGES = (
    1e-4  # of images in float32 by matrices built in float64 (built in float32 they are 2 % off: not timed)
)

CALLS, BLOCK, BUDGET = 2000, 100, 12.0  # calls whose times are taken, in turns of a block; s for a slow one
SINGLE, STREAM, AFTER_WORK, BATCH = "single", "stream", "single, after other work", "batch"
STREAMED = 100_000  # frames, of which few enough are slow that they need so many to be counted
QUICKEST, LACKING, BY_HAND = (
    "jaxeit, on_host(),",
    "jaxeit, on_host(), one reading is NaN,",
    "NumPy and SciPy, through pair sums,",
)
ASKED = 100  # readings of a frame of the event-driven scan
STILL = "as much time in the first cache"
ELSEWHERE = np.zeros(1 << 25, np.uint8)  # bytes that other work touches: sixteen times what a core keeps to itself
TOGETHER, LOOP = 1000, 100
GOAL_MS, GOAL_TIMES = 0.1, 10
DTYPES = ("float64", "float32")


# Preparation: from conductivity to what turns frames into images.


def basis_map(model: je.Model, pixels: bool) -> je.BasisMap:
    return (je.Pixels(PIXELS) if pixels else je.Elements()).on(model)


class Ours:
    """`prepare`, whose clock stops when the reconstructor is there; Q is written out for comparison only."""

    def __init__(self, problem: c.Problem, pixels: bool, dtype: str = "float64") -> None:
        self.before, self.dtype = c.peak_megabytes(), dtype
        self.model = problem.model(dtype)
        self.basis = basis_map(self.model, pixels)

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        self.last_seconds, recon = c.seconds(self.reconstructor, sigma)
        self.peak = c.peak_megabytes()
        return np.asarray(recon.matrix)

    def reconstructor(self, sigma: np.ndarray) -> je.Reconstructor:
        here = jnp.asarray(sigma, self.dtype)
        recon = je.prepare(self.model, PRIOR, basis=self.basis, hyperparameter=HYPERPARAMETER, sigma=here)
        return jax.block_until_ready(recon)

    def peaks(self) -> dict[str, int]:
        return {"peak_mb": round(self.peak), "beyond_imports_mb": round(self.peak - self.before)}


def projection(problem: c.Problem, pixels: bool) -> sp.csr_array | None:
    return bench_jacobian.pixel_matrix(problem) if pixels else None


def noser(j: np.ndarray) -> tuple[np.ndarray, float]:
    """R = diag(J^T J)^0.5, and l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings, of which the trace is that of R."""
    prior = np.sqrt(np.einsum("ij,ij->j", j, j))
    return prior, HYPERPARAMETER**2 * prior.sum() / len(j)


def in_data_space(j: np.ndarray) -> np.ndarray:
    """``R^-1 J^T (J R^-1 J^T + l^2 I)^-1``."""
    prior, square = noser(j)
    gained = j / prior
    small = gained @ j.T
    np.einsum("ii->i", small)[:] += square
    return cho_solve(cho_factor(small, overwrite_a=True), gained).T


def in_image_space(j: np.ndarray) -> np.ndarray:
    """``(J^T J + l^2 R)^-1 J^T``."""
    prior, square = noser(j)
    small = j.T @ j
    np.einsum("ii->i", small)[:] += square * prior
    return cho_solve(cho_factor(small, overwrite_a=True), j.T)


def by_hand(problem: c.Problem, pixels: bool, solve: Callable[[np.ndarray], np.ndarray] = in_data_space) -> c.Tool:
    jacobian = adjoint.prepare(problem, projection(problem, pixels))
    return lambda sigma: solve(jacobian(sigma))


def strength(problem: c.Problem, pixels: bool) -> float:
    """l^2, which the others are given as a number."""
    return noser(adjoint.prepare(problem, projection(problem, pixels))(problem.sigma))[1]


def by_eidors(problem: c.Problem, pixels: bool) -> eidors.Eidors:
    return eidors.prepare_inverse(problem, strength(problem, pixels) ** 0.5, projection(problem, pixels))


PREPARE: dict[str, Callable[[c.Problem], c.Tool]] = {
    "jaxeit float64, pixels": lambda problem: Ours(problem, True),
    f"{IN_DATA}, pixels": lambda problem: by_hand(problem, True),
    f"{IN_IMAGE}, pixels": lambda problem: by_hand(problem, True, in_image_space),
    f"{eidors.NAME}, pixels": lambda problem: by_eidors(problem, True),
    "jaxeit float64, elements": lambda problem: Ours(problem, False),
    f"{IN_DATA}, elements": lambda problem: by_hand(problem, False),
    f"{eidors.NAME}, elements": lambda problem: by_eidors(problem, False),
    f"{pyeit.NAME}, elements": lambda problem: pyeit.prepare_inverse(problem, strength(problem, False)),
}
LOOSE = dict.fromkeys(PREPARE, EIDORS_AGREE)


def present(cells: int) -> list[str]:
    """Tools to run at this size."""
    absent = {peer.NAME: peer.missing() for peer in (eidors, pyeit) if peer.missing()}
    for name, reason in absent.items():
        print(f"{name} left out: {reason}")
    small = [name for name in PREPARE if "elements" not in name or cells <= ELEMENTS_LARGEST]
    return [name for name in small if not name.startswith(tuple(absent))]


def measure(cells: int, repeats: int, budget: float) -> list[tuple[list[dict[str, Any]], dict[str, Any]]]:
    run = partial(c.measured, loose=LOOSE, repeats=repeats, budget=budget)
    tools = {name: PREPARE[name] for name in present(cells)}
    return bench_jacobian.onto_each(c.Problem(cells), tools, IN_DATA, "reconstruction matrices", work, run)


def work(problem: c.Problem, factor: dict[str, float], coefficients: int) -> dict[str, Any]:
    """That of the Jacobian, and of a symmetric product, a Cholesky factor and two triangular solves for 300 numbers."""
    of_jacobian, k = bench_jacobian.work(problem, factor, coefficients), 300
    return {
        "flops": of_jacobian["flops"] + 3 * k**2 * coefficients + k**3 / 3,
        "bytes": of_jacobian["bytes"] + 8 * 2 * k * coefficients,
    }


# Application: from a frame to its image.


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


def touched(recon: je.Reconstructor) -> int:
    """Bytes of what one image needs of a reconstructor, the frame and the image."""
    w = recon.whitening
    tables = (recon.factor, w.lines, w.sign, w.weight, w.channels)
    return sum(a.nbytes for a in tables) + recon.factor.dtype.itemsize * (recon.readings + len(recon.factor))


def pair_sums(recon: je.Reconstructor) -> sp.csr_array:
    """(pair sums, readings): ``P^T W`` as a sparse matrix."""
    readings = jnp.eye(recon.readings, dtype=recon.factor.dtype)
    return sp.csr_array(np.asarray(recon.whitening.sums(readings)).T)


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
    target, taken = np.median([[c.seconds(run)[0] for run in runs] for _ in range(2000)], 0)
    return partial(products, max(round(many * float(target / taken)), 1))


def single_ways(recon: je.Reconstructor, frame: np.ndarray) -> dict[str, Way]:
    """Ways to apply a reconstructor built in float64 to one frame, in both precisions."""
    place = np.arange(len(frame))
    asked = np.random.default_rng(1).permutation(place) < ASKED
    kept = {"whole": place >= 0, "broken": place != len(frame) // 2, "asked": asked}
    given = {name: (np.where(there, frame, np.nan), _image_of(recon, there, frame)) for name, there in kept.items()}
    return {f"{name} {dtype}": way for dtype in DTYPES for name, way in _single_ways(recon, dtype, **given).items()}


def _image_of(recon: je.Reconstructor, there: np.ndarray, frame: np.ndarray) -> np.ndarray:
    return np.asarray(recon.without(~there).matrix) @ np.where(there, frame, 0)


def _single_ways(recon, dtype, whole, broken, asked) -> dict[str, Way]:
    (frame, exact), (broken, mended), (asked, little) = (
        (dv.astype(dtype), image) for dv, image in (whole, broken, asked)
    )
    on_device, many = jnp.asarray(frame), jnp.tile(frame, (LOOP, 1))
    on_host, recon, wait = recon.on_host(dtype), recon.astype(dtype), jax.block_until_ready
    compiled, looped = recon.compiled(), in_a_loop(recon)
    matrix, factor, sparse = np.asarray(recon.matrix), np.asarray(recon.factor), pair_sums(recon)
    ends = frame.nbytes + len(matrix) * frame.itemsize
    ours, dense = touched(recon), matrix.nbytes + ends
    compressed = factor.nbytes + sparse.data.nbytes + sparse.indices.nbytes + ends
    return {
        QUICKEST: Way(lambda: on_host(frame), exact, compressed),
        LACKING: Way(lambda: on_host(broken), mended, compressed),
        f"jaxeit, on_host(), {ASKED} readings are there,": Way(lambda: on_host(asked), little, compressed),
        "jaxeit, NumPy in and out,": Way(lambda: np.asarray(recon(frame)), exact, ours),
        "jaxeit, JAX array,": Way(lambda: wait(recon(on_device)), exact, ours),
        "jaxeit, compiled(), NumPy in and out,": Way(lambda: np.asarray(compiled(frame)), exact, ours),
        "jaxeit, compiled(), JAX array,": Way(lambda: wait(compiled(on_device)), exact, ours),
        "jaxeit, in a compiled loop,": Way(lambda: looped(many), np.tile(exact, (LOOP, 1)), ours, LOOP, passes=LOOP),
        "jaxeit, one reading is NaN,": Way(lambda: np.asarray(recon(broken)), mended, ours),
        "NumPy, Q dv,": Way(lambda: matrix @ frame, exact, dense),
        BY_HAND: Way(lambda: factor @ (sparse @ frame), exact, compressed),
    }


def batch_ways(recon: je.Reconstructor, frames: np.ndarray) -> dict[str, Way]:
    """Ways to apply it to a batch of frames, (frames, readings)."""
    exact, broken, lost, last = frames @ np.asarray(recon.matrix).T, frames.copy(), 7, len(frames) - 1
    broken[last, lost], mended = np.nan, exact.copy()
    mended[last] = np.asarray(recon.without(jnp.arange(recon.readings) == lost).matrix) @ frames[last]
    return {
        f"{name} {dtype}": way
        for dtype in DTYPES
        for name, way in _batch_ways(recon, dtype, frames.astype(dtype), exact, broken.astype(dtype), mended).items()
    }


def _batch_ways(recon, dtype, frames, exact, broken, mended) -> dict[str, Way]:
    on_host, recon = recon.on_host(dtype), recon.astype(dtype)
    matrix, factor, sparse = np.asarray(recon.matrix), np.asarray(recon.factor), pair_sums(recon)
    n, ends = len(frames), frames.nbytes + exact.size * frames.itemsize
    ours, dense = touched(recon) + ends, matrix.nbytes + ends
    return {
        QUICKEST: Way(lambda: on_host(frames), exact, ours, n),
        "jaxeit, NumPy in and out,": Way(lambda: np.asarray(recon(frames)), exact, ours, n),
        "jaxeit, one reading of one frame is NaN,": Way(lambda: np.asarray(recon(broken)), mended, ours, n),
        "NumPy, Q dv,": Way(lambda: frames @ matrix.T, exact, dense, n),
        BY_HAND: Way(lambda: (sparse @ frames.T).T @ factor.T, exact, ours, n),
    }


def require_images(ways: dict[str, Way]) -> dict[str, float]:
    """First calls, which compile: how far the images are from Q dv; stops where they are others."""
    found: dict[str, float] = {}
    for name, way in ways.items():
        outputs = {name: np.asarray(way.call()), "Q dv": way.expected}
        found |= c.require_agreement(outputs, "Q dv", {name: FLOAT32_IMAGES} if "float32" in name else {})
    return found


def latencies(
    ways: dict[str, Way], calls: int, block: int, budget: float, between: Callable[[], Any] | None = None
) -> dict[str, np.ndarray]:
    """Seconds per frame of each call: all ways in turn, a block of calls each; a slow one stops after its budget.

    The calls of a block follow one another, as the frames of a robot do that has nothing else to do, after one which
    does not count; or each follows other work, ``between``.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(calls // block):
        for name, way in ways.items():
            times[name] += _block(way.call, block, budget - sum(times[name]), between)
    return {name: np.array(taken) / ways[name].frames for name, taken in times.items()}


def _block(call: Callable[[], Any], calls: int, left: float, between: Callable[[], Any] | None) -> list[float]:
    taken: list[float] = []
    if between is None and left > 0:
        call()
    while len(taken) < calls and sum(taken) < left:
        if between is not None:
            between()
        taken.append(c.seconds(call)[0])
    return taken


def other_work() -> None:
    """What a robot does between two frames: the caches hold other things thereafter."""
    np.add(ELSEWHERE, 1, out=ELSEWHERE)


def copy_seconds(count: int) -> float:
    """Least time in which so many bytes are touched by a copy, half read and half written; small ones stay in cache."""
    source = np.ones(max(count // 2, 1), np.uint8)
    into = np.empty_like(source)
    return min(c.seconds(np.copyto, into, source)[0] for _ in range(50))


def application_rows(ways: dict[str, Way], times: dict[str, np.ndarray], byte_per_s: float) -> list[dict[str, Any]]:
    """ms per frame; the least times are those of a copy of as many bytes, from memory and as they lie in the caches."""
    found = {name: [1e3 * float(f(taken)) for f in STATISTICS.values()] for name, taken in times.items()}
    return [
        {
            "way": name,
            "frames": way.frames,
            "calls": len(times[name]),
            **{f"{key}_ms": round(value, 5) for key, value in zip(STATISTICS, found[name], strict=True)},
            "above": int(np.sum(1e3 * times[name] > GOAL_MS)),
            "frames_per_s": round(1e3 / found[name][0], 1),
            "bytes": way.bytes,
            "least_ms": round(1e3 * way.bytes / byte_per_s * way.passes / way.frames, 5),
            "least_cached_ms": round(1e3 * copy_seconds(way.bytes) * way.passes / way.frames, 5),
        }
        for name, way in ways.items()
    ]


STATISTICS: dict[str, Callable[[np.ndarray], Any]] = {
    "p50": np.median,
    "p99": lambda times: np.quantile(times, 0.99),
    "p99.9": lambda times: np.quantile(times, 0.999),
    "min": np.min,
    "max": np.max,
}


def stream_ways(ways: dict[str, Way]) -> dict[str, Way]:
    """The quickest ways, and what tells how much of their slow calls is the machine's doing."""
    quickest = ways[f"{QUICKEST} float32"]
    taken = {f"{name} float32": ways[f"{name} float32"] for name in (QUICKEST, LACKING, BY_HAND)}
    return taken | {STILL: Way(as_long_as(quickest.call), np.ones(1), 0)}


def application(cells: int, smoke: bool, byte_per_s: float) -> dict[str, list[dict[str, Any]]]:
    """Single frames and a batch, with a reconstructor from any mesh: its size does not depend on it.

    Not at real-time priority: Linux stops what has it for 50 ms of each second.
    """
    problem, rng = c.Problem(cells), np.random.default_rng(0)
    recon = Ours(problem, True).reconstructor(problem.sigma)
    frames = rng.normal(size=(60 if smoke else TOGETHER, recon.readings))
    print("application; largest difference of the images")
    out = {}
    singles = single_ways(recon, frames[0])
    by_one = {name: way for name, way in singles.items() if way.frames == 1}
    calls, streamed = (CALLS // 10, STREAMED // 100) if smoke else (CALLS, STREAMED)
    plan: dict[str, tuple[dict[str, Way], int, int, Callable[[], None] | None]] = {
        SINGLE: (singles, calls, BLOCK, None),
        STREAM: (stream_ways(singles), streamed, BLOCK, None),
        AFTER_WORK: (by_one, calls // 4, 1, other_work),
        BATCH: (batch_ways(recon, frames), 3 if smoke else 20, 1, None),
    }
    for kind, (ways, calls, block, between) in plan.items():
        found = require_images(ways)
        times = latencies(ways, calls, block, 1.0 if smoke else BUDGET, between)
        rows = application_rows(ways, times, byte_per_s)
        out[kind] = [row | {"difference": found[row["way"]]} for row in rows]
    return out


def application_table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| ms per frame | p50 | p99 | p99.9 | min | max | copy from memory, from cache | frames per s | calls |",
        "|---" * 9 + "|",
    ]
    for r in rows:
        times = " | ".join(f"{r[f'{key}_ms']:.4f}" for key in STATISTICS)
        least = f"{r['least_ms']:.4f}, {r['least_cached_ms']:.4f}"
        lines.append(f"| {r['way']} | {times} | {least} | {r['frames_per_s']:,.0f} | {r['calls']} |")
    return "\n".join(lines)


def verdict(data: dict[str, Any]) -> list[str]:
    """What the goals ask for, and what was measured."""
    lines = []
    for nodes in sorted({row["nodes"] for row in data["rows"]}):
        took = {row["tool"]: row["median_ms"] for row in data["rows"] if row["nodes"] == nodes}
        theirs, ours = (took.get(f"{tool}, pixels") for tool in (eidors.NAME, "jaxeit float64"))
        if theirs and ours:
            lines.append(
                f"{nodes:,} nodes onto {PIXELS**2} pixels: {theirs / ours:.1f} times as fast as EIDORS "
                f"(goal {GOAL_TIMES}: {_met(theirs >= GOAL_TIMES * ours)})"
            )
    for kind in (SINGLE, STREAM, AFTER_WORK):
        for row in data["application"][kind]:
            said = f"{kind}, {row['way']}: " + ", ".join(f"{key} {row[f'{key}_ms']:.3f}" for key in STATISTICS) + " ms"
            if kind == STREAM:
                lines.append(f"{said} ({row['above']:,} of {row['calls']:,} calls above {GOAL_MS})")
            elif row["way"].startswith("jaxeit"):
                goal = f"goal {GOAL_MS}: {_met(row['max_ms'] <= GOAL_MS)}"
                lines.append(f"{said} ({goal}; {row['p50_ms'] / row['least_ms']:.1f} times the limit)")
    return lines


def _met(goal: bool) -> str:
    return "met" if goal else "missed"


def main(argv: list[str] | None = None) -> dict[str, Any]:
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--smoke", action="store_true")
    own.add_argument("--section", default="inverse")
    own.add_argument("--application-only", action="store_true", help="leave the preparation of the last run as it is")
    args, _ = own.parse_known_args(argv)
    if args.application_only:
        c.set_up()
        data = c.stored(args.section)
    else:
        data = c.run(argv, __doc__, "inverse", PREPARE, measure, repeats=7)
    if not data:
        return data
    data["application"] = application(c.SMOKE[0], args.smoke, data["limits"]["byte_per_s"])
    data["verdict"] = verdict(data)
    for kind, rows in data["application"].items():
        print(f"{kind}\n{application_table(rows)}", flush=True)
    print("\n".join(data["verdict"]))
    if not args.smoke:
        c.write(args.section, c.closed(data))
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
