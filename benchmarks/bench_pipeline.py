"""The whole way of every tool in one run: mesh to images of 100 frames; and the time each needs to an accuracy.

python -m benchmarks.bench_pipeline [--smoke] [--no-memory] [--largest CELLS]

Pipeline: nodes, triangles, electrodes and pairs are at hand as arrays, and 100 frames; what is asked for are the images
by one-step NOSER, linearised at a conductivity that varies.  All that depends on the mesh is done anew in each call, by
every tool; ours is timed with its programs compiled (`first_call_s` holds the compilation).  The projection onto pixels
is given to the tools that have none.

Accuracy: root mean square error of the 1,372 voltages of the even sheet, relative to the exact ones (Green's function
of the rectangle).  For 1, 0.1 and 0.02 %, the quickest of the meshes of each tool and element order that reach it; ours
has meshes graded towards the electrodes, too, as every user's has.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from . import _common as c
from . import bench_accuracy, bench_forward, bench_inverse, bench_jacobian
from .peers import adjoint, cholmod, eidors, pyeit, superlu

FRAMES = 100
ELEMENTS_LARGEST = 30  # beyond, the dense system elements x elements takes the others seconds to minutes
PYEIT_LARGEST = 60  # of its voltages; beyond, it takes seconds for a solve
BY_HAND = bench_inverse.IN_IMAGE
TARGETS = (1e-2, 1e-3, 2e-4)
REGULAR = {1: (10, 30, 60, 120, 240), 2: (10, 20, 30, 60, 120)}  # cells a side, ours by element order
GRADED = {1: ((0.15, 1.4), (0.05, 1.4), (0.015, 1.4)), 2: ((0.25, 1.7), (0.12, 1.7), (0.06, 1.7), (0.05, 1.4))}
PEERS: dict[str, tuple[Any, int, tuple[int, ...]]] = {
    cholmod.NAME: (cholmod.prepare, 1, (10, 30, 60, 120, 240)),
    superlu.NAME: (superlu.prepare, 1, (10, 30, 60, 120, 240)),
    f"{eidors.NAME} first order": (eidors.prepare, 1, (10, 30, 60, 120, 240)),
    f"{eidors.NAME} second order": (eidors.prepare_quadratic, 2, (10, 20, 30, 60)),
    pyeit.NAME: (pyeit.prepare, 1, (10, 30, 60, 120)),
}
MODULES = (cholmod, superlu, eidors, pyeit)

Row = dict[str, Any]


# --- from the mesh to images


@cache
def frames(readings: int) -> np.ndarray:
    """(readings, 100)."""
    return np.random.default_rng(0).normal(size=(readings, FRAMES))


def ours(problem: c.Problem, pixels: bool) -> c.Tool:
    """`discretise`, `prepare` and images, from arrays to arrays."""
    seen = frames(len(problem.pattern)).T

    def images(sigma: np.ndarray) -> np.ndarray:
        model = problem.model()
        recon = je.prepare(
            model,
            bench_inverse.PRIOR,
            basis=bench_inverse.basis_map(model, pixels),
            hyperparameter=bench_inverse.HYPERPARAMETER,
            sigma=jnp.asarray(sigma),
        )
        return np.asarray(recon(seen)).T

    _ = problem.mesh  # at hand before the clock starts
    return images


def by_hand(problem: c.Problem, pixels: bool) -> c.Tool:
    """The adjoint formula and SciPy's Cholesky, prepared for the mesh in each call."""
    project, seen = bench_inverse.projection(problem, pixels), frames(len(problem.pattern))

    def images(sigma: np.ndarray) -> np.ndarray:
        jacobian = adjoint.prepare(problem, project)(sigma)
        return bench_inverse.in_image_space(jacobian) @ seen

    return images


def by_eidors(problem: c.Problem, pixels: bool) -> eidors.Eidors:
    strength = bench_inverse.strength(problem, pixels) ** 0.5
    projection = bench_inverse.projection(problem, pixels)
    return eidors.prepare_pipeline(problem, strength, frames(len(problem.pattern)), projection)


def by_pyeit(problem: c.Problem) -> c.Tool:
    return pyeit.prepare_pipeline(problem, bench_inverse.strength(problem, False), frames(len(problem.pattern)))


PREPARE = {
    "jaxeit float64, pixels": lambda problem: ours(problem, True),
    f"{BY_HAND}, pixels": lambda problem: by_hand(problem, True),
    f"{eidors.NAME}, pixels": lambda problem: by_eidors(problem, True),
    "jaxeit float64, elements": lambda problem: ours(problem, False),
    f"{BY_HAND}, elements": lambda problem: by_hand(problem, False),
    f"{eidors.NAME}, elements": lambda problem: by_eidors(problem, False),
    f"{pyeit.NAME}, elements": by_pyeit,
}
LOOSE = dict.fromkeys(PREPARE, bench_inverse.EIDORS_AGREE)


def absent() -> tuple[str, ...]:
    return tuple(peer.NAME for peer in MODULES if peer.missing())


def voltages(cells: int) -> dict[str, float]:
    """How far the tools' voltages are from ours, before anything is timed."""
    problem = c.Problem(cells)
    tools: dict[str, Any] = {"jaxeit": bench_forward.ours, eidors.NAME: eidors.prepare}
    tools |= {pyeit.NAME: pyeit.prepare} if cells <= PYEIT_LARGEST else {}
    print(f"{len(problem.mesh.nodes)} nodes; largest difference of the voltages")
    here = {name: prepare(problem)(problem.sigma) for name, prepare in tools.items() if name not in absent()}
    return c.require_agreement(here, "jaxeit", {})


def measure(cells: int, repeats: int, budget: float) -> list[tuple[list[Row], Row]]:
    agreement = voltages(cells)
    names = [name for name in PREPARE if "elements" not in name or cells <= ELEMENTS_LARGEST]
    tools = {name: PREPARE[name] for name in names if not name.startswith(absent())}
    run = partial(c.measured, loose=LOOSE, repeats=repeats, budget=budget)
    found = bench_jacobian.onto_each(c.Problem(cells), tools, BY_HAND, "images", bench_inverse.work, run)
    for rows, _ in found:
        for row in rows:
            row["voltage_difference"] = agreement.get(row["tool"].split(",")[0], None)
    return found


# --- to an accuracy


def runs(smoke: bool) -> Iterator[bench_accuracy.Run]:
    case = bench_accuracy.rectangle()
    regular = {2: (10, 20)} if smoke else REGULAR
    for order, sizes in regular.items():
        for side in sizes:
            labels = {"mesh": "regular", "order": order, "dtype": "float64", "cells": side}
            yield bench_accuracy.ours(case, c.Problem(side).model("float64", order), labels)
    for order, several in ({} if smoke else GRADED).items():
        for edge, growth in several:
            fidelity = je.Fidelity(edge, order, growth=growth, solver=bench_accuracy.NestedDissection())
            labels = {"mesh": f"growth {growth}", "order": order, "dtype": "float64", "edge_length": edge}
            yield bench_accuracy.ours(case, je.discretise(je.Scene(case.skin), fidelity), labels)
    for name, (prepare, order, sizes) in PEERS.items():
        if not name.startswith(absent()):
            for side in sizes[: 1 if smoke else None]:
                yield bench_accuracy.peer(case, name, prepare, order, side)


def kind(row: Mapping[str, Any]) -> str:
    """Tool and element, ours apart by whether the mesh is graded."""
    if row["tool"] != "jaxeit":
        return row["tool"]
    return f"jaxeit P{row['order']}, {'regular' if row['mesh'] == 'regular' else 'graded'}"


def to_accuracy(rows: Sequence[Row]) -> list[Row]:
    """For each kind and target, the quickest that reaches it; None where none of its meshes does."""
    out = []
    for name in dict.fromkeys(kind(row) for row in rows):
        for target in TARGETS:
            good = [row for row in rows if kind(row) == name and row["relative_error"] <= target]
            best = min(good, key=lambda row: row["median_ms"], default=None)
            out.append({"kind": name, "target": target, "best": best})
    return out


def accuracy_table(found: Sequence[Row]) -> str:
    heads = [f"to {100 * target:g} %" for target in TARGETS]
    lines = ["| ms, median (min to max) | " + " | ".join(heads) + " |", "|---" * (1 + len(TARGETS)) + "|"]
    for name in dict.fromkeys(row["kind"] for row in found):
        cells = [_reached(row["best"]) for row in found if row["kind"] == name]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _reached(best: Row | None) -> str:
    if best is None:
        return "not reached"
    return f"{c.cell(best)}; {best['unknowns']:,} unknowns, {100 * best['relative_error']:.2g} %"


def main(argv: list[str] | None = None) -> dict[str, Any]:
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--smoke", action="store_true")
    own.add_argument("--accuracy-only", action="store_true", help="leave the pipeline of the last run as it is")
    args, rest = own.parse_known_args(argv)
    c.set_up()
    section = c.stored("pipeline") if args.accuracy_only else _pipeline([*rest, *(["--smoke"] * args.smoke)])
    if "rows" not in section:  # a child that was asked for its peak memory, or for help
        return section
    rows = bench_accuracy.timed(bench_accuracy.prepared(runs(args.smoke)), 3 if args.smoke else 9, budget=3.0)
    section["accuracy"] = rows
    section["to_accuracy"] = to_accuracy(rows)
    print(accuracy_table(section["to_accuracy"]), flush=True)
    if not args.smoke:
        c.write("pipeline", c.closed(section))
    return section


def _pipeline(argv: list[str]) -> dict[str, Any]:
    return c.run(argv, __doc__, "pipeline", PREPARE, measure, repeats=5)


if __name__ == "__main__":
    main(sys.argv[1:])
