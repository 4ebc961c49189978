"""What a ladder found: the rungs, which of them are worth having, and which to take."""

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from .choices import Choice, LadderError, Touch
from .fidelity import Fidelity

T = TypeVar("T")


@dataclass(frozen=True)
class Times:
    """Seconds of a call, over ``repeats`` calls; all rungs were called in turn, round after round."""

    median: float
    least: float
    p99: float
    repeats: int


@dataclass(frozen=True, eq=False)
class Rung:
    """A choice and what was measured of it.

    Errors of voltages are root mean squares relative to that of the reference's readings.

    | meaning                                                                      | unit |
    |------------------------------------------------------------------------------|------|
    | choice                                                                       |      |
    | nodes of the mesh, unknowns of the system                                    |      |
    | voltage_error: of the untouched sheet's readings                             | 1    |
    | difference_error: of the touches' readings less the untouched sheet's        | 1    |
    | setup: seconds of `discretise`                                               | s    |
    | compile: seconds to compile the forward solve                                | s    |
    | forward, jacobian: times of one call                                         | s    |
    | memory: arguments, results and temporaries of the larger of both programs; None: not told | byte |
    | image: what images cost and are worth; None: not asked for                   |      |
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
    """Images of the reference's frames, made on a rung without knowing the reference's mesh.

    | meaning                                                                        | unit |
    |--------------------------------------------------------------------------------|------|
    | localisation, worst: distance of the half-maximum centroid from the touch, mean and largest | m |
    | misplaced: share of the force that the force map shows where it is not; mean   | 1    |
    | prepare: seconds of `prepare`, compiling included                              | s    |
    | frame: times of one frame to its image                                         | s    |
    | batch: frames in one; frames_per_second, imaged so                             | 1, 1/s |
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
    """What rungs are judged by.

    | meaning                                                       | shape               | unit |
    |---------------------------------------------------------------|---------------------|------|
    | fidelities of the two meshes, coarse and fine                 | (2,)                |      |
    | unknowns of both                                              | (2,)                |      |
    | voltages of the untouched sheet, extrapolated                 | (readings,)         | V    |
    | differences of each touch, extrapolated                       | (touches, readings) | V    |
    | voltage_uncertainty, difference_uncertainty: what it may be off by, relative   | ()           | 1    |
    """

    fidelities: tuple[Fidelity, Fidelity]
    unknowns: tuple[int, int]
    voltages: Float[np.ndarray, " readings"]
    differences: Float[np.ndarray, "touches readings"]
    voltage_uncertainty: float
    difference_uncertainty: float


@dataclass(frozen=True, eq=False)
class Ladder:
    """All rungs of one scene on one machine, in the order they were asked for.

    | meaning                                        |
    |------------------------------------------------|
    | skin: its name                                 |
    | effects: the names of the scene's              |
    | device that computed                           |
    | touches, reference: what errors are against    |
    | rungs                                          |
    """

    skin: str
    effects: tuple[str, ...]
    device: str
    touches: tuple[Touch, ...]
    reference: Reference
    rungs: tuple[Rung, ...]

    def certain(self, rung: Rung) -> float:
        """The difference error that can be vouched for: no less than the reference's uncertainty."""
        return max(rung.difference_error, self.reference.difference_uncertainty)

    def fidelities(self) -> tuple[Rung, ...]:
        """The first rung of each fidelity: others differ in their images only."""
        first: dict[Fidelity, Rung] = {}
        for rung in self.rungs:
            first.setdefault(rung.choice.fidelity, rung)
        return tuple(first.values())

    def front(self) -> tuple[Rung, ...]:
        """Fidelities that no other beats in both difference error and time of a forward solve."""
        return undominated(self.fidelities(), lambda r: (self.certain(r), r.forward.median))

    def image_front(self) -> tuple[Rung, ...]:
        """Rungs that no other beats in both localisation error and time of a frame."""
        images = {r: r.image for r in self.rungs if r.image}
        return undominated(list(images), lambda r: (images[r].localisation, images[r].frame.median))

    def recommend(self, *, budget_ms: float | None = None, error: float | None = None) -> Rung:
        """The quickest rung that is within ``error``; without one, the most accurate within the budget.

        Args:
            budget_ms: most that a forward solve may take, in ms, by its median here.
            error: most difference error, relative; never promised below the reference's uncertainty.

        Raises:
            LadderError: if neither is given, or no rung fulfils both.
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
        """What `recommend` gives, and on a second line how to ask for it."""
        rung = self.recommend(budget_ms=budget_ms, error=error)
        f = rung.choice.fidelity
        made = f"edge_length={f.edge_length:g}, order={f.order}, dtype='{f.dtype}'"
        made += f", electrode_segments={f.electrode_segments}, growth={f.growth:g}"
        solver = "" if f.solver is None else f", solver={f.solver!r}"
        return f"recommended: {self._said(rung)}\n    jaxeit.Fidelity({made}{solver})"

    def table(self, width: int = 110) -> str:
        """What was measured, for a person: columns that do not fit ``width`` are left out, the least telling first."""
        return _report(self, width)

    def summary(self) -> dict[str, Any]:
        """All of it as numbers and text that JSON can hold; SI units."""
        return _summary(self)

    def _refusal(self, quick: Sequence[Rung], budget_ms: float | None, error: float | None) -> str:
        if not quick:
            best = min(self.rungs, key=lambda r: r.forward.median)
            return f"no rung solves in {budget_ms:g} ms; the quickest, {self._said(best)}: give more time"
        best = min(quick, key=self.certain)
        within = "" if budget_ms is None else f" in {budget_ms:g} ms"
        return (
            f"no rung has an error of {error:g}{within}; the best, {self._said(best)}: allow more, or give finer rungs"
        )

    def _said(self, rung: Rung) -> str:
        return f"{rung.choice.label}, has {self.certain(rung):.2g} in {1e3 * rung.forward.median:.3g} ms"


def undominated(items: Sequence[T], costs: Callable[[T], tuple[float, float]]) -> tuple[T, ...]:
    """Those that no other beats in both costs, the Pareto front, in the order given."""
    found = [costs(item) for item in items]

    def beaten(mine):
        return any(a <= mine[0] and b <= mine[1] and (a, b) != mine for a, b in found)

    return tuple(item for item, cost in zip(items, found, strict=True) if not beaten(cost))


def require_wishes(budget_ms: float | None, error: float | None) -> None:
    """Refuse wishes that are none, or not above zero, with a `LadderError`."""
    for name, value in (("budget_ms", budget_ms), ("error", error)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise LadderError(f"{name} is {value}; give a number above zero")
    if budget_ms is None and error is None:
        raise LadderError("recommend what? give budget_ms, error or both")


# --- what is printed -------------------------------------------------------------------------------------------------

_Cell = Callable[[Ladder, Any], str]
# Head, cell, and which goes first where there is no room: the largest number.
_FIDELITY: tuple[tuple[str, _Cell, int], ...] = (
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
_IMAGES: tuple[tuple[str, _Cell, int], ...] = (
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


_IMAGED = (
    "Images of the reference's frames, without noise; Pixels(40), OneStep and Noser at 0.1 where nothing else is said. "
    "off: from the touch to the centroid of the half maximum, on average; misplaced: share of the force that the force "
    "map shows where it is not; frame: one alone; frames/s: in a batch."
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
        f"of edges {edges} ({coarse:,} and {fine:,} unknowns), itself uncertain by {volts} of the voltages and {touch} "
        "of the difference that a touch makes; rungs that come nearer say <. "
        f"Touches: {', '.join(t.name for t in found.touches)}. Times are medians. *: no other rung is both better and "
        "quicker."
    )
    parts = [textwrap.fill(about, width), _grid(_FIDELITY, found, found.fidelities(), width)]
    imaged = [r for r in found.rungs if r.image]
    if imaged:
        parts.append(textwrap.fill(_IMAGED, width))
        parts.append(_grid(_IMAGES, found, imaged, width))
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
