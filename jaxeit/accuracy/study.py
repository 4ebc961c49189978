"""Accuracy against time: the errors, relative to one reference, and the times of a scene at many fidelities.

This code runs on the host: it builds models, calls compiled programs and measures times.  Errors are relative to a
reference that is extrapolated from two meshes finer than that of any rung (`jaxeit.accuracy.solutions`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

from ..model.bases import AbstractBasis, Pixels
from ..model.discretisation import require_scene
from ..model.fidelity import Fidelity
from ..model.scene import Scene
from ..model.sensitivity import jacobian
from .image_quality import JudgedImages, judged_images
from .recommendation import Image, Ladder, Reference, Rung, Times
from .settings import Choice, LadderError, Touch, default_touches, fidelity_choices, image_choices, refined
from .solutions import Solution, extrapolated, relative_error, solved
from .timing import Program, Progress, compiled, in_turn, timed_in_rounds

COARSE_REFERENCE, FINE_REFERENCE = 1.1, 1.5  # finest edge length of the rungs over those of the reference's two meshes
BATCH_SIZE = 100  # frames of a batch of images, at most
MIN_BATCH_SIZE = 4  # for methods that take longer than the time budget


def ladder(
    scene: Scene,
    rungs: Sequence[Choice] | None = None,
    *,
    touches: Sequence[Touch] | None = None,
    reference: tuple[Fidelity, Fidelity] | None = None,
    budget: float = 0.5,
    progress: Progress = iter,
) -> Ladder:
    """Build ``scene`` at every rung, and measure its errors and times.

    Images are made of the reference's frames, so that no rung inverts data of its own mesh.  The frames have
    no noise: the localisation error is that of the reconstruction alone.

    Args:
        scene: the scene to study.
        rungs: default `fidelity_choices` and `image_choices`.
        touches: contacts that define the errors; default `default_touches`.
        reference: a coarse and a fine fidelity of one family to extrapolate from; default: the finest rung
            `refined` 1.1 and 1.5 times.
        budget: seconds for the repeats of each timed call; three repeats are made in any case.
        progress: wraps each pass over the rungs.

    Raises:
        SceneError: if ``scene`` is no scene, such as a skin or a name.
        LadderError: if there are no rungs or touches, labels repeat, or the reference has a rung's mesh.
        FidelityError: if JAX is in 32-bit mode: the reference needs float64.
    """
    require_scene(scene)
    choices = tuple(fidelity_choices() + image_choices() if rungs is None else rungs)
    touches = tuple(default_touches(scene.skin) if touches is None else touches)
    pair = _reference_of(choices) if reference is None else reference
    _check(choices, touches, pair)
    truth = extrapolated(*[solved(scene, fidelity, touches).readings for fidelity in progress(pair)])
    solutions = {f: solved(scene, f, touches) for f in progress(dict.fromkeys(c.fidelity for c in choices))}
    judged = [judged_images(scene.skin, solutions[c.fidelity].model, c, touches, truth) for c in progress(choices)]
    costs, images = _costs(solutions, choices, budget, progress), _images(judged, truth, budget, progress)
    return Ladder(
        skin=scene.skin.name,
        effects=tuple(type(effect).__name__ for effect in scene.effects),
        device=jax.devices()[0].platform,
        touches=touches,
        reference=truth,
        rungs=tuple(
            _rung(choice, solutions[choice.fidelity], costs[choice.fidelity], image, truth)
            for choice, image in zip(choices, images, strict=True)
        ),
    )


def _reference_of(choices: Sequence[Choice]) -> tuple[Fidelity, Fidelity]:
    if not choices:
        raise LadderError("there are no rungs; give one or more")
    finest = min((choice.fidelity for choice in choices), key=lambda f: f.edge_length)
    return refined(finest, COARSE_REFERENCE), refined(finest, FINE_REFERENCE)


def _check(choices: Sequence[Choice], touches: Sequence[Touch], pair: tuple[Fidelity, Fidelity]) -> None:
    if not choices or not touches:
        raise LadderError("there are no rungs or no touches; give one or more of each")
    labels = [choice.label for choice in choices]
    if len(set(labels)) < len(labels):
        raise LadderError(f"labels name the rungs, and some repeat: {', '.join(labels)}")
    if not pair[1].edge_length < pair[0].edge_length:
        raise LadderError("the reference is a coarse and a fine fidelity, in this order; the second must be finer")
    same = [c.label for c in choices if any(_mesh_of(c.fidelity) == _mesh_of(f) for f in pair)]
    if same:
        raise LadderError(f"{same[0]} has a mesh of the reference, which would judge itself; give another reference")


def _mesh_of(fidelity: Fidelity) -> tuple[float, int, float]:
    return fidelity.edge_length, fidelity.electrode_segments, fidelity.growth


@dataclass(frozen=True, eq=False)
class _Cost:
    forward: Times
    jacobian: Times
    memory: int | None


def _costs(
    solutions: Mapping[Fidelity, Solution], choices: Sequence[Choice], budget: float, progress: Progress
) -> dict[Fidelity, _Cost]:
    """Times of the forward solves of all fidelities, then of their Jacobians, all for the basis of the first image."""
    basis = next((c.imaging.basis for c in choices if c.imaging), Pixels())
    slopes = [_slopes(solution, basis) for solution in progress(solutions.values())]
    solves = timed_in_rounds([in_turn(s.program.run, s.touched) for s in solutions.values()], budget, progress)
    again = [partial(slope.run, s.untouched) for slope, s in zip(slopes, solutions.values(), strict=True)]
    memory = [_larger(s.program.memory, slope.memory) for slope, s in zip(slopes, solutions.values(), strict=True)]
    return dict(zip(solutions, map(_Cost, solves, timed_in_rounds(again, budget, progress), memory), strict=True))


def _larger(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else max(one, other)


def _slopes(solution: Solution, basis: AbstractBasis) -> Program:
    image = basis.on(solution.model)
    return compiled(lambda fixed, at: jacobian(fixed[0], at, fixed[1]), (solution.model, image), solution.untouched)


def _images(
    judged: Sequence[JudgedImages | None], truth: Reference, budget: float, progress: Progress
) -> list[Image | None]:
    frames = truth.differences
    there = [images for images in judged if images]
    one = timed_in_rounds([in_turn(images.one, frames) for images in there], budget, progress)
    sizes = [int(np.clip(budget / times.median, MIN_BATCH_SIZE, BATCH_SIZE)) for times in one]
    batches = [np.resize(frames, (size, frames.shape[1])) for size in sizes]
    calls = [partial(images.many, batch) for images, batch in zip(there, batches, strict=True)]
    found = iter(map(_image, there, one, sizes, timed_in_rounds(calls, budget, progress)))
    return [None if images is None else next(found) for images in judged]


def _image(images: JudgedImages, one: Times, size: int, many: Times) -> Image:
    return Image(
        localisation=float(images.distances.mean()),
        worst=float(images.distances.max()),
        misplaced=images.misplaced,
        prepare=images.prepare,
        frame=one,
        batch=size,
        frames_per_second=size / many.median,
    )


def _rung(choice: Choice, solution: Solution, cost: _Cost, image: Image | None, truth: Reference) -> Rung:
    return Rung(
        choice=choice,
        nodes=len(solution.model.nodes),
        unknowns=solution.readings.unknowns,
        voltage_error=relative_error(solution.readings.voltages, truth.voltages),
        difference_error=relative_error(solution.readings.differences, truth.differences),
        setup=solution.setup,
        compile=solution.program.seconds,
        forward=cost.forward,
        jacobian=cost.jacobian,
        memory=cost.memory,
        image=image,
    )
