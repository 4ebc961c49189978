"""Jacobians of every tool on the same work, in one run: onto elements, and onto 30 x 30 pixels.

python -m benchmarks.bench_jacobian [--smoke] [--no-memory]
"""

import argparse
import sys
from typing import Any

import jax
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


def measure(cells: int, image: str, repeats: int, budget: float) -> list[dict[str, Any]]:
    problem = c.Problem(cells)
    nodes, readings = len(problem.mesh.nodes), len(problem.pattern)
    names = [name for name in present(cells) if name.endswith(image)]
    if not names:
        return []
    print(f"{nodes} nodes, {readings} readings, onto {image}; largest difference of the Jacobians")
    prepared = {name: c.seconds(PREPARE[name], problem) for name in names}
    tools = {name: tool for name, (_, tool) in prepared.items()}
    first = {name: c.taken(tool, problem.sigma) for name, tool in tools.items()}
    found = c.require_agreement({name: out for name, (_, out) in first.items()}, f"{adjoint.NAME}, {image}", LOOSE)
    first_call = {name: round(taken, 3) for name, (taken, _) in first.items()}
    del first  # the Jacobians
    times = c.interleaved(tools, problem.sigma, repeats, budget)
    return [
        {
            "tool": name,
            "nodes": nodes,
            "readings": readings,
            "difference": found.get(name, 0.0),
            "prepare_s": round(prepared[name][0], 3),
            "first_call_s": first_call[name],
            **c.spread(times[name]),
        }
        for name in names
    ]


def work(problem: c.Problem, coefficients: int) -> dict[str, float]:
    """Flops and bytes beyond the factorisation: one substitution, slopes and products of 25 fields
    over every element, differences of products; fields and matrix are written once."""
    fields, elements, nodes = 25, len(problem.sigma), len(problem.mesh.nodes)
    factor = c.factorisation(problem)
    products = elements * 2 * (2 * 3 * fields + fields * (fields + 1))
    differences = 3 * coefficients * len(problem.pattern)
    return {
        "flops": factor["flops"] + 4 * fields * factor["entries"] + products + differences,
        "bytes": factor["bytes"] + 8 * (factor["entries"] + 2 * fields * nodes + coefficients * len(problem.pattern)),
    }


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="smallest size, few repeats, nothing written")
    parser.add_argument("--no-memory", action="store_true", help="skip each tool's peak memory at the largest size")
    parser.add_argument("--largest", type=int, default=c.SIZES[-1], help="most cells a side")
    parser.add_argument("--section", default="jacobian", help="name of this run among the results")
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
        for image in ("pixels", "elements"):
            rows = measure(cells, image, repeats=3 if args.smoke else 9, budget=8.0)
            data["rows"] += rows
            problem = c.Problem(cells)
            size = PIXELS**2 if image == "pixels" else len(problem.sigma)
            data["work"] += [c.with_limits(rows, data["limits"], work(problem, size)) | {"onto": image}] if rows else []
        save()
    print(c.table(data["rows"]), flush=True)
    if not (args.smoke or args.no_memory):
        c.add_peaks(data["rows"], "bench_jacobian", sizes[-1])
        save()
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
