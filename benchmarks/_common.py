"""The work that every tool gets, the clock, and where results go."""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.acquisition.priority import refusal
from calib.session import replacing
from jaxeit.solvers import NestedDissection

from .peers import eidors

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
SIZES = (30, 60, 120, 240)  # cells a side, multiples of 10: the electrodes are nodes
SMOKE = (10,)
SIDE, PITCH, MARGIN = 0.2, 0.04, 0.02
AGREE = 1e-9
TURN = 0.1  # s
LEAST = 5  # turns: least and most of fewer times say little of their spread

Tool = Callable[[np.ndarray], np.ndarray]


def set_up() -> None:
    """64-bit numbers, and memory that is used again, whatever the tool (in `peers.eidors` as well).

    No cache of compiled programs, as `calib.runtime.set_up` has it: what the first call takes is measured.
    """
    jax.config.update("jax_enable_x64", True)
    je.reuse_memory()


@dataclass(frozen=True, eq=False)
class Problem:
    """The testbed sheet with 25 point electrodes on a regular mesh; SI units, P1, sheet resistance 1.

    | meaning                                                          | shape         |
    |------------------------------------------------------------------|---------------|
    | pairs: the neighbours of the 5x5 grid, both drives and senses    | (40, 2)       |
    | drive, sense: pair of each reading; the two share no electrode   | (1372,)       |
    | pattern: drive+, drive-, sense+, sense-                          | (1372, 4)     |
    | electrode_nodes                                                  | (25,)         |
    | sigma: conductivity, varied so that no tool can profit from one  | (elements,)   |
    """

    cells: int

    @cached_property
    def mesh(self) -> je.Mesh:
        return je.structured(je.Rectangle(SIDE, SIDE), self.cells, self.cells)

    @cached_property
    def points(self) -> np.ndarray:
        line = MARGIN + PITCH * np.arange(5)
        return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)

    @cached_property
    def electrode_nodes(self) -> np.ndarray:
        column, row = np.rint(self.points / SIDE * self.cells).astype(int).T
        nodes = row * (self.cells + 1) + column
        if not np.allclose(self.mesh.nodes[nodes], self.points, atol=1e-12):
            raise ValueError(f"{self.cells} cells a side put no nodes at the electrodes; give a multiple of 10")
        return nodes

    @cached_property
    def pairs(self) -> np.ndarray:
        grid = np.arange(25).reshape(5, 5)
        along = np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()], 1)
        return np.concatenate([along, np.stack([grid[:-1].ravel(), grid[1:].ravel()], 1)])

    @cached_property
    def kept(self) -> np.ndarray:
        """(40, 40) whether drive and sense share no electrode."""
        shared = self.pairs[:, None, :, None] == self.pairs[None, :, None, :]
        return ~shared.any((2, 3))

    @cached_property
    def pattern(self) -> np.ndarray:
        drive, sense = np.nonzero(self.kept)
        return np.concatenate([self.pairs[drive], self.pairs[sense]], 1)

    @cached_property
    def sigma(self) -> np.ndarray:
        x, y = (self.mesh.chart_centroids / SIDE).T
        return 1 + 0.3 * np.sin(5 * x) * np.cos(4 * y)

    def model(self, dtype: str = "float64", order: int = 1) -> je.Model:
        electrodes = tuple(je.PointElectrode(tuple(p)) for p in self.points.tolist())
        skin = je.Skin("bench", je.Rectangle(SIDE, SIDE), 1.0, electrodes, je.Protocol(self.pattern, 1.0), ())
        fidelity = je.Fidelity(order=order, dtype=dtype, solver=NestedDissection())
        return je.discretise(je.Scene(skin), fidelity, mesh=self.mesh)


def compiled(verb: Callable, model: je.Model, *extra: Any, options: Mapping[str, Any] | None = None) -> Callable:
    """``verb(model, sigma, *extra)`` under one jit, with no compiler options but these; a function of sigma."""
    run = je.bind(lambda model, extra, sigma: verb(model, sigma, *extra), model, extra, options=options or {})
    return lambda sigma: jax.block_until_ready(run(sigma))


def as_tool(run: Callable, dtype: str = "float64") -> Tool:
    """A jitted function as the other tools are: NumPy in, NumPy out, transfers included."""
    return lambda sigma: np.asarray(run(np.asarray(sigma, dtype)))


def seconds(call: Callable, *args: Any) -> tuple[float, Any]:
    start = time.perf_counter()
    out = call(*args)
    return time.perf_counter() - start, out


def taken(tool: Tool, sigma: np.ndarray) -> tuple[float, np.ndarray]:
    """Seconds of a call and what it gives; a tool in another process reads the clock itself, without the transport."""
    outside, out = seconds(tool, sigma)
    return getattr(tool, "last_seconds", outside), out


class Times(NamedTuple):
    """Seconds of the calls of a tool, one a turn; and of the first calls in a turn, after all the other tools."""

    own: list[float]
    after_others: list[float]


class Call(NamedTuple):
    """A tool, and the conductivity that it is called with."""

    tool: Tool
    sigma: np.ndarray


def interleaved(calls: Sequence[Call], repeats: int, budget: float) -> list[Times]:
    """All in turn, round after round, each round in another order; a slow one stops after ``budget`` seconds and
    `LEAST` turns."""
    times = [Times([], []) for _ in calls]
    for turn in range(repeats):
        for number in np.random.default_rng(turn).permutation(len(calls)):  # none always after the same one
            (tool, sigma), (own, after_others) = calls[number], times[number]
            if len(own) < LEAST or sum(own) < budget:
                last, first = a_turn(tool, sigma * (1 + 1e-3 * turn))
                own.append(last)
                after_others.append(first)
    return times


def a_turn(tool: Tool, sigma: np.ndarray) -> tuple[float, float]:
    """Seconds of a tool's last call and its first, of as many as `TURN` holds; no conductivity twice.

    In the first ones the processor fetches anew what other tools have driven from its caches, and the system learns
    that two threads need two cores: a program that calls one tool again and again pays for that once.
    """
    last = first = spent = taken(tool, sigma)[0]
    while spent < TURN:
        last = taken(tool, sigma * (1 + 1e-3 * spent))[0]
        spent += last
    return last, first


def may_run_in_real_time() -> bool:
    """Whether this user may have real-time priority; says if not."""
    refused = refusal()
    if refused:
        print(f"at ordinary priority, where others may come between: {refused}")
    return not refused


def spread(times: list[float]) -> dict[str, float]:
    """Median, least and most in ms."""
    ms = 1e3 * np.array(times)
    summary = {"median_ms": np.median(ms), "min_ms": ms.min(), "max_ms": ms.max()}
    return {key: round(float(value), 4) for key, value in summary.items()} | {"repeats": len(times)}


def difference(values: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(values - reference).max() / np.abs(reference).max())


def require_agreement(outputs: Mapping[str, np.ndarray], reference: str, loose: Mapping[str, float]) -> dict:
    """Print how far tools differ; refuse to go on where one computes something else."""
    found = {name: difference(out, outputs[reference]) for name, out in outputs.items() if name != reference}
    for name, value in found.items():
        print(f"  {name} against {reference}: {value:.1e}")
        if not value <= loose.get(name, AGREE):
            raise SystemExit(f"{name} disagrees with {reference}: nothing is timed")
    return found


def measured(
    prepare: Mapping[str, Callable[[Problem], Tool]],
    problem: Problem,
    reference: str,
    loose: Mapping[str, float],
    repeats: int,
    budget: float,
) -> list[dict[str, Any]]:
    """A row of results per tool: agreement with the reference first, then the clocks."""
    nodes, readings = len(problem.mesh.nodes), len(problem.pattern)
    prepared = {name: seconds(make, problem) for name, make in prepare.items()}
    tools = {name: tool for name, (_, tool) in prepared.items()}
    first = {name: taken(tool, problem.sigma) for name, tool in tools.items()}
    found = require_agreement({name: out for name, (_, out) in first.items()}, reference, loose)
    first_call = {name: round(spent, 3) for name, (spent, _) in first.items()}
    del first  # Jacobians are large
    times = interleaved([Call(tool, problem.sigma) for tool in tools.values()], repeats, budget)
    return [
        {
            "tool": name,
            "nodes": nodes,
            "readings": readings,
            "difference": found.get(name, 0.0),
            "prepare_s": round(prepared[name][0], 3),
            "first_call_s": first_call[name],
            **spread(own),
            "after_others_ms": round(1e3 * float(np.median(after_others)), 4),
        }
        for name, (own, after_others) in zip(tools, times, strict=True)
    ]


def run(
    argv: list[str] | None,
    about: str | None,
    section: str,
    prepare: Mapping[str, Callable[[Problem], Tool]],
    measure: Callable[[int, int, float], list[tuple[list[dict[str, Any]], dict[str, Any]]]],
    repeats: int,
) -> dict[str, Any]:
    """The command of a benchmark: ``measure(cells, repeats, budget)`` at all sizes, then peak memory.

    ``measure`` gives lists of rows, each with the work that they did.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--smoke", action="store_true", help="a tiny size, few repeats, nothing written")
    parser.add_argument("--no-memory", action="store_true", help="skip each tool's peak memory at the largest size")
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="most cells a side")
    parser.add_argument("--section", default=section, help="name of this run among the results")
    parser.add_argument("--peak", nargs=2, metavar=("TOOL", "CELLS"), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    set_up()
    if args.peak:
        print_peak(prepare[args.peak[0]], int(args.peak[1]))
        return {}
    sizes = SMOKE if args.smoke else tuple(s for s in SIZES if s <= args.largest)
    data: dict[str, Any] = {"circumstances": circumstances(), "limits": limits(), "rows": [], "work": []}
    save = (lambda: None) if args.smoke else (lambda: write(args.section, closed(data)))
    for cells in sizes:
        for rows, work in measure(cells, 3 if args.smoke else repeats, 8.0):
            data["rows"] += rows
            data["work"].append(with_limits(rows, data["limits"], work))
        save()
    print(table(data["rows"]), flush=True)
    if not (args.smoke or args.no_memory):
        add_peaks(data["rows"], f"bench_{section}", sizes[-1])
        save()
    return data


def factorisation(problem: Problem) -> dict[str, float]:
    """Least work of a multifrontal Cholesky factorisation on our (padded) fronts: panels are written
    once, updates of the parents written and read."""
    plan: Any = problem.model().system.plan
    m, q, p = np.array(plan.panel_shapes, np.float64).T
    b = q - p
    flops, entries = m * (p**3 / 3 + b * p**2 + b**2 * p), m * q * p
    return {
        "flops": float(np.sum(flops)),
        "entries": float(np.sum(entries)),
        "bytes": float(8 * np.sum(entries + 2 * m * b**2)),
    }


def limits() -> dict[str, float]:
    """What is reached here: flop/s of XLA's matrix product on all cores, byte/s of a copy; best of five."""
    a, big = jnp.asarray(np.random.default_rng(0).random((1500, 1500))), np.ones(1 << 24)
    product, into = jax.jit(jnp.matmul), np.ones_like(big)
    flops = 2 * 1500**3 / min(_finished(product, a, a) for _ in range(5))
    copied = 2 * big.nbytes / min(seconds(np.copyto, into, big)[0] for _ in range(5))
    return {"flop_per_s": flops, "byte_per_s": copied}


def _finished(call: Callable, *args: Any) -> float:
    return seconds(lambda: jax.block_until_ready(call(*args)))[0]


def with_limits(rows: list[dict[str, Any]], machine: dict[str, float], work: dict[str, float]) -> dict[str, Any]:
    """The time that the work takes at the machine's limits, and the fraction of them that we reach."""
    least = max(work["flops"] / machine["flop_per_s"], work["bytes"] / machine["byte_per_s"])
    reached = {row["tool"]: round(1e3 * least / row["median_ms"], 4) for row in rows if "jaxeit" in row["tool"]}
    return {"nodes": rows[0]["nodes"], **work, "least_ms": round(1e3 * least, 4), "fraction_reached": reached}


def peak_megabytes() -> float:
    """Of this process so far.  On Linux not from getrusage, which starts at what the parent had."""
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = (line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def peak_in_child(module: str, tool: str, cells: int) -> dict[str, float]:
    """Peak memory of one tool at one size, alone in a process; MB in all, and beyond the imports."""
    command = [sys.executable, "-m", f"benchmarks.{module}", "--peak", tool, str(cells)]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def add_peaks(rows: list[dict[str, Any]], module: str, cells: int) -> None:
    """Peak memory of the tools at one size, into their rows."""
    for row in rows:
        if row["nodes"] == (cells + 1) ** 2:
            row |= peak_in_child(module, row["tool"], cells)


def print_peak(prepare: Callable[[Problem], Tool], cells: int) -> None:
    before = peak_megabytes()
    problem = Problem(cells)
    tool = prepare(problem)
    tool(problem.sigma)
    after = peak_megabytes()
    own = {"peak_mb": round(after), "beyond_imports_mb": round(after - before)}
    print(json.dumps(tool.peaks() if hasattr(tool, "peaks") else own))


def machine() -> str:
    """A neutral name: cores and kind of processor."""
    kind = {"x86_64": "x86", "AMD64": "x86", "aarch64": "arm", "arm64": "arm"}
    return f"{os.cpu_count()}-core-{kind.get(platform.machine(), platform.machine())}"


def circumstances() -> dict[str, Any]:
    """What a reader needs to judge the times."""
    names = ("jax", "jaxlib", "numpy", "scipy", "pyeit", "scikit-sparse")
    threads = ("XLA_FLAGS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "device": jax.devices()[0].platform,
        "threads": {name: os.environ.get(name, "not set") for name in threads},
        "load_before": [round(load, 2) for load in os.getloadavg()],
        "versions": {name: _version(name) for name in names} | eidors.versions(),
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def closed(data: dict[str, Any]) -> dict[str, Any]:
    """The results so far, with the machine's load now."""
    return data | {"circumstances": data["circumstances"] | {"load_after": [round(x, 2) for x in os.getloadavg()]}}


def write(section: str, data: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Replace one section of this machine's results."""
    path = folder / f"{machine()}.json"
    results = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new:
        new.write_text(json.dumps(results | {section: data}, indent=1) + "\n", encoding="utf-8")
    return path


def stored(section: str) -> Any:
    """What this machine measured last.

    Raises:
        SystemExit: if it has not measured this.
    """
    path = RESULTS / f"{machine()}.json"
    results = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if section not in results:
        raise SystemExit(f"{path} has no {section!r}; measure first (leave out --draw-only or another --...-only)")
    return results[section]


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line per tool, a column per size, median (least to most) in ms."""
    sizes = sorted({row["nodes"] for row in rows})
    lines = [
        "| ms, median (min to max) | " + " | ".join(f"{n:,} nodes" for n in sizes) + " |",
        "|---" * (1 + len(sizes)) + "|",
    ]
    for tool in dict.fromkeys(row["tool"] for row in rows):
        cells = {row["nodes"]: cell(row) for row in rows if row["tool"] == tool}
        lines.append(f"| {tool} | " + " | ".join(cells.get(n, "") for n in sizes) + " |")
    return "\n".join(lines)


def cell(row: dict[str, Any]) -> str:
    return f"{row['median_ms']:.3g} ({row['min_ms']:.3g} to {row['max_ms']:.3g})"
