"""From the mesh to images of 100 frames with every tool, and the time that each tool needs to reach an accuracy.

Pipeline: nodes, triangles, electrodes, pairs and 100 frames are given as arrays; the result is the images by one-step
NOSER, linearised at a conductivity that varies. Every tool repeats in each call what depends on the mesh; ours is
timed with its programs compiled (`first_call_s` holds the compilation). Tools without pixels are given the
projection.

Accuracy: root mean square error of the 1,372 voltages of the even sheet, relative to the exact ones (Green's function
of the rectangle). For 1, 0.1 and 0.02 %, the fastest mesh of each tool and element order that reaches it; ours also
has meshes that are graded towards the electrodes, as those of every user are.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from .bench_accuracy import Solve, graded, peers, regular, timed
from .clock import require_agreement
from .comparison import Comparison, inverse_work
from .harness import Question, Run
from .peers import cholmod, eidors, pyeit, superlu
from .problems import Problem, rectangle
from .rows import Row
from .tools import IN_IMAGE, Entry, forward, present

TARGETS = (1e-2, 1e-3, 2e-4)
REGULAR = {1: (10, 30, 60, 120, 240), 2: (10, 20, 30, 60, 120)}  # cells a side, ours by element order
GRADED = {1: ((0.15, 1.4), (0.05, 1.4), (0.015, 1.4)), 2: ((0.25, 1.7), (0.12, 1.7), (0.06, 1.7), (0.05, 1.4))}
PEERS: tuple[tuple[Entry, int, tuple[int, ...]], ...] = (
    (Entry(cholmod.NAME, cholmod.prepare, cholmod), 1, REGULAR[1]),
    (Entry(superlu.NAME, superlu.prepare, superlu), 1, REGULAR[1]),
    (Entry(f"{eidors.NAME} first order", eidors.Eidors, eidors), 1, REGULAR[1]),
    (Entry(f"{eidors.NAME} second order", partial(eidors.Eidors, order=2), eidors), 2, (10, 20, 30, 60)),
    (Entry(pyeit.NAME, pyeit.prepare, pyeit), 1, (10, 30, 60, 120)),
)
SMOKE = tuple((entry, order, sizes[:1]) for entry, order, sizes in PEERS)
VOLTAGES = (
    Entry("jaxeit float64", forward),
    Entry(eidors.NAME, eidors.Eidors, eidors),
    Entry(pyeit.NAME, pyeit.prepare, pyeit, largest=60),
)


def voltages(cells: int) -> dict[str, float]:
    """How far the tools' voltages are from ours, before anything is timed."""
    problem = Problem(cells)
    print(f"{len(problem.mesh.nodes)} nodes; largest difference of the voltages")
    found = {entry.name: entry.prepare(problem)(problem.sigma) for entry in present(VOLTAGES, cells)}
    return require_agreement(found, VOLTAGES[0].name, {})


def meshes(smoke: bool) -> Iterator[Solve]:
    """Each tool on meshes of rising fineness."""
    case = rectangle()
    for order, sizes in ({2: (10, 20)} if smoke else REGULAR).items():
        yield from (regular(case, order, cells) for cells in sizes)
    for order, several in ({} if smoke else GRADED).items():
        yield from (graded(case, order, edge, growth) for edge, growth in several)
    yield from peers(case, SMOKE if smoke else PEERS)


def kind(row: Mapping[str, Any]) -> str:
    """The tool; of ours also the element order, and whether the mesh is graded."""
    if row["tool"] != "jaxeit":
        return row["tool"]
    return f"jaxeit P{row['order']}, {'regular' if row['mesh'] == 'regular' else 'graded'}"


def to_accuracy(rows: Sequence[Row]) -> list[Row]:
    """For each kind and target the fastest row that reaches it; None where no mesh does."""
    out = []
    for name in dict.fromkeys(kind(row) for row in rows):
        for target in TARGETS:
            good = [row for row in rows if kind(row) == name and row["relative_error"] <= target]
            best = min(good, key=lambda row: row["median_ms"], default=None)
            out.append({"kind": name, "target": target, "best": best})
    return out


def accuracy(run: Run) -> Iterator[Row]:
    rows = timed(list(meshes(run.smoke)), 3 if run.smoke else 9, budget=3.0)
    yield {"accuracy": rows, "to_accuracy": to_accuracy(rows)}


PIPELINES = Comparison(
    "pipeline", IN_IMAGE, "images", inverse_work, 5, ("pixels", "elements"), "voltage_difference", voltages
)
main = Question("pipeline", __doc__, {"rows": PIPELINES, "accuracy": accuracy})

if __name__ == "__main__":
    main()
