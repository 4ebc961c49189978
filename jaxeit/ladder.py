"""What accuracy costs in time: a scene at many fidelities, each judged against one reference and timed.

Host code around the verbs: it builds, calls and takes the time.  Errors are against Richardson's
extrapolation from two meshes that no rung has, quadratic elements in float64.  The second order that
it takes for granted is that of sheets whose conductivity is constant by element and of discs that are
polygons; how far it moves the finer solution is stated as its uncertainty (Roache 1994).
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .basis import AbstractBasis, Pixels
from .discretise import Model, discretise
from .fidelity import Fidelity
from .forward import CoatedSheet, conductivity, forward
from .fusion import PadMasks, fuse, pad_masks
from .inverse import AbstractReconstructor, Reconstructor, prepare
from .jacobian import jacobian
from .methods import AbstractIterativeMethod, AbstractLinearMethod, NonNegative, OneStep, SparseBayes
from .metrics import LevelCentroid, localisation_error
from .priors import AbstractPrior, Noser
from .scene import Scene
from .skin import Skin
from .solvers import ConjugateGradient, NestedDissection, Single
from .verbs import compiler_options

Progress = Callable[[Iterable[Any]], Iterable[Any]]

_COARSE, _FINE = 1.2, 1.7  # the meshes of the reference over the finest of the rungs
_ORDER = 2
_LEAST, _MOST = 3, 1000  # calls of each that are timed
_BATCH = 256
_ESTIMATOR = LevelCentroid(0.5)
# Degree-5 quadrature on the triangle (Strang and Fix): barycentric points and weights.
_A, _B = (6 + np.sqrt(15)) / 21, (6 - np.sqrt(15)) / 21
_POINTS = np.array(
    [[1 / 3] * 3]
    + [np.roll([1 - 2 * _A, _A, _A], k) for k in range(3)]
    + [np.roll([1 - 2 * _B, _B, _B], k) for k in range(3)]
)
_WEIGHTS = np.array([9 / 40] + 3 * [(155 + np.sqrt(15)) / 1200] + 3 * [(155 - np.sqrt(15)) / 1200])


class LadderError(ValueError):
    """Rungs that cannot be compared, or a wish that none fulfils; the message says what to change."""


# --- what is measured ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Touch:
    """A contact: a Gaussian bump of pressure, or of conductivity where no effect of the scene answers to pressure.

    | meaning                                                     | unit |
    |-------------------------------------------------------------|------|
    | name                                                        |      |
    | position of its middle in the sheet's flat coordinates      | m    |
    | width: standard deviation                                   | m    |
    | pressure at the middle                                      | Pa   |
    | rise: relative change of conductivity there, on a bare scene | 1   |
    """

    name: str
    position: tuple[float, float]
    width: float
    pressure: float = 5e4
    rise: float = 0.5

    def __post_init__(self):
        if not (np.isfinite(self.position).all() and self.width > 0 and self.pressure > 0 and self.rise > 0):
            raise LadderError(f"{self}: give a finite position, and width, pressure and rise above zero")


@dataclass(frozen=True)
class Imaging:
    """How images are made: what `prepare` is told, but for the model."""

    basis: AbstractBasis = field(default_factory=Pixels)
    method: AbstractLinearMethod | AbstractIterativeMethod = field(default_factory=OneStep)
    prior: AbstractPrior = field(default_factory=Noser)
    hyperparameter: float = 0.1


@dataclass(frozen=True)
class Choice:
    """One way to compute, by a name; ``imaging`` None: no images are made and judged."""

    label: str
    fidelity: Fidelity
    imaging: Imaging | None = field(default_factory=Imaging)


@dataclass(frozen=True)
class Times:
    """Seconds of a call, over ``repeats`` calls; all rungs were called in turn, round after round."""

    median: float
    least: float
    p99: float
    repeats: int


@dataclass(frozen=True)
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
    | frames_per_second, in a batch                                                  | 1/s  |
    """

    localisation: float
    worst: float
    misplaced: float
    prepare: float
    frame: Times
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
    | voltage_uncertainty, difference_uncertainty: what the extrapolation moved, relative | () | 1 |
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
        return tuple({rung.choice.fidelity: rung for rung in reversed(self.rungs)}.values())[::-1]

    def front(self) -> tuple[Rung, ...]:
        """Fidelities that no other beats in both difference error and time of a forward solve."""
        return _pareto(self.fidelities(), lambda r: (self.certain(r), r.forward.median))

    def image_front(self) -> tuple[Rung, ...]:
        """Rungs that no other beats in both localisation error and time of a frame."""
        imaged = [r for r in self.rungs if r.image]
        return _pareto(imaged, lambda r: (r.image.localisation, r.image.frame.median))

    def recommend(self, *, budget_ms: float | None = None, error: float | None = None) -> Rung:
        """The quickest rung that is within ``error``; without one, the most accurate within the budget.

        Args:
            budget_ms: most that a forward solve may take, in ms, by its median here.
            error: most difference error, relative; never promised below the reference's uncertainty.

        Raises:
            LadderError: if neither is given, or no rung fulfils both.
        """
        for name, value in (("budget_ms", budget_ms), ("error", error)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise LadderError(f"{name} is {value}; give a number above zero")
        if budget_ms is None and error is None:
            raise LadderError("recommend what? give budget_ms, error or both")
        quick = [r for r in self.fidelities() if budget_ms is None or 1e3 * r.forward.median <= budget_ms]
        good = [r for r in quick if error is None or self.certain(r) <= error]
        if not good:
            raise LadderError(self._refusal(quick, budget_ms, error))
        if error is None:
            return min(good, key=lambda r: (self.certain(r), r.forward.median))
        return min(good, key=lambda r: r.forward.median)

    def _refusal(self, quick: Sequence[Rung], budget_ms: float | None, error: float | None) -> str:
        if not quick:
            best = min(self.rungs, key=lambda r: r.forward.median)
            return f"no rung solves in {budget_ms:g} ms; the quickest, {self._said(best)}: give more time"
        best = min(quick, key=self.certain)
        within = "" if budget_ms is None else f" in {budget_ms:g} ms"
        return f"no rung has an error of {error:g}{within}; the best, {self._said(best)}: allow more, or give finer rungs"

    def _said(self, rung: Rung) -> str:
        return f"{rung.choice.label}, has {self.certain(rung):.2g} in {1e3 * rung.forward.median:.3g} ms"


def _pareto(rungs: Sequence[Rung], costs: Callable[[Any], tuple[float, float]]) -> tuple[Rung, ...]:
    found = [costs(rung) for rung in rungs]

    def beaten(mine):
        return any(a <= mine[0] and b <= mine[1] and (a, b) != mine for a, b in found)

    return tuple(rung for rung, cost in zip(rungs, found, strict=True) if not beaten(cost))


# --- what is asked for -----------------------------------------------------------------------------------------------


def few_choices() -> tuple[Choice, ...]:
    """Rungs for a first look, within a minute."""
    return (
        Choice("draft", Fidelity.draft()),
        Choice("draft P2 f32", Fidelity.draft(order=2, dtype=np.float32)),
        Choice("standard", Fidelity.standard()),
    )


def fidelity_choices() -> tuple[Choice, ...]:
    """Rungs over edge length, order, precision and solver, all with one kind of image."""
    draft, standard, reference = Fidelity.draft, Fidelity.standard, Fidelity.reference
    single = Single(NestedDissection())
    named = {
        "coarse P2": draft(edge_length=0.12, order=2),
        "draft": draft(),
        "draft f32": draft(dtype=np.float32),
        "draft P2": draft(order=2),
        "draft P2 f32": draft(order=2, dtype=np.float32),
        "standard": standard(),
        "standard f32": standard(dtype=np.float32),
        "standard cg": standard(solver=ConjugateGradient(single)),
        "standard P2": standard(order=2),
        "standard P2 f32": standard(order=2, dtype=np.float32),
        "standard P2 f32 solve": standard(order=2, solver=single),
        "fine": reference(order=1),
        "reference f32": reference(dtype=np.float32),
        "reference": reference(),
    }
    return tuple(Choice(label, fidelity) for label, fidelity in named.items())


def image_choices() -> tuple[Choice, ...]:
    """Rungs over pixels and method, at the standard fidelity."""
    settings = {
        "20 pixels": Imaging(Pixels(20)),
        "80 pixels": Imaging(Pixels(80)),
        "non-negative": Imaging(method=NonNegative()),
        "sparse Bayes": Imaging(method=SparseBayes()),
    }
    return tuple(Choice(label, Fidelity.standard(), imaging) for label, imaging in settings.items())


def default_touches(skin: Skin) -> tuple[Touch, ...]:
    """Contacts where accuracy is asked for: amid a pad, by its edge, by the rim, between two electrodes.

    Their width is a twentieth of the root of the sheet's area: 10 mm on the testbed.
    """
    width, middle = 0.05 * np.sqrt(skin.domain.area), np.mean(skin.domain.bounds, 0)
    places = {"middle": middle} | _on_pad(skin, middle) | {"by the rim": _by_the_rim(skin, middle)}
    places["between electrodes"] = _between_electrodes(skin, middle)
    inside = {name: tuple(place.tolist()) for name, place in places.items() if skin.domain.contains(place[None])[0]}
    return tuple(Touch(name, place, float(width)) for name, place in inside.items())


def _on_pad(skin: Skin, middle: np.ndarray) -> dict[str, np.ndarray]:
    if not skin.pads:
        return {}
    corners = skin.pads[0].outline
    centre, sides = corners.mean(0), (corners + np.roll(corners, -1, 0)) / 2
    side = sides[np.argmin(np.round(np.linalg.norm(sides - middle, axis=1), 9))]
    return {"middle": centre, "by a pad's edge": side + (centre - side) / 8}


def _by_the_rim(skin: Skin, middle: np.ndarray) -> np.ndarray:
    """A tenth of the way from the rim to the middle, at the first place along the rim where that is on the sheet."""
    rim = skin.domain.boundary_point(np.linspace(0.3, 1.3, 20, endpoint=False) * skin.domain.perimeter)
    places = rim + (middle - rim) / 10
    return places[np.argmax(skin.domain.contains(places))]


def _between_electrodes(skin: Skin, middle: np.ndarray) -> np.ndarray:
    """Amid the neighbouring pair nearest to the middle."""
    at = skin.electrode_positions
    first, second = np.triu_indices(len(at), 1)
    apart = np.round(np.linalg.norm(at[first] - at[second], axis=1), 9)
    halfway = ((at[first] + at[second]) / 2)[apart <= 1.01 * apart.min()]
    return halfway[np.argmin(np.round(np.linalg.norm(halfway - middle, axis=1), 9))]


def refined(fidelity: Fidelity, factor: float) -> Fidelity:
    """``factor`` times finer everywhere: at the electrodes and in how fast edges grow from there, too.

    Quadratic elements in float64: the family of the reference.
    """
    return replace(
        fidelity,
        edge_length=fidelity.edge_length / factor,
        electrode_segments=_sides(fidelity.electrode_segments * factor),
        growth=max(1.05, fidelity.growth ** (1 / factor)),
        order=2,
        dtype=np.float64,
        solver=None,
    )


def _sides(least: float) -> int:
    """The nearest count of sides that a mesh can halve to its hub: 6 to 12 times a power of two."""
    power = 2 ** max(0, int(np.floor(np.log2(least / 6))))
    return max(6, round(least / power)) * power


# --- measuring -------------------------------------------------------------------------------------------------------


def ladder(
    scene: Scene,
    rungs: Sequence[Choice] | None = None,
    *,
    touches: Sequence[Touch] | None = None,
    reference: tuple[Fidelity, Fidelity] | None = None,
    budget: float = 0.5,
    progress: Progress = iter,
) -> Ladder:
    """Build, judge and time ``scene`` at every rung.

    Frames of the reference are what images are made of, so that no rung inverts its own mesh.  They
    have no noise: what is left of the localisation error is the reconstruction's own.

    Args:
        rungs: default `fidelity_choices` and `image_choices`.
        touches: default `default_touches`.
        reference: a coarse and a fine fidelity of one family to extrapolate from; default: `refined`
            1.2 and 1.7 times from the finest rung.
        budget: seconds to repeat each of a rung's calls for; three repeats are made in any case.
        progress: wraps each pass over the rungs.

    Raises:
        LadderError: if there are no rungs or touches, labels repeat, or the reference has a rung's mesh.
        FidelityError: if JAX is in 32-bit mode: the reference needs float64.
    """
    choices = tuple(fidelity_choices() + image_choices() if rungs is None else rungs)
    touches = tuple(default_touches(scene.skin) if touches is None else touches)
    pair = _reference_of(choices) if reference is None else reference
    _check(choices, touches, pair)
    coarse, fine = (_solved(scene, fidelity, touches) for fidelity in progress(pair))
    truth = extrapolated(pair, coarse, fine)
    fidelities = dict.fromkeys(choice.fidelity for choice in choices)
    solved = {fidelity: _solved(scene, fidelity, touches) for fidelity in progress(fidelities)}
    for solution in progress(solved.values()):
        solution.compile_jacobian(next(c.imaging for c in choices if solved[c.fidelity] is solution))
    images = [
        c.imaging and _imaged(scene.skin, solved[c.fidelity].model, c.imaging, touches, truth) for c in progress(choices)
    ]
    device = jax.devices()[0]
    return Ladder(
        skin=scene.skin.name,
        effects=tuple(type(effect).__name__ for effect in scene.effects),
        device=f"{device.platform} ({device.device_kind})",
        touches=touches,
        reference=truth,
        rungs=_timed(choices, solved, images, truth, budget, progress),
    )
