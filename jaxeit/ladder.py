"""What accuracy costs in time: a scene at many fidelities, each judged against one reference and timed.

Host code around the verbs: it builds, calls and takes the time.  Errors are against Richardson's
extrapolation from two meshes that no rung has, quadratic elements in float64.  Its order is three for the
readings of an even sheet (quadratic elements, discs that are polygons) and two for what a touch changes, as
conductivity is constant by element.  How far an extrapolation of order two would move the finer solution is
stated as the reference's uncertainty, of both (Roache 1994).
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import cycle
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .basis import AbstractBasis, Pixels
from .choices import Choice, LadderError, Touch, default_touches, fidelity_choices, image_choices, refined
from .discretise import Model, discretise
from .fidelity import Fidelity
from .forward import CoatedSheet, conductivity, forward
from .fusion import PadMasks, fuse, pad_masks
from .inverse import AbstractReconstructor, Reconstructor, prepare
from .jacobian import jacobian
from .metrics import LevelCentroid, localisation_error
from .rungs import Image, Ladder, Reference, Rung, Times, require_wishes
from .scene import Scene
from .skin import Skin
from .verbs import compiler_options

Progress = Callable[[Iterable[Any]], Iterable[Any]]

_COARSE, _FINE = 1.1, 1.5  # the meshes of the reference over the finest of the rungs
_LEAST, _MOST = 3, 1000  # calls of each that are timed
_BATCH = 100
_ESTIMATOR = LevelCentroid(0.5)
# Degree-5 quadrature on the triangle (Strang and Fix): barycentric points and weights.
_A, _B = (6 + np.sqrt(15)) / 21, (6 - np.sqrt(15)) / 21
_POINTS = np.array(
    [[1 / 3] * 3]
    + [np.roll([1 - 2 * _A, _A, _A], k) for k in range(3)]
    + [np.roll([1 - 2 * _B, _B, _B], k) for k in range(3)]
)
_WEIGHTS = np.array([9 / 40] + 3 * [(155 + np.sqrt(15)) / 1200] + 3 * [(155 - np.sqrt(15)) / 1200])


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
            1.1 and 1.5 times from the finest rung.
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
    truth = extrapolated(*[_solved(scene, fidelity, touches) for fidelity in progress(pair)])
    solved = {f: _solved(scene, f, touches) for f in progress(dict.fromkeys(c.fidelity for c in choices))}
    seen = [_imaged(scene.skin, solved[c.fidelity].model, c, touches, truth) for c in progress(choices)]
    costs, images = _costs(solved, choices, budget, progress), _images(seen, truth, budget, progress)
    return Ladder(
        skin=scene.skin.name,
        effects=tuple(type(effect).__name__ for effect in scene.effects),
        device=jax.devices()[0].platform,
        touches=touches,
        reference=truth,
        rungs=tuple(
            _rung(choice, solved[choice.fidelity], costs[choice.fidelity], image, truth)
            for choice, image in zip(choices, images, strict=True)
        ),
    )


def fit_fidelity(
    scene: Scene,
    *,
    budget_ms: float | None = None,
    error: float | None = None,
    rungs: Sequence[Choice] | None = None,
    progress: Progress = iter,
) -> Fidelity:
    """The fidelity for this scene on this machine, measured: `Ladder.recommend` of a `ladder` without images.

    (A verb here and no method of `Fidelity`, which knows no scene.)

    Raises:
        LadderError: if neither wish is given, or no rung fulfils both.
    """
    require_wishes(budget_ms, error)
    choices = fidelity_choices() if rungs is None else rungs
    measured = ladder(scene, [replace(choice, imaging=None) for choice in choices], progress=progress)
    return measured.recommend(budget_ms=budget_ms, error=error).choice.fidelity


def _reference_of(choices: Sequence[Choice]) -> tuple[Fidelity, Fidelity]:
    if not choices:
        raise LadderError("there are no rungs; give one or more")
    finest = min((choice.fidelity for choice in choices), key=lambda f: f.edge_length)
    return refined(finest, _COARSE), refined(finest, _FINE)


def _check(choices: Sequence[Choice], touches: Sequence[Touch], pair: tuple[Fidelity, Fidelity]) -> None:
    if not choices or not touches:
        raise LadderError("there are no rungs or no touches; give one or more of each")
    labels = [choice.label for choice in choices]
    if len(set(labels)) < len(labels):
        raise LadderError(f"rungs are told apart by their labels, and some repeat: {', '.join(labels)}")
    if not pair[1].edge_length < pair[0].edge_length:
        raise LadderError("the reference is a coarse and a fine fidelity, in this order; the second must be finer")
    same = [c.label for c in choices if any(_mesh_of(c.fidelity) == _mesh_of(f) for f in pair)]
    if same:
        raise LadderError(f"{same[0]} has a mesh of the reference, which would judge itself; give another reference")


def _mesh_of(fidelity: Fidelity) -> tuple[float, int, float]:
    return fidelity.edge_length, fidelity.electrode_segments, fidelity.growth


@dataclass(frozen=True, eq=False)
class _Program:
    """A compiled call of (arrays, varying argument), the seconds it took to compile and the bytes it takes."""

    run: Callable[[Any], Any]
    seconds: float
    memory: int | None


def _compiled(function: Callable[..., Any], fixed: Any, varying: Any) -> _Program:
    """``function(fixed, varying)`` as one program, the clock around its compilation."""
    arrays, rest = eqx.partition(fixed, eqx.is_array)
    program = jax.jit(
        lambda arrays, varying: function(eqx.combine(arrays, rest), varying), compiler_options=compiler_options()
    )
    seconds, done = _clocked(lambda: program.lower(arrays, varying).compile())
    sizes = done.memory_analysis()
    memory = sizes and sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return _Program(_finished(partial(done, arrays)), seconds, memory)


def _clocked(call: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    out = call()
    return time.perf_counter() - start, out


@dataclass(frozen=True, eq=False)
class _Solution:
    fidelity: Fidelity
    model: Model
    setup: float
    program: _Program
    untouched: Array
    touched: tuple[Array | CoatedSheet, ...]
    voltages: np.ndarray
    differences: np.ndarray


def _solved(scene: Scene, fidelity: Fidelity, touches: Sequence[Touch]) -> _Solution:
    setup, model = _clocked(lambda: jax.block_until_ready(discretise(scene, fidelity)))
    untouched = conductivity(model)
    touched = tuple(_touched(model, untouched, touch) for touch in touches)
    program = _compiled(forward, model, touched[0])
    coated = isinstance(touched[0], CoatedSheet)  # what does not touch its coat is another program
    v0 = np.asarray(forward(model, untouched) if coated else program.run(untouched))
    dv = np.stack([np.asarray(program.run(sigma)) for sigma in touched]) - v0
    return _Solution(fidelity, model, setup, program, untouched, touched, v0, dv)


def _touched(model: Model, untouched: Array, touch: Touch) -> Array | CoatedSheet:
    bump = _bump(model, touch)
    pressed = conductivity(model, jnp.asarray(touch.pressure * bump, model.dtype))
    if isinstance(pressed, CoatedSheet) or bool(jnp.any(pressed != untouched)):
        return pressed
    return untouched * jnp.asarray(1 + touch.rise * bump, model.dtype)


def _bump(model: Model, touch: Touch) -> Float[np.ndarray, " elements"]:
    """Means over the elements of a bump of height one, the same on all meshes up to fourth order."""
    corners = np.asarray(model.chart, np.float64)[np.asarray(model.triangles)]
    places = np.einsum("qc,ecd->eqd", _POINTS, corners)
    return _gaussian(places, touch) @ _WEIGHTS


def _gaussian(places: Float[np.ndarray, "... 2"], touch: Touch) -> Float[np.ndarray, "..."]:
    return np.exp(-0.5 * np.sum((places - np.asarray(touch.position)) ** 2, -1) / touch.width**2)


def extrapolated(coarse: _Solution, fine: _Solution) -> Reference:
    """Richardson's extrapolation of two solutions of one family of meshes."""
    ratio = coarse.fidelity.edge_length / fine.fidelity.edge_length
    voltages = _further(coarse.voltages, fine.voltages, ratio**3)
    differences = _further(coarse.differences, fine.differences, ratio**2)
    cautious = _further(coarse.voltages, fine.voltages, ratio**2)
    return Reference(
        fidelities=(coarse.fidelity, fine.fidelity),
        unknowns=(coarse.model.system.unknowns, fine.model.system.unknowns),
        voltages=voltages,
        differences=differences,
        voltage_uncertainty=_relative(fine.voltages, cautious),
        difference_uncertainty=_relative(fine.differences, differences),
    )


def _further(coarse: np.ndarray, fine: np.ndarray, fall: float) -> np.ndarray:
    """Where the error vanishes that falls by this factor from the coarse to the fine."""
    return fine + (fine - coarse) / (fall - 1)


def _relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Images of the reference's frames on a rung, judged; how one frame and how many are imaged, to be timed."""

    apart: np.ndarray
    misplaced: float
    prepare: float
    one: Callable[[np.ndarray], Any]
    many: Callable[[np.ndarray], Any]


def _imaged(skin: Skin, model: Model, choice: Choice, touches: Sequence[Touch], truth: Reference) -> _Seen | None:
    how = choice.imaging
    if how is None:
        return None
    settings: dict[str, Any] = {f.name: getattr(how, f.name) for f in fields(how)}
    spent, recon = _clocked(lambda: jax.block_until_ready(prepare(model, **settings)))
    image = recon(truth.differences.astype(model.dtype))
    apart = np.asarray(localisation_error(_ESTIMATOR(image, recon), _places(touches, model.dtype)))
    if not np.isfinite(apart).all():
        lost = touches[int(np.argmin(np.isfinite(apart)))].name
        raise LadderError(f"{choice.label} shows nothing of the touch {lost!r}; give another, or other images")
    one = recon.on_host() if isinstance(recon, Reconstructor) else _finished(recon)
    return _Seen(apart, float(_misplaced(skin, recon, image, touches).mean()), spent, one, _finished(recon))


def _finished(call: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda given: jax.block_until_ready(call(given))


def _places(touches: Sequence[Touch], dtype: np.dtype) -> Float[np.ndarray, "touches 2"]:
    return np.array([touch.position for touch in touches], dtype)


def _misplaced(
    skin: Skin, recon: AbstractReconstructor, image: Float[Array, "touches basis"], touches: Sequence[Touch]
) -> Float[np.ndarray, " touches"]:
    """Half of what the force map has too much and too little, for a force of one; pads know their shares exactly."""
    bumps = np.stack([_gaussian(np.asarray(recon.centres, np.float64), t) for t in touches]) * np.asarray(recon.areas)
    masks = _masks(skin, recon, bumps)
    weights = np.asarray(masks.weights, np.float64)
    wanted = bumps * weights.sum(0)
    whole = wanted.sum(1, keepdims=True)
    shown = fuse(image, masks, jnp.asarray(bumps @ weights.T / whole, image.dtype))
    return np.abs(np.asarray(shown) - wanted / whole).sum(1) / 2


def _masks(skin: Skin, recon: Any, bumps: Float[np.ndarray, "touches basis"]) -> PadMasks:
    """The pads where they carry most of every touch; else the sheet as one pad."""
    if skin.pads and len(recon.shape) == 2:
        masks = pad_masks(skin, recon)
        if np.all(bumps @ np.asarray(masks.weights).sum(0) > bumps.sum(1) / 2):
            return masks
    return PadMasks(jnp.ones_like(recon.areas)[None], recon.areas)


# --- the clock -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Cost:
    forward: Times
    jacobian: Times
    memory: int | None


def _costs(
    solved: Mapping[Fidelity, _Solution], choices: Sequence[Choice], budget: float, progress: Progress
) -> dict[Fidelity, _Cost]:
    """Forward solves of all fidelities in turn, then Jacobians, all for the basis of the first image."""
    basis = next((c.imaging.basis for c in choices if c.imaging), Pixels())
    slopes = [_slopes(solution, basis) for solution in progress(solved.values())]
    solves = _rounds([_in_turn(s.program.run, s.touched) for s in solved.values()], budget, progress)
    again = [partial(slope.run, s.untouched) for slope, s in zip(slopes, solved.values(), strict=True)]
    memory = [_larger(s.program.memory, slope.memory) for slope, s in zip(slopes, solved.values(), strict=True)]
    return dict(zip(solved, map(_Cost, solves, _rounds(again, budget, progress), memory), strict=True))


def _larger(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else max(one, other)


def _slopes(solution: _Solution, basis: AbstractBasis) -> _Program:
    image = basis.on(solution.model)
    return _compiled(lambda fixed, at: jacobian(fixed[0], at, fixed[1]), (solution.model, image), solution.untouched)


def _images(seen: Sequence[_Seen | None], truth: Reference, budget: float, progress: Progress) -> list[Image | None]:
    frames = truth.differences
    there = [s for s in seen if s]
    one = _rounds([_in_turn(s.one, frames) for s in there], budget, progress)
    sizes = [int(np.clip(budget / times.median, _BATCH // 25, _BATCH)) for times in one]  # slow methods take fewer
    batches = [np.resize(frames, (size, frames.shape[1])) for size in sizes]
    many = _rounds([partial(s.many, batch) for s, batch in zip(there, batches, strict=True)], budget, progress)
    found = iter(map(_image, there, one, sizes, many))
    return [None if s is None else next(found) for s in seen]


def _image(seen: _Seen, one: Times, size: int, many: Times) -> Image:
    return Image(
        localisation=float(seen.apart.mean()),
        worst=float(seen.apart.max()),
        misplaced=seen.misplaced,
        prepare=seen.prepare,
        frame=one,
        batch=size,
        frames_per_second=size / many.median,
    )


def _in_turn(call: Callable[[Any], Any], inputs: Iterable[Any]) -> Callable[[], Any]:
    """The call with the next of the inputs each time, over and over."""
    given = cycle(inputs)
    return lambda: call(next(given))


def _rounds(calls: Sequence[Callable[[], Any]], budget: float, progress: Progress) -> list[Times]:
    """Times of each, all in turn, round after round, so that a busy moment falls on all; after a first call of each."""
    for call in calls:
        call()
    taken: list[list[float]] = [[] for _ in calls]
    left = [budget] * len(calls)
    for turn in progress(range(_MOST)):
        going = [i for i in range(len(calls)) if turn < _LEAST or left[i] > 0]
        for i in going:
            taken[i].append(_clocked(calls[i])[0])
            left[i] -= taken[i][-1]
        if not going:
            break
    return [_times(seconds) for seconds in taken]


def _times(seconds: Sequence[float]) -> Times:
    least, median, late = np.quantile(seconds, [0, 0.5, 0.99]).tolist()
    return Times(median, least, late, len(seconds))


def _rung(choice: Choice, solution: _Solution, cost: _Cost, image: Image | None, truth: Reference) -> Rung:
    return Rung(
        choice=choice,
        nodes=len(solution.model.nodes),
        unknowns=solution.model.system.unknowns,
        voltage_error=_relative(solution.voltages, truth.voltages),
        difference_error=_relative(solution.differences, truth.differences),
        setup=solution.setup,
        compile=solution.program.seconds,
        forward=cost.forward,
        jacobian=cost.jacobian,
        memory=cost.memory,
        image=image,
    )
