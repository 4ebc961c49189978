"""Batches of forward solves, in solves per second; and what a process pays before its first result.

python -m benchmarks.bench_batch [--smoke]
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from . import _common as c
from .peers import cholmod, superlu

SIDE, PITCH, WIDTH, AMPLITUDE = 41, 0.005, 0.012, 0.5
PIECE = 64  # contacts of a call, a multiple of every batch
SIZES, STARTUP_SIZES = (30, 60), (30, 120)
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
LOOSE = 1e-2  # single precision: reported, not required to be nothing
PEERS = (superlu, cholmod)


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


def contacts(problem: c.Problem, numbers: np.ndarray) -> np.ndarray:
    """(numbers, elements) S: Gaussian contacts on a grid of 41 x 41 places, each alone on the sheet."""
    centre = PITCH * np.stack([numbers % SIDE, numbers // SIDE], 1)
    offset = problem.mesh.chart_centroids - centre[:, None]
    return 1 + AMPLITUDE * np.exp(-0.5 * np.sum(offset**2, -1) / WIDTH**2)


def pieces() -> Iterator[np.ndarray]:
    """Numbers of all contacts, PIECE at a time; the last piece is filled up with the last contact."""
    for start in range(0, SIDE**2, PIECE):
        yield np.minimum(np.arange(start, start + PIECE), SIDE**2 - 1)


def ours(problem: c.Problem, way: Way) -> c.Tool:
    """Some contacts after each other, ``way.batch`` at a time."""

    def several(model, sigma):
        return jax.lax.map(lambda s: je.forward(model, s), sigma, batch_size=way.batch)

    model, options = problem.model(way.dtype), je.compiler_options()
    return c.as_tool(c.compiled(several, model, options=options), way.dtype)


def looped(tool: c.Tool) -> c.Tool:
    return lambda sigma: np.stack([tool(row) for row in sigma])


# What happens in the process of one tool.


class Work:
    """One tool and the data set; the clock is read here, and nothing but voltages travels."""

    def __init__(self, way: Way, cells: int) -> None:
        c.set_up()
        self.before = c.peak_megabytes()
        self.problem = problem = c.Problem(cells)
        peers = {peer.NAME: peer for peer in PEERS}
        self.tool = ours(problem, way) if way.batch else looped(peers[way.name].prepare(problem))
        # The contacts that are timed and compared lie all over the sheet.
        self.some = contacts(problem, np.linspace(0, SIDE**2 - 1, PIECE).astype(int))

    def first(self) -> tuple[float, np.ndarray]:
        """Seconds of the first call, compilation included, and its voltages."""
        return c.seconds(self.tool, self.some)

    def again(self, turn: int) -> float:
        return c.seconds(self.tool, self.some * (1 + 1e-3 * turn))[0]

    def whole(self) -> tuple[float, np.ndarray]:
        """The data set: seconds, without those that make the conductivities, and voltages, (1681, readings)."""
        calls = [c.seconds(self.tool, contacts(self.problem, numbers)) for numbers in pieces()]
        return sum(taken for taken, _ in calls), np.concatenate([out for _, out in calls])[: SIDE**2]

    def memory(self) -> dict[str, int]:
        peak = c.peak_megabytes()
        return {"peak_mb": round(peak), "beyond_imports_mb": round(peak - self.before)}


work = cache(Work)


def ask(method: str, way: Way, cells: int, *args: Any) -> Any:
    return getattr(work(way, cells), method)(*args)


# What happens in the process that compares.


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
    spawn = multiprocessing.get_context("spawn")
    pool = stack.enter_context(ProcessPoolExecutor(1, mp_context=spawn))
    with threads(way.one_thread):
        pool.submit(os.getpid)  # starts it
    return lambda method, *args: pool.submit(ask, method, way, cells, *args).result()


def present(ways: tuple[Way, ...]) -> tuple[Way, ...]:
    absent = {peer.NAME: peer.missing() for peer in PEERS if peer.missing()}
    for name, reason in absent.items():
        print(f"{name} left out: {reason}")
    return tuple(way for way in ways if way.name not in absent)


def measure(cells: int, ways: tuple[Way, ...], repeats: int, whole: bool) -> list[dict[str, Any]]:
    with ExitStack() as stack:
        tools = {way: started(way, cells, stack) for way in present(ways)}
        first = {way: tool("first") for way, tool in tools.items()}
        nodes = (cells + 1) ** 2
        print(f"{nodes} nodes, {PIECE} contacts; largest difference of the voltages")
        voltages = {str(way): out for way, (_, out) in first.items()}
        loose = {str(way): LOOSE for way in tools if way.dtype == "float32"}
        found = c.require_agreement(voltages, str(REFERENCE), loose)
        times: dict[Way, list[float]] = {way: [] for way in tools}
        for turn in range(repeats):
            for way, tool in tools.items():
                times[way].append(tool("again", turn))
        rows = [
            {
                "tool": str(way),
                "nodes": nodes,
                "difference": found.get(str(way), 0.0),
                "first_call_s": round(first[way][0], 3),
                **rates(times[way]),
                **tool("memory"),
            }
            for way, tool in tools.items()
        ]
        return add_whole(rows, tools, times) if whole else rows


def rates(times: list[float]) -> dict[str, float]:
    """Solves per second: median, least and most."""
    rate = PIECE / np.array(times)
    summary = {"median_per_s": np.median(rate), "min_per_s": rate.min(), "max_per_s": rate.max()}
    return {key: round(float(value), 1) for key, value in summary.items()} | {"repeats": len(times)}


def add_whole(rows: list[dict[str, Any]], tools: dict[Way, Callable], times: dict[Way, list[float]]) -> list:
    """The whole data set by our quickest way in double precision."""
    best = min((w for w in tools if w.batch and w.dtype == "float64"), key=lambda way: np.median(times[way]))
    taken, voltages = tools[best]("whole")
    if not np.isfinite(voltages).all():
        raise SystemExit(f"{best} gives voltages that are not finite")
    mine = next(row for row in rows if row["tool"] == str(best))
    mine |= {"whole_set_s": round(taken, 2), "whole_set_shape": voltages.shape, **tools[best]("memory")}
    print(f"  the whole data set, {voltages.shape}: {taken:.1f} s by {best}")
    return rows


# Start-up: a process that knows jaxeit only until it is imported, then gets this work.

STARTUP = """
import sys, time
begin, cells, folder = float(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
import jax, jaxeit as je
took = {"import": time.time() - begin}
jax.config.update("jax_enable_x64", True)
if folder:  # as in calib.runtime
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
from benchmarks.bench_batch import print_startup
print_startup(cells, took)
"""
STEPS = ("import", "discretise", "forward", "jacobian")
CACHES = ("no cache", "fresh cache", "second process")


def print_startup(cells: int, took: dict[str, float]) -> None:
    """Seconds of each step in this process; called by STARTUP."""
    problem = c.Problem(cells)
    sigma = jnp.asarray(problem.sigma)
    took["discretise"], (model, image) = c.seconds(_discretised, problem)
    took["forward"], _ = c.seconds(lambda: jax.block_until_ready(je.forward(model, sigma)))
    took["jacobian"], _ = c.seconds(lambda: jax.block_until_ready(je.jacobian(model, sigma, image)))
    print(json.dumps(took))


def _discretised(problem: c.Problem) -> tuple[je.Model, je.BasisMap]:
    model = problem.model()
    return model, je.Pixels(30).on(model)


def startup(cells: int) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        runs = {name: _startup_once(cells, there) for name, there in zip(CACHES, ("", folder, folder), strict=True)}
    return [{"nodes": (cells + 1) ** 2, "cache": name, **took} for name, took in runs.items()]


def _startup_once(cells: int, folder: str) -> dict[str, float]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_COMPILATION_CACHE", "JAX_PERSISTENT"))}
    command = [sys.executable, "-c", STARTUP, str(time.time()), str(cells), folder]
    done = subprocess.run(command, cwd=c.ROOT, env=environment, check=True, capture_output=True, text=True)
    return {step: round(value, 3) for step, value in json.loads(done.stdout.splitlines()[-1]).items()}


def rate_table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| tool | nodes | solves per s, median (min to max) | first call, s | MB | beyond imports, MB |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['tool']} | {r['nodes']:,} | {r['median_per_s']:.4g} ({r['min_per_s']:.4g} to {r['max_per_s']:.4g}) "
        f"| {r['first_call_s']:.2f} | {r['peak_mb']} | {r['beyond_imports_mb']} |"
        for r in rows
    ]
    return "\n".join(lines)


def startup_table(rows: list[dict[str, Any]]) -> str:
    lines = ["| s | nodes | " + " | ".join(STEPS) + " | sum |", "|---" * (3 + len(STEPS)) + "|"]
    for row in rows:
        took = [row[step] for step in STEPS]
        cells = " | ".join(f"{value:.2f}" for value in (*took, sum(took)))
        lines.append(f"| {row['cache']} | {row['nodes']:,} | {cells} |")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="smallest size, few ways, nothing written")
    parser.add_argument("--section", default="batch", help="name of this run among the results")
    args = parser.parse_args(argv)
    data: dict[str, Any] = {"circumstances": c.circumstances(), "rows": [], "startup": []}
    save = (lambda: None) if args.smoke else (lambda: c.write(args.section, c.closed(data)))
    for cells in c.SMOKE if args.smoke else SIZES:
        data["rows"] += measure(cells, SMOKE if args.smoke else WAYS, 3 if args.smoke else 5, whole=not args.smoke)
        save()
    print(rate_table(data["rows"]), flush=True)
    for cells in (10,) if args.smoke else STARTUP_SIZES:
        data["startup"] += startup(cells)
        save()
    print(startup_table(data["startup"]), flush=True)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
