"""Forward solves per second over a data set of 1,681 contacts, each tool in a process of its own."""

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import numpy as np

import jaxeit as je

from . import problems
from .clock import Call, Tool, alone, interleaved, peak_megabytes, peaks, require_agreement, seconds, spread
from .harness import Question, Run, set_up
from .peers import cholmod, superlu
from .problems import Problem
from .rows import Row
from .tools import MAX_FLOAT32_DIFFERENCE, as_tool, compiled

SIDE, PITCH, WIDTH, AMPLITUDE = 41, 0.005, 0.012, 0.5
PIECE = 64  # contacts of a call, a multiple of every batch
SIZES = (30, 60)
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
ORDER = {"median": "median", "min": "max", "max": "min"}  # the least rate is that of the longest time
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


class Work:
    """One tool and the data set, in the process of the tool, where the clock is read."""

    def __init__(self, way: Way, cells: int) -> None:
        set_up()
        self.before = peak_megabytes()
        self.problem = Problem(cells)
        self.tool = ours(self.problem, way) if way.batch else looped(PEERS[way.name].prepare(self.problem))
        # The contacts that are timed and compared lie all over the sheet.
        self.some = contacts(self.problem, np.linspace(0, SIDE**2 - 1, PIECE).astype(int))

    def piece(self, factor: float) -> tuple[float, np.ndarray]:
        """Seconds of a call with PIECE contacts, whose conductivity is that many times as large, and its voltages."""
        return seconds(self.tool, self.some * factor)

    def whole(self) -> tuple[float, np.ndarray]:
        """The data set: seconds, without those that make the conductivities, and voltages, (1681, readings)."""
        calls = [seconds(self.tool, contacts(self.problem, numbers)) for numbers in pieces()]
        return sum(taken for taken, _ in calls), np.concatenate([out for _, out in calls])[: SIDE**2]

    def memory(self) -> dict[str, int]:
        return peaks(self.before)


work = cache(Work)


def ask(method: str, way: Way, cells: int, *args: Any) -> Any:
    return getattr(work(way, cells), method)(*args)


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


class Elsewhere:
    """A tool in a process of its own, which ends with the stack; called with a factor of the conductivities."""

    def __init__(self, way: Way, cells: int, stack: ExitStack) -> None:
        self.way, self.cells, self.last_seconds = way, cells, float("nan")
        self.pool = stack.enter_context(alone())
        with threads(way.one_thread):
            self.pool.submit(os.getpid)  # starts it

    def ask(self, method: str, *args: Any) -> Any:
        return self.pool.submit(ask, method, self.way, self.cells, *args).result()

    def __call__(self, factor: np.ndarray) -> np.ndarray:
        self.last_seconds, voltages = self.ask("piece", factor)
        return voltages


def rates(run: Run) -> Iterator[Row]:
    """Solves per second of each way, the ways in turns."""
    absent = {name: peer.missing() for name, peer in PEERS.items() if peer.missing()}
    for name, reason in absent.items():
        print(f"{name} left out: {reason}")
    ways = [way for way in run.sizes(WAYS, SMOKE) if way.name not in absent]
    for cells in run.sizes(SIZES, (problems.SMOKE,)):
        with ExitStack() as stack:
            yield {"rows": rows_of([Elsewhere(way, cells, stack) for way in ways], run.smoke)}


def rows_of(tools: Sequence[Elsewhere], smoke: bool) -> list[Row]:
    """A row for each tool at one size; the quickest of ours in float64 solves the whole data set, too."""
    nodes, unit = (tools[0].cells + 1) ** 2, np.ones(())
    print(f"{nodes} nodes, {PIECE} contacts; largest difference of the voltages")
    outputs, first = {}, {}
    for tool in tools:
        outputs[str(tool.way)] = tool(unit)
        first[tool] = tool.last_seconds
    loose = {str(tool.way): MAX_FLOAT32_DIFFERENCE for tool in tools if tool.way.dtype == "float32"}
    found = require_agreement(outputs, str(REFERENCE), loose)
    times = interleaved([Call(tool, unit) for tool in tools], 3 if smoke else 5, np.inf)
    rows: dict[Elsewhere, Row] = {}
    for tool, (own, _) in zip(tools, times, strict=True):
        labels = {"tool": str(tool.way), "nodes": nodes, "difference": found.get(str(tool.way), 0.0)}
        rows[tool] = labels | {"first_call_s": round(first[tool], 3)} | rate(own) | tool.ask("memory")
    if not smoke:
        mine = [tool for tool in tools if tool.way.batch and tool.way.dtype == "float64"]
        best = max(mine, key=lambda tool: rows[tool]["median_per_s"])
        rows[best] |= whole(best)
    return list(rows.values())


def rate(times: Sequence[float]) -> dict[str, float]:
    """Solves per second: median, least and most."""
    ms = spread(times)
    per_s = {f"{name}_per_s": round(1e3 * PIECE / ms[f"{of}_ms"], 1) for name, of in ORDER.items()}
    return per_s | {"repeats": len(times)}


def whole(tool: Elsewhere) -> Row:
    """Time and memory of the whole data set."""
    taken, voltages = tool.ask("whole")
    if not np.isfinite(voltages).all():
        raise SystemExit(f"{tool.way} gives voltages that are not finite")
    return {"whole_set_s": round(taken, 2), "whole_set_shape": voltages.shape, **tool.ask("memory")}


main = Question("batch", __doc__, {"rows": rates})

if __name__ == "__main__":
    main()
