"""Forward solves per second over a data set, and the time that a fresh process needs for its first results.

python -m benchmarks.bench_batch [--smoke]
"""

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from . import problems
from .clock import Tool, alone, fresh, peak_megabytes, peaks, require_agreement, seconds
from .harness import Question, Row, Run, set_up
from .peers import cholmod, superlu
from .problems import Problem
from .tools import MAX_FLOAT32_DIFFERENCE, as_tool, compiled

SIDE, PITCH, WIDTH, AMPLITUDE = 41, 0.005, 0.012, 0.5
PIECE = 64  # contacts of a call, a multiple of every batch
SIZES, STARTUP_SIZES = (30, 60), (30, 120)
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
PEERS = {peer.NAME: peer for peer in (superlu, cholmod)}


@dataclass(frozen=True)
class Way:
    """A tool in a process of its own, with one BLAS thread or as many as BLAS likes."""

    name: str
    dtype: str = "float64"
    batch: int | None = None
    one_thread: bool = True

    def __str__(self) -> str:
        batch = f", {self.dtype}, batches of {self.batch}" if self.batch else ""
        return f"{self.name}{batch}{'' if self.one_thread else ', BLAS threads not set'}"


REFERENCE = Way(superlu.NAME)
WAYS = (
    REFERENCE,
    Way(superlu.NAME, one_thread=False),
    Way(cholmod.NAME),
    Way(cholmod.NAME, one_thread=False),
    Way("jaxeit", batch=1),
    Way("jaxeit", batch=8),
    Way("jaxeit", batch=32),
    Way("jaxeit", batch=8, one_thread=False),
    Way("jaxeit", "float32", 8),
)
SMOKE = (REFERENCE, Way("jaxeit", batch=8))


def contacts(problem: Problem, numbers: np.ndarray) -> np.ndarray:
    """(numbers, elements) S: Gaussian contacts on a grid of 41 x 41 places, each alone on the sheet."""
    centre = PITCH * np.stack([numbers % SIDE, numbers // SIDE], 1)
    offset = problem.mesh.chart_centroids - centre[:, None]
    return 1 + AMPLITUDE * np.exp(-0.5 * np.sum(offset**2, -1) / WIDTH**2)


def pieces() -> Iterator[np.ndarray]:
    """Numbers of all contacts, PIECE at a time; the last piece is filled up with the last contact."""
    for start in range(0, SIDE**2, PIECE):
        yield np.minimum(np.arange(start, start + PIECE), SIDE**2 - 1)


def ours(problem: Problem, way: Way) -> Tool:
    """A tool that solves several contacts in one call, ``way.batch`` at a time."""

    def several(model, sigma):
        return jax.lax.map(lambda s: je.forward(model, s), sigma, batch_size=way.batch)

    return as_tool(compiled(several, problem.model(way.dtype), options=je.compiler_options()), way.dtype)


def looped(tool: Tool) -> Tool:
    return lambda sigma: np.stack([tool(row) for row in sigma])


# --- what happens in the process of one tool


class Work:
    """One tool and the data set; the clock is read here, and nothing but voltages travels."""

    def __init__(self, way: Way, cells: int) -> None:
        set_up()
        self.before = peak_megabytes()
        self.problem = Problem(cells)
        self.tool = ours(self.problem, way) if way.batch else looped(PEERS[way.name].prepare(self.problem))
        # The contacts that are timed and compared lie all over the sheet.
        self.some = contacts(self.problem, np.linspace(0, SIDE**2 - 1, PIECE).astype(int))

    def first(self) -> tuple[float, np.ndarray]:
        """Seconds of the first call, compilation included, and its voltages."""
        return seconds(self.tool, self.some)

    def again(self, turn: int) -> float:
        return seconds(self.tool, self.some * (1 + 1e-3 * turn))[0]

    def whole(self) -> tuple[float, np.ndarray]:
        """The data set: seconds, without those that make the conductivities, and voltages, (1681, readings)."""
        calls = [seconds(self.tool, contacts(self.problem, numbers)) for numbers in pieces()]
        return sum(taken for taken, _ in calls), np.concatenate([out for _, out in calls])[: SIDE**2]

    def memory(self) -> dict[str, int]:
        return peaks(self.before)


work = cache(Work)


def ask(method: str, way: Way, cells: int, *args: Any) -> Any:
    return getattr(work(way, cells), method)(*args)


# --- what happens in the process that compares


@contextmanager
def threads(one: bool) -> Iterator[None]:
    """The environment of processes started meanwhile: BLAS reads it once, when it is loaded."""
    before = {name: os.environ.pop(name, None) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1") if one else {})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def started(way: Way, cells: int, stack: ExitStack) -> Callable:
    """``call(method, ...)`` in the process of a tool, which ends with the stack."""
    pool = stack.enter_context(alone())
    with threads(way.one_thread):
        pool.submit(os.getpid)  # starts it
    return lambda method, *args: pool.submit(ask, method, way, cells, *args).result()


def present(ways: tuple[Way, ...]) -> tuple[Way, ...]:
    absent = {name: peer.missing() for name, peer in PEERS.items() if peer.missing()}
    for name, reason in absent.items():
        print(f"{name} left out: {reason}")
    return tuple(way for way in ways if way.name not in absent)


def rates(run: Run) -> Iterator[Row]:
    """Solves per second of each way, one way after the other in each round."""
    for cells in (problems.SMOKE,) if run.smoke else SIZES:
        with ExitStack() as stack:
            tools = {way: started(way, cells, stack) for way in present(SMOKE if run.smoke else WAYS)}
            print(f"{(cells + 1) ** 2} nodes, {PIECE} contacts; largest difference of the voltages")
            first = {way: tool("first") for way, tool in tools.items()}
            loose = {str(way): MAX_FLOAT32_DIFFERENCE for way in tools if way.dtype == "float32"}
            found = require_agreement({str(way): out for way, (_, out) in first.items()}, str(REFERENCE), loose)
            times: dict[Way, list[float]] = {way: [] for way in tools}
            for turn in range(3 if run.smoke else 5):
                for way, tool in tools.items():
                    times[way].append(tool("again", turn))
            rows = {way: rate(times[way]) | tool("memory") for way, tool in tools.items()}
            for way, row in rows.items():
                labels = {"tool": str(way), "nodes": (cells + 1) ** 2, "difference": found.get(str(way), 0.0)}
                rows[way] = labels | {"first_call_s": round(first[way][0], 3)} | row
            if not run.smoke:
                best = min((w for w in tools if w.batch and w.dtype == "float64"), key=lambda w: np.median(times[w]))
                rows[best] |= whole(tools[best], str(best))
            yield {"rows": list(rows.values())}


def rate(times: list[float]) -> dict[str, float]:
    """Solves per second: median, least and most."""
    found = PIECE / np.array(times)
    summary = {"median_per_s": np.median(found), "min_per_s": found.min(), "max_per_s": found.max()}
    return {key: round(float(value), 1) for key, value in summary.items()} | {"repeats": len(times)}


def whole(tool: Callable, name: str) -> Row:
    """Time and memory of the whole data set, by our fastest way in double precision."""
    taken, voltages = tool("whole")
    if not np.isfinite(voltages).all():
        raise SystemExit(f"{name} gives voltages that are not finite")
    return {"whole_set_s": round(taken, 2), "whole_set_shape": voltages.shape, **tool("memory")}


# --- start-up: a process that knows jaxeit only until it is imported, then gets this work

STARTUP = """
import time
import jax, jaxeit as je
took = {{"import": time.time() - {begin}}}
jax.config.update("jax_enable_x64", True)
from benchmarks.bench_batch import print_startup
print_startup({cells}, took)
"""


def print_startup(cells: int, took: dict[str, float]) -> None:
    """Seconds of each step in this process; called by STARTUP."""
    problem = Problem(cells)
    sigma = jnp.asarray(problem.sigma)
    took["discretise"], (model, image) = seconds(_discretised, problem)
    took["forward"], _ = seconds(lambda: jax.block_until_ready(je.forward(model, sigma)))
    took["jacobian"], _ = seconds(lambda: jax.block_until_ready(je.jacobian(model, sigma, image)))
    print(json.dumps(took))


def _discretised(problem: Problem) -> tuple[je.Model, je.model.BasisMap]:
    model = problem.model()
    return model, je.Pixels(30).on(model)


def startup(run: Run) -> Iterator[Row]:
    """Without a cache of compiled programs, with an empty one, and with what that run left there."""
    for cells in (problems.SMOKE,) if run.smoke else STARTUP_SIZES:
        with tempfile.TemporaryDirectory() as folder:
            for name, there in (("no cache", ""), ("fresh cache", folder), ("second process", folder)):
                done = fresh(STARTUP.format(begin=time.time(), cells=cells), cache=there)[1]
                took = {step: round(spent, 3) for step, spent in json.loads(done.stdout.splitlines()[-1]).items()}
                yield {"startup": [{"nodes": (cells + 1) ** 2, "cache": name, **took}]}


main = Question("batch", __doc__, {"rows": rates, "startup": startup})

if __name__ == "__main__":
    main()
