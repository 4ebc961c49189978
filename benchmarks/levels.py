"""Where the time of a forward solve goes: assembly, each level of the elimination, the root.

A program that stops after a step is timed for every step, and a step takes what its program takes longer than the one
before. Programs that stop early hand out an update of the fronts, which the whole program need not store.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax

import jaxeit as je
from jaxeit.linalg.base import jacobi_scale
from jaxeit.linalg.multifrontal.fronts import LevelPlan
from jaxeit.linalg.multifrontal.nested_dissection import in_subtrees, swept, with_constants
from jaxeit.model.forward_model import assemble
from jaxeit.model.sheet_conductivity import coefficients

from .clock import in_turns, limits
from .comparison import least_ms
from .harness import Run
from .problems import SMOKE, Problem
from .rows import Row

CELLS = (30, 60, 120)  # a side


def levels(run: Run) -> Iterator[Row]:
    """Seconds and least work of each step, mesh by mesh."""
    machine = limits()
    for cells in run.sizes(CELLS, (SMOKE,)):
        model = Problem(cells).model()
        yield {"levels": _steps(model, machine, repeats=3 if run.smoke else 200)}


def _steps(model: je.Model, machine: Row, repeats: int) -> list[Row]:
    plan: Any = model.system.plan
    deepest = len(plan.levels) - 1
    stops = [deepest + 1, *range(deepest, 0, -1), 0]  # before any level, then after each, then after the root
    programs = {stop: je.bind(partial(_until, stop=stop), model) for stop in stops}
    sigma = model.background
    for program in programs.values():
        jax.block_until_ready(program(sigma))
    calls = {stop: partial(_call, program, sigma) for stop, program in programs.items()}
    least = {stop: 1e3 * min(times) for stop, times in in_turns(calls, repeats, budget=4.0).items()}
    rows, before = [], 0.0
    for stop in stops:
        level = plan.levels[stop] if stop <= deepest else None
        work = {"step": "assembly"} if level is None else _work(stop, level, machine)
        rows.append({"nodes": len(model.nodes), **work, "ms": least[stop] - before, "until_ms": least[stop]})
        before = least[stop]
    return rows


def _call(program: Callable[..., Any], sigma: Any) -> None:
    jax.block_until_ready(program(sigma))


def _until(model: je.Model, sigma: Any, *, stop: int) -> Any:
    """The forward solve up to a level; up to its end for 0."""
    if stop == 0:
        return je.forward(model, sigma)
    plan: Any = model.system.plan
    values = assemble(model.system, coefficients(model, sigma)).values
    scale, scaled = jacobi_scale(plan, values)
    if stop == len(plan.levels):
        return scale, scaled
    entries, top = with_constants(scaled), max(plan.subtrees, 1)
    update, _ = in_subtrees(plan.levels[max(top, stop) :], entries, 1 << plan.subtrees, keep=False)
    return swept(plan.levels[stop:top], entries, update, keep=False)[0]


def _work(number: int, level: LevelPlan, machine: Row) -> Row:
    """Least work of a level, as `comparison.factorisation` counts it."""
    m, p, b = map(float, level.beside.shape)
    work = {"flops": m * (p**3 / 3 + b * p**2 + b**2 * p), "bytes": 8 * (m * (p + b) * p + 2 * m * b**2)}
    return {
        "step": "root, and readings" if number == 0 else f"level {number}",
        **{"fronts": int(m), "pivots": int(p), "boundary": int(b)},
        **work,
        "least_ms": least_ms(work, machine),
    }
