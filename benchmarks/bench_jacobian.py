"""Jacobians of every tool on the same work, in one run: onto elements, and onto 30 x 30 pixels.

python -m benchmarks.bench_jacobian [--smoke] [--no-memory]
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_array

import jaxeit as je

from . import _common as c
from .peers import adjoint, eidors, pyeit

PIXELS = 30
PYEIT_LARGEST = 30  # it inverts the matrix as a dense one and loops over elements in Python
ELEMENTS_LARGEST = 120  # beyond, the matrix alone takes 1.3 GB
LOOSE = {"jaxeit float32, pixels": 1e-2}


def ours(problem: c.Problem, pixels: bool, dtype: str = "float64") -> c.Tool:
    model = problem.model(dtype)
    basis = (je.Pixels(PIXELS) if pixels else je.Elements()).on(model)
    return c.as_tool(c.compiled(je.jacobian, model, basis, options=je.compiler_options()), dtype)


def pixel_matrix(problem: c.Problem) -> csr_array:
    """(elements, 900): the projection, for the tool that is given it."""
    image = je.Pixels(PIXELS).on(problem.model())
    weight, element = np.asarray(image.weight), np.asarray(image.element)
    coefficient = np.broadcast_to(np.asarray(image.coefficient)[:, None], element.shape)
    entries = weight.ravel(), (element.ravel(), coefficient.ravel())
    return csr_array(entries, shape=(len(problem.sigma), image.size))


PREPARE = {
    "jaxeit float64, pixels": lambda problem: ours(problem, True),
    "jaxeit float32, pixels": lambda problem: ours(problem, True, "float32"),
    f"{adjoint.NAME}, pixels": lambda problem: adjoint.prepare(problem, pixel_matrix(problem)),
    "jaxeit float64, elements": lambda problem: ours(problem, False),
    f"{adjoint.NAME}, elements": adjoint.prepare,
    f"{pyeit.NAME}, elements": pyeit.prepare_jacobian,
    f"{eidors.NAME}, pixels": lambda problem: eidors.prepare_jacobian(problem, pixel_matrix(problem)),
    f"{eidors.NAME}, elements": eidors.prepare_jacobian,
}


def present(cells: int) -> list[str]:
    """Tools to run at this size."""
    names = [name for name in PREPARE if "elements" not in name or cells <= ELEMENTS_LARGEST]
    if pyeit.missing() or cells > PYEIT_LARGEST:
        names = [name for name in names if not name.startswith(pyeit.NAME)]
        print(f"{pyeit.NAME} left out: {pyeit.missing() or 'too slow beyond the smallest size'}")
    if eidors.missing():
        names = [name for name in names if not name.startswith(eidors.NAME)]
        print(f"{eidors.NAME} left out: {eidors.missing()}")
    return names


def measure(cells: int, repeats: int, budget: float) -> list[tuple[list[dict[str, Any]], dict[str, Any]]]:
    run = partial(c.measured, loose=LOOSE, repeats=repeats, budget=budget)
    tools = {name: PREPARE[name] for name in present(cells)}
    return onto_each(c.Problem(cells), tools, adjoint.NAME, "Jacobians", work, run)


def onto_each(
    problem: c.Problem, tools: dict[str, Any], reference: str, what: str, work: Callable, run: Callable
) -> list[tuple[list[dict[str, Any]], dict[str, Any]]]:
    """Rows and work onto pixels, then onto elements, of the tools so named."""
    factor, out = c.factorisation(problem), []
    for image, size in {"pixels": PIXELS**2, "elements": len(problem.sigma)}.items():
        mine = {name: prepare for name, prepare in tools.items() if name.endswith(image)}
        if mine:
            print(f"{len(problem.mesh.nodes)} nodes, onto {image}; largest difference of the {what}")
            rows = run(mine, problem, f"{reference}, {image}")
            out.append((rows, work(problem, factor, size) | {"onto": image}))
    return out


def work(problem: c.Problem, factor: dict[str, float], coefficients: int) -> dict[str, Any]:
    """Flops and bytes: the factorisation, one substitution, products of 25 fields by half of each coefficient's
    stiffness (`jaxeit.stiffness`), differences of products; fields and matrix are written once."""
    fields, nodes = 25, len(problem.mesh.nodes)
    basis = je.Pixels(PIXELS) if coefficients == PIXELS**2 else je.Elements()
    entries = np.asarray(basis.on(problem.model()).stiffness.entry) != 0
    products = 2 * fields * entries.sum() + 2 * fields**2 * entries.any(2).sum() + fields**2 * coefficients
    differences = 3 * coefficients * len(problem.pattern)
    return {
        "flops": factor["flops"] + 4 * fields * factor["entries"] + float(products) + differences,
        "bytes": factor["bytes"] + 8 * (factor["entries"] + 2 * fields * nodes + coefficients * len(problem.pattern)),
    }


def main(argv: list[str] | None = None) -> dict[str, Any]:
    return c.run(argv, __doc__, "jacobian", PREPARE, measure, repeats=15)


if __name__ == "__main__":
    main(sys.argv[1:])
