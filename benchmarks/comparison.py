"""Tools compared on the same work at several sizes: what `forward`, `jacobian`, `inverse` and `pipeline` share."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxeit as je

from .clock import interleaved, limits, require_agreement, seconds, spread, taken
from .harness import Run
from .problems import SIZES, SMOKE, Problem
from .rows import Row
from .tools import PIXELS, TOOLS, basis_of, present


@dataclass(frozen=True, eq=False)
class Comparison:
    """Tools (by their name in `tools.TOOLS`), the one that the others must agree with, what they compute, and how often
    they are called.

    ``images``: onto what, as the ends of the tools' names; ``work``: flops and bytes of a problem onto an image;
    ``largest``: cells a side of the largest problem; ``voltages``: how far each tool's voltages are off with so many
    cells a side, checked before anything is timed.
    """

    tools: str
    reference: str
    what: str
    work: Callable[[Problem, str], Row]
    repeats: int
    images: tuple[str, ...] = ("",)
    largest: int = SIZES[-1]
    voltages: Callable[[int], Row] | None = None

    def __call__(self, run: Run) -> Iterator[Row]:
        """Rows and work of all sizes."""
        machine = limits()
        yield {"limits": machine, "rows": [], "work": []}
        for cells in run.sizes([cells for cells in SIZES if cells <= self.largest], (SMOKE,)):
            problem, off = Problem(cells), self.voltages(cells) if self.voltages else None
            for image in self.images:
                rows = self.rows(problem, image, 3 if run.smoke else self.repeats)
                for row in rows if off else ():
                    row["voltage_difference"] = off.get(row["tool"].split(",")[0])
                if rows:
                    yield {"rows": rows, "work": [with_limits(rows, machine, self.work(problem, image))]}

    def rows(self, problem: Problem, image: str, repeats: int, budget: float = 8.0) -> list[Row]:
        """A row for each tool: agreement with the reference first, then the clocks."""
        entries = present([e for e in TOOLS[self.tools] if e.name.endswith(image)], problem.cells)
        if not entries:
            return []
        end = f", onto {image}" if image else ""
        print(f"{len(problem.mesh.nodes)} nodes{end}; largest difference of the {self.what}", flush=True)
        ready = {e.name: seconds(e.prepare, problem) for e in entries}
        first = {name: taken(tool, problem.sigma) for name, (_, tool) in ready.items()}
        outputs = {name: out for name, (_, out) in first.items()}
        reference = f"{self.reference}, {image}" if image else self.reference
        found = require_agreement(outputs, reference, {e.name: e.loose for e in entries})
        first_call = {name: round(spent, 3) for name, (spent, _) in first.items()}
        del first, outputs  # Jacobians are large
        turns = interleaved([(tool, problem.sigma) for _, tool in ready.values()], repeats, budget)
        return [
            {
                "tool": name,
                "nodes": len(problem.mesh.nodes),
                "readings": len(problem.pattern),
                "difference": found.get(name, 0.0),
                "prepare_s": round(spent, 3),
                "first_call_s": first_call[name],
                **spread([turn.last for turn in own]),
                "after_others_ms": spread([turn.first for turn in own])["median_ms"],
            }
            for (name, (spent, _)), own in zip(ready.items(), turns, strict=True)
        ]


# --- the least work, and the time that the machine needs for it


def factorisation(problem: Problem, image: str = "") -> dict[str, float]:
    """Least work of a multifrontal Cholesky factorisation on our (padded) fronts: panels are written
    once, updates of the parents written and read."""
    return factorisation_of(problem.model())


def factorisation_of(model: je.Model) -> dict[str, float]:
    plan: Any = model.system.plan
    m, q, p = np.array(plan.panel_shapes, np.float64).T
    b = q - p
    flops, entries = m * (p**3 / 3 + b * p**2 + b**2 * p), m * q * p
    total = 8 * np.sum(entries + 2 * m * b**2)
    return {"flops": float(np.sum(flops)), "entries": float(np.sum(entries)), "bytes": float(total)}


def jacobian_work(problem: Problem, image: str) -> Row:
    """The factorisation, one substitution, products of 25 fields by half of each coefficient's stiffness
    (`jaxeit.stiffness`), differences of products; fields and matrix are written once."""
    factor, fields, nodes, readings = factorisation(problem), 25, len(problem.mesh.nodes), len(problem.pattern)
    basis = basis_of(problem.model(), image == "pixels")
    coefficients = PIXELS**2 if image == "pixels" else len(problem.sigma)
    entries = np.asarray(basis.stiffness.entry) != 0
    products = 2 * fields * entries.sum() + 2 * fields**2 * entries.any(2).sum() + fields**2 * coefficients
    return {
        "flops": factor["flops"] + 4 * fields * factor["entries"] + float(products) + 3 * coefficients * readings,
        "bytes": factor["bytes"] + 8 * (factor["entries"] + 2 * fields * nodes + coefficients * readings),
        "onto": image,
    }


def gradient_work(problem: Problem, image: str) -> Row:
    """The factorisation, one substitution, slopes of 25 fields and their product with the weights of pairs."""
    factor, fields, nodes, elements = factorisation(problem), 25, len(problem.mesh.nodes), len(problem.sigma)
    return {
        "flops": factor["flops"] + 4 * fields * factor["entries"] + 2 * elements * fields * (6 + 2 * fields + 2),
        "bytes": factor["bytes"] + 8 * (factor["entries"] + 2 * fields * nodes + elements),
    }


def inverse_work(problem: Problem, image: str) -> Row:
    """That of the Jacobian, and of a symmetric product, a Cholesky factor and two triangular solves for 300 numbers."""
    work, k = jacobian_work(problem, image), 300
    coefficients = PIXELS**2 if image == "pixels" else len(problem.sigma)
    return work | {
        "flops": work["flops"] + 3 * k**2 * coefficients + k**3 / 3,
        "bytes": work["bytes"] + 8 * 2 * k * coefficients,
    }


def least_ms(work: Mapping[str, float], machine: Mapping[str, float]) -> float:
    """The time that work takes at the machine's limits."""
    return 1e3 * max(work["flops"] / machine["flop_per_s"], work["bytes"] / machine["byte_per_s"])


def with_limits(rows: Sequence[Row], machine: Mapping[str, float], work: Row) -> Row:
    """The work, its least time, and the fraction of the machine's limits that we reach."""
    least = least_ms(work, machine)
    reached = {row["tool"]: round(least / row["median_ms"], 4) for row in rows if "jaxeit" in row["tool"]}
    return {"nodes": rows[0]["nodes"], **work, "least_ms": round(least, 4), "fraction_reached": reached}
