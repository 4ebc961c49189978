"""Forward solves of every tool on the same work, in one run.

python -m benchmarks.bench_forward [--smoke] [--no-memory]
"""

import argparse
import sys
from typing import Any

import jax
import numpy as np

import jaxeit as je

from . import _common as c
from .peers import cholmod, eidors, pyeit, superlu

# Single precision is no direct float64 solver: how far it is off is reported, not required to be nothing.
LOOSE = {"jaxeit float32": 1e-2}


def ours(problem: c.Problem, dtype: str = "float64") -> c.Tool:
    return c.as_tool(c.compiled(je.forward, problem.model(dtype), options=je.compiler_options()), dtype)


def inside(problem: c.Problem) -> c.Tool:
    """As part of a program that was not given `je.compiler_options`."""
    return c.as_tool(c.compiled(je.forward, problem.model()))


def called(problem: c.Problem) -> c.Tool:
    """As users call it: `je.forward(model, sigma)`."""
    model = problem.model()
    return lambda sigma: np.asarray(je.forward(model, sigma))


PREPARE = {
    "jaxeit float64": ours,
    "jaxeit float32": lambda problem: ours(problem, "float32"),
    "jaxeit float64, called from Python": called,
    "jaxeit float64, without compiler options": inside,
    superlu.NAME: superlu.prepare,
    cholmod.NAME: cholmod.prepare,
    pyeit.NAME: pyeit.prepare,
    eidors.NAME: eidors.prepare,
}
PYEIT_LARGEST = 120
PEERS = (superlu, cholmod, pyeit, eidors)


def present(cells: int) -> dict[str, Any]:
    """Tools to run at this size; says which are not run, and why."""
    absent = {peer.NAME: peer.missing() for peer in PEERS if peer.missing()}
    if cells > PYEIT_LARGEST:
        absent.setdefault(pyeit.NAME, f"beyond {PYEIT_LARGEST} cells a side it takes too long")
    for name, reason in absent.items():
        print(f"{name} left out: {reason}")
    return {name: prepare for name, prepare in PREPARE.items() if name not in absent}


def measure(cells: int, repeats: int, budget: float) -> list[dict[str, Any]]:
    problem = c.Problem(cells)
    nodes, readings = len(problem.mesh.nodes), len(problem.pattern)
    print(f"{nodes} nodes, {readings} readings; largest difference of the voltages")
    prepared = {name: c.seconds(prepare, problem) for name, prepare in present(cells).items()}
    tools = {name: tool for name, (_, tool) in prepared.items()}
    first = {name: c.taken(tool, problem.sigma) for name, tool in tools.items()}
    outputs = {name: out for name, (_, out) in first.items()}
    found = c.require_agreement(outputs, superlu.NAME, LOOSE)
    times = c.interleaved(tools, problem.sigma, repeats, budget)
    return [
        {
            "tool": name,
            "nodes": nodes,
            "readings": readings,
            "difference": found.get(name, 0.0),
            "prepare_s": round(prepared[name][0], 3),
            "first_call_s": round(first[name][0], 3),
            **c.spread(times[name]),
        }
        for name in tools
    ]


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="smallest size, few repeats, nothing written")
    parser.add_argument("--no-memory", action="store_true", help="skip each tool's peak memory at the largest size")
    parser.add_argument("--largest", type=int, default=c.SIZES[-1], help="most cells a side")
    parser.add_argument("--section", default="forward", help="name of this run among the results")
    parser.add_argument("--peak", nargs=2, metavar=("TOOL", "CELLS"), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    if args.peak:
        c.print_peak(PREPARE[args.peak[0]], int(args.peak[1]))
        return {}
    sizes = c.SMOKE if args.smoke else tuple(s for s in c.SIZES if s <= args.largest)
    data: dict[str, Any] = {"circumstances": c.circumstances(), "limits": c.limits(), "rows": [], "work": []}
    save = (lambda: None) if args.smoke else (lambda: c.write(args.section, c.closed(data)))
    for cells in sizes:
        rows = measure(cells, repeats=3 if args.smoke else 15, budget=8.0)
        data["rows"] += rows
        data["work"].append(c.with_limits(rows, data["limits"], c.factorisation(c.Problem(cells))))
        save()
    print(c.table(data["rows"]), flush=True)
    if not (args.smoke or args.no_memory):
        c.add_peaks(data["rows"], "bench_forward", sizes[-1])
        save()
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
