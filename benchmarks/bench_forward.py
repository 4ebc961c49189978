"""Forward solves of every tool on the same work, in one run.

python -m benchmarks.bench_forward [--smoke] [--no-memory]
"""

import sys
from typing import Any

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


def measure(cells: int, repeats: int, budget: float) -> list[tuple[list[dict[str, Any]], dict[str, Any]]]:
    problem = c.Problem(cells)
    print(f"{len(problem.mesh.nodes)} nodes, {len(problem.pattern)} readings; largest difference of the voltages")
    rows = c.measured(present(cells), problem, superlu.NAME, LOOSE, repeats, budget)
    return [(rows, c.factorisation(problem))]


def main(argv: list[str] | None = None) -> dict[str, Any]:
    return c.run(argv, __doc__, "forward", PREPARE, measure, repeats=15)


if __name__ == "__main__":
    main(sys.argv[1:])
