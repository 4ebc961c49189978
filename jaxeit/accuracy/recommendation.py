"""The result of a ladder: measured rungs, the Pareto fronts, the recommendation, and tables of them."""

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from ..model.fidelity import Fidelity
from .settings import Choice, LadderError, Touch

T = TypeVar("T")


@dataclass(frozen=True)
class Times:
    """Seconds of a call over ``repeats`` calls; all rungs were called in turn, round after round."""

    median: float
    least: float
    p99: float
    repeats: int


@dataclass(frozen=True, eq=False)
class Rung:
    """A choice and the measurements of it.

    Errors are root mean squares over the readings, relative to the root mean square of the reference.

    | meaning                                                                      | unit |
    |------------------------------------------------------------------------------|------|
    | choice                                                                       |      |
    | nodes of the mesh, unknowns of the system                                    |      |
    | voltage_error: of the readings of the untouched sheet                        | 1    |
    | difference_error: of the differences that the touches make                   | 1    |
    | setup: seconds of `discretise`                                               | s    |
    | compile: seconds to compile the forward solve                                | s    |
    | forward, jacobian: times of one call                                         | s    |
    | memory: arguments, results and temporaries of the larger program; None: unknown | byte |
    | image: times and errors of the images; None: the choice has no imaging       |      |
    """

    choice: Choice
    nodes: int
    unknowns: int
    voltage_error: float
    difference_error: float
    setup: float
    compile: float
    forward: Times
    jacobian: Times
    memory: int | None
    image: "Image | None"


@dataclass(frozen=True)
class Image:
    """Times and errors of a rung's images of the reference's frames.

    | meaning                                                                        | unit |
    |--------------------------------------------------------------------------------|------|
    | localisation, worst: distance of the half-maximum centroid from the touch, mean and largest | m |
    | misplaced: share of the force that the force map shows in the wrong place; mean | 1   |
    | prepare: seconds of `prepare`, with compilation                                | s    |
    | frame: times to image one frame                                                | s    |
    | batch: frames in a batch                                                       | 1    |
    | frames_per_second: imaged in batches                                           | 1/s  |
    """

    localisation: float
    worst: float
    misplaced: float
    prepare: float
    frame: Times
    batch: int
    frames_per_second: float


@dataclass(frozen=True, eq=False)
class Reference:
    """The extrapolated readings that define the errors of rungs.

    | meaning                                                       | shape               | unit |
    |---------------------------------------------------------------|---------------------|------|
    | fidelities of the two meshes, coarse and fine                 | (2,)                |      |
    | unknowns of both                                              | (2,)                |      |
    | voltages of the untouched sheet, extrapolated                 | (readings,)         | V    |
    | differences of each touch, extrapolated                       | (touches, readings) | V    |
    | voltage_uncertainty, difference_uncertainty: relative         | ()                  | 1    |
    """

    fidelities: tuple[Fidelity, Fidelity]
    unknowns: tuple[int, int]
    voltages: Float[np.ndarray, " readings"]
    differences: Float[np.ndarray, "touches readings"]
    voltage_uncertainty: float
    difference_uncertainty: float


@dataclass(frozen=True, eq=False)
class Ladder:
    """All rungs of one scene on one machine, in the order of the choices.

    | meaning                                        |
    |------------------------------------------------|
    | skin: name of the skin                         |
    | effects: names of the scene's effects          |
    | device: platform that computed                 |
    | touches, reference: for the errors of rungs    |
    | rungs                                          |
    """

    skin: str
    effects: tuple[str, ...]
    device: str
    touches: tuple[Touch, ...]
    reference: Reference
    rungs: tuple[Rung, ...]

    def certain(self, rung: Rung) -> float:
        """The rung's difference error, or the uncertainty of the reference if that is larger."""
        return max(rung.difference_error, self.reference.difference_uncertainty)

    def fidelities(self) -> tuple[Rung, ...]:
        """The first rung of each fidelity; the others of that fidelity differ in their images only."""
        first: dict[Fidelity, Rung] = {}
        for rung in self.rungs:
            first.setdefault(rung.choice.fidelity, rung)
        return tuple(first.values())

    def front(self) -> tuple[Rung, ...]:
        """Rungs of the fidelities that no other rung beats in both difference error and time of a forward solve."""
        return undominated(self.fidelities(), lambda r: (self.certain(r), r.forward.median))

    def image_front(self) -> tuple[Rung, ...]:
        """Rungs that no other rung beats in both localisation error and time of a frame."""
        images = {r: r.image for r in self.rungs if r.image}
        return undominated(list(images), lambda r: (images[r].localisation, images[r].frame.median))

    def recommend(self, *, budget_ms: float | None = None, error: float | None = None) -> Rung:
        """The fastest rung within ``error``; if ``error`` is not given, the most accurate rung within the budget.

        Args:
            budget_ms: largest median time of a forward solve, ms.
            error: largest difference error, relative; the uncertainty of the reference counts as an error.

        Raises:
            LadderError: if neither is given, or no rung meets both.
        """
        require_wishes(budget_ms, error)
        quick = [r for r in self.fidelities() if budget_ms is None or 1e3 * r.forward.median <= budget_ms]
        good = [r for r in quick if error is None or self.certain(r) <= error]
        if not good:
            raise LadderError(self._refusal(quick, budget_ms, error))
        if error is None:
            return min(good, key=lambda r: (self.certain(r), r.forward.median))
        return min(good, key=lambda r: r.forward.median)

    def advice(self, *, budget_ms: float | None = None, error: float | None = None) -> str:
        """Text with the rung of `recommend`, and the expression of its `Fidelity` on a second line."""
        rung = self.recommend(budget_ms=budget_ms, error=error)
        f = rung.choice.fidelity
        made = f"edge_length={f.edge_length:g}, order={f.order}, dtype='{f.dtype}'"
        made += f", electrode_segments={f.electrode_segments}, growth={f.growth:g}"
        solver = "" if f.solver is None else f", solver={f.solver!r}"
        return f"recommended: {self._text(rung)}\n    jaxeit.Fidelity({made}{solver})"

    def table(self, width: int = 110) -> str:
        """The measurements as text; columns that do not fit ``width`` are left out, the least important first."""
        return _report(self, width)

    def summary(self) -> dict[str, Any]:
        """All measurements as a dictionary that JSON can hold, in SI units."""
        return _summary(self)

    def _refusal(self, quick: Sequence[Rung], budget_ms: float | None, error: float | None) -> str:
        if not quick:
            best = min(self.rungs, key=lambda r: r.forward.median)
            return f"no rung solves in {budget_ms:g} ms; the quickest, {self._text(best)}: give more time"
        best = min(quick, key=self.certain)
        within = "" if budget_ms is None else f" in {budget_ms:g} ms"
        return (
            f"no rung has an error of {error:g}{within}; the best, {self._text(best)}: allow more, or give finer rungs"
        )

    def _text(self, rung: Rung) -> str:
        return f"{rung.choice.label}, has {self.certain(rung):.2g} in {1e3 * rung.forward.median:.3g} ms"


def undominated(items: Sequence[T], costs: Callable[[T], tuple[float, float]]) -> tuple[T, ...]:
    """The Pareto front in the order given: items that no other item beats in both costs."""
    found = [costs(item) for item in items]

    def beaten(mine: tuple[float, float]) -> bool:
        return any(a <= mine[0] and b <= mine[1] and (a, b) != mine for a, b in found)

    return tuple(item for item, cost in zip(items, found, strict=True) if not beaten(cost))


def require_wishes(budget_ms: float | None, error: float | None) -> None:
    """Raise a `LadderError` if neither limit is given, or one is not above zero."""
    for name, value in (("budget_ms", budget_ms), ("error", error)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise LadderError(f"{name} is {value}; give a number above zero")
    if budget_ms is None and error is None:
        raise LadderError("there is nothing to recommend by; give budget_ms, error or both")


# --- tables ----------------------------------------------------------------------------------------------------------

_Cell = Callable[[Ladder, Any], str]
# Head, cell, and priority: where the width is too small, the column with the largest number is left out first.
FIDELITY_COLUMNS: tuple[tuple[str, _Cell, int], ...] = (
    ("", lambda found, r: "*" if r in found.front() else "", 0),
    ("rung", lambda found, r: r.choice.label, 0),
    ("P", lambda found, r: str(r.choice.fidelity.order), 6),
    ("edge", lambda found, r: f"{r.choice.fidelity.edge_length:g}", 7),
    ("bits", lambda found, r: str(8 * r.choice.fidelity.dtype.itemsize), 5),
    ("nodes", lambda found, r: f"{r.nodes:,}", 9),
    ("unknowns", lambda found, r: f"{r.unknowns:,}", 4),
    ("voltages", lambda found, r: _percent(r.voltage_error, found.reference.voltage_uncertainty), 2),
    ("touch", lambda found, r: _percent(r.difference_error, found.reference.difference_uncertainty), 0),
    ("solve ms", lambda found, r: _ms(r.forward.median), 0),
    ("Jacobian ms", lambda found, r: _ms(r.jacobian.median), 1),
    ("set-up s", lambda found, r: f"{r.setup:.2g}", 3),
    ("compile s", lambda found, r: f"{r.compile:.2g}", 3),
    ("MB", lambda found, r: "" if r.memory is None else f"{r.memory / 1e6:.3g}", 8),
)
IMAGE_COLUMNS: tuple[tuple[str, _Cell, int], ...] = (
    ("", lambda found, r: "*" if r in found.image_front() else "", 0),
    ("rung", lambda found, r: r.choice.label, 0),
    ("off mm", lambda found, r: f"{1e3 * r.image.localisation:.2f}", 0),
    ("worst mm", lambda found, r: f"{1e3 * r.image.worst:.2f}", 3),
    ("misplaced", lambda found, r: f"{100 * r.image.misplaced:.1f} %", 1),
    ("frame ms", lambda found, r: _ms(r.image.frame.median), 0),
    ("p99 ms", lambda found, r: _ms(r.image.frame.p99), 2),
    ("frames/s", lambda found, r: f"{r.image.frames_per_second:,.0f}", 1),
    ("prepare s", lambda found, r: f"{r.image.prepare:.2g}", 4),
)


IMAGE_NOTE = (
    "Images of the reference's frames, without noise; by default {usual}. "
    "off: mean distance from the touch to the centroid of the half maximum; misplaced: share of the force that the "
    "force map shows in the wrong place; frame: a single frame; frames/s: in a batch."
)


def _percent(value: float, uncertainty: float) -> str:
    return f"< {100 * uncertainty:.2g} %" if value < uncertainty else f"{100 * value:.2g} %"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def _report(found: Ladder, width: int) -> str:
    truth = found.reference
    effects = ", ".join(found.effects) or "no effects"
    coarse, fine = truth.unknowns
    edges = " and ".join(f"{f.edge_length:.3g}" for f in truth.fidelities)
    volts, touch = _percent(truth.voltage_uncertainty, 0), _percent(truth.difference_uncertainty, 0)
    about = (
        f"{found.skin}, {effects}, on {found.device}. Errors are against Richardson's extrapolation from two P2 meshes "
        f"of edges {edges} ({coarse:,} and {fine:,} unknowns), uncertain by {volts} of the voltages and {touch} "
        "of the difference that a touch makes; < marks errors below it. "
        f"Touches: {', '.join(t.name for t in found.touches)}. Times are medians. *: no other rung is both better and "
        "quicker."
    )
    parts = [textwrap.fill(about, width), _grid(FIDELITY_COLUMNS, found, found.fidelities(), width)]
    imaged = [r for r in found.rungs if r.image]
    if imaged:
        parts.append(textwrap.fill(IMAGE_NOTE.format(usual=imaged[0].choice.imaging), width))
        parts.append(_grid(IMAGE_COLUMNS, found, imaged, width))
    return "\n\n".join(parts)


def _grid(columns: Sequence[tuple[str, _Cell, int]], found: Ladder, rungs: Sequence[Rung], width: int) -> str:
    lines = [[head for head, _, _ in columns], *([cell(found, r) for _, cell, _ in columns] for r in rungs)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    kept = list(range(len(columns)))
    while sum(widths[i] + 2 for i in kept) - 2 > width and any(columns[i][2] for i in kept):
        kept.remove(max(kept, key=lambda i: columns[i][2]))
    rows = ("  ".join(line[i].ljust(widths[i]) if i < 2 else line[i].rjust(widths[i]) for i in kept) for line in lines)
    return "\n".join(row.rstrip() for row in rows)


def _summary(found: Ladder) -> dict[str, Any]:
    truth = found.reference
    uncertain = {n: getattr(truth, n) for n in ("voltage_uncertainty", "difference_uncertainty", "unknowns")}
    return {
        "skin": found.skin,
        "effects": list(found.effects),
        "device": found.device,
        "touches": [asdict(touch) for touch in found.touches],
        "reference": uncertain | {"fidelities": [_described(f) for f in truth.fidelities]},
        "rungs": [_numbers(found, rung) for rung in found.rungs],
    }


def _described(fidelity: Fidelity) -> dict[str, Any]:
    shown = {f.name: getattr(fidelity, f.name) for f in fields(fidelity)}
    return shown | {"dtype": str(fidelity.dtype), "solver": repr(fidelity.solver)}


def _numbers(found: Ladder, rung: Rung) -> dict[str, Any]:
    how = rung.choice.imaging
    names = ("nodes", "unknowns", "voltage_error", "difference_error", "setup", "compile", "memory")
    return {
        "label": rung.choice.label,
        "fidelity": _described(rung.choice.fidelity),
        "imaging": how and {f.name: repr(getattr(how, f.name)) for f in fields(how)},
        **{name: getattr(rung, name) for name in names},
        "forward": asdict(rung.forward),
        "jacobian": asdict(rung.jacobian),
        "image": rung.image and asdict(rung.image),
        "front": rung in found.front(),
        "image_front": rung in found.image_front(),
    }
