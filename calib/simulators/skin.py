"""A skin that is simulated step by step: contacts in, readings and pad pressures out.

A step takes the way of a simulated bench (`calib.bench`): the load effects of the scene spread each contact, its sheet
effects turn pressure into conductivity, its pad effects weight what each pad feels, and its histories continue from
the state of the step before. Two things differ, since contacts of a robot come and go in any order. Memory of the
material (`Creep`, `Hysteresis`) belongs to each element of the sheet in place of each contact, which is the same for
one contact that stays where it is. And there is no stage, no load cell and no clock, and the air stays as it is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

import jaxeit as je
from jaxeit import effects as fx

from .contacts import ContactPoints, SimulatorError
from .frames import AbstractFrames, Solved

NOT_IN_A_STEP = (fx.AbstractStageEffect, fx.AbstractScanEffect, fx.AbstractClockEffect)
"""Families of effects that a step cannot have: a bench's stage, moments within a frame, time stamps."""

PORTION = 128  # environments that are computed together, which bounds memory
ENVIRONMENTS = "environments"
T = TypeVar("T")
PROBE_PRESSURE = 1e4  # Pa


class SkinState(NamedTuple):
    """What a step takes over from the step before; made by `SimulatedSkin.start`.

    | meaning                                                        |
    |----------------------------------------------------------------|
    | key of all chance                                              |
    | number of the next step                                        |
    | material, pads: states of the effects on sheet and pads        |
    | eit, pressure: states of the effects on both recorded streams  |
    """

    key: Key[Array, "*environments"]
    number: Int[Array, "*environments"]
    material: tuple[Any, ...]
    pads: tuple[Any, ...]
    eit: tuple[Any, ...]
    pressure: tuple[Any, ...]


class SkinReadings(NamedTuple):
    """What a skin reads in one step.

    | meaning                                                                | shape           | unit |
    |------------------------------------------------------------------------|-----------------|------|
    | frame: readings of one scan                                            | (..., readings) | V    |
    | pressure in each pad, gage                                             | (..., pads)     | Pa   |
    | load: force that arrives on the sheet, without what is spread past it  | (...)           | N    |
    """

    frame: Float[Array, "*environments readings"]
    pressure: Float[Array, "*environments pads"]
    load: Float[Array, "*environments"]


class SimulatedSkin(eqx.Module):
    """A skin under a scene's effects, for `step`; made by `prepare_skin`.

    | meaning                                               | shape            | unit |
    |-------------------------------------------------------|------------------|------|
    | model: the scene at a fidelity                        |                  |      |
    | frames: how readings are computed                     |                  |      |
    | response of the pads to pressure on each element      | (pads, elements) | 1    |
    | resting: readings without contact and without noise   | (readings,)      | V    |
    | interval between steps                                | ()               | s    |
    """

    model: je.Model
    frames: AbstractFrames
    response: Float[Array, "pads elements"]
    resting: Float[Array, " readings"]
    interval: Float[Array, ""]

    def start(self, seed: int = 0, environments: int | None = None) -> SkinState:
        """The state of an untouched skin before its first step, or of so many, each with chance of its own."""
        key = jax.random.key(seed)
        return self._start(key) if environments is None else jax.vmap(self._start)(jax.random.split(key, environments))

    def _start(self, key: Key[Array, ""]) -> SkinState:
        of, pads = self.model.effects, jnp.zeros(len(self.response), self.model.dtype)
        return SkinState(
            key,
            jnp.zeros((), int),
            fx.history_start(fx.chosen(of, fx.AbstractMemoryEffect), jnp.zeros_like(self.model.background)),
            fx.history_start(fx.chosen(of, fx.AbstractPneumaticEffect), pads),
            fx.history_start(fx.chosen(of, fx.AbstractReadoutEffect, fx.StreamKind.EIT), self.resting),
            fx.history_start(fx.chosen(of, fx.AbstractReadoutEffect, fx.StreamKind.PRESSURE), pads),
        )


def prepare_skin(
    scene: je.Scene, rate: float, fidelity: je.Fidelity | None = None, frames: AbstractFrames | None = None
) -> SimulatedSkin:
    """A skin that is simulated ``rate`` times a second (Hz), for `step`.

    Effects on the force stream have no object here and are not computed: a robot has no load cell under its skin.

    Args:
        scene: a skin and its effects; that of a scene file is ``calib.load_bench(path).scene``.
        fidelity: of the simulation; default: `jaxeit.Fidelity.standard`. Take another than that of a calibration,
            which must not compensate for the error of its own mesh.
        frames: how readings are computed; default: `Solved`. `Polarised` is quicker and less exact.

    Raises:
        SimulatorError: for a scene with an effect of `NOT_IN_A_STEP`; for one without any effect that spreads a load,
            since contacts are points, or without any by which pressure changes the conductivity.
    """
    if not 0 < rate < float("inf"):
        raise SimulatorError(f"rate is {rate} Hz; give the number of steps a second")
    for effect in scene.effects:
        if isinstance(effect, NOT_IN_A_STEP):
            raise SimulatorError(
                f"{type(effect).__name__} cannot act in a step of a simulator; leave it out of the scene"
            )
    if not fx.chosen(scene.effects, fx.AbstractLoadEffect):
        raise SimulatorError("no effect spreads the load, and contacts are points; add jaxeit.effects.LoadSpreading")
    model = je.discretise(scene, fidelity)
    laid = fx.laid(model.effects, model.centroids)
    model = eqx.tree_at(lambda m: m.effects, model, laid, is_leaf=lambda x: x is model.effects)
    touched = je.conductivity(model, jnp.full_like(model.background, PROBE_PRESSURE))
    if isinstance(touched, jax.Array) and bool(jnp.all(touched == je.conductivity(model))):
        raise SimulatorError("pressure does not change the conductivity; add jaxeit.effects.ContactPiezoresistance")
    frames = (Solved() if frames is None else frames).prepared(model)
    pads, resting = je.pad_response(scene.skin, model), je.forward(model)
    return SimulatedSkin(model, frames, pads, resting, jnp.asarray(1 / rate, float))


@je.verb
def step(
    skin: SimulatedSkin, state: SkinState, contacts: ContactPoints, *, portion: int = PORTION
) -> tuple[SkinState, SkinReadings]:
    """Readings of a skin under contacts, and its state for the next step.

    Contacts and state with a leading axis are a batch of environments, which do not see each other. Force or place that
    is not finite gives readings that are not finite, in its own environment. For calls from a loop in Python,
    ``jaxeit.bind(step, skin)`` is a function of state and contacts that starts sooner.

    Args:
        portion: environments that are computed together.

    Raises:
        SimulatorError: if the shapes of contacts and state do not go together.
    """
    batch = state.number.shape
    rows = contacts.force.shape[len(batch) :]
    shapes = (*batch, *rows, 2), (*batch, *rows), (*batch, *rows)
    if len(batch) > 1 or len(rows) != 1 or tuple(jnp.shape(part) for part in contacts) != shapes:
        given = ", ".join(f"{name} {jnp.shape(part)}" for name, part in contacts._asdict().items())
        raise SimulatorError(f"{given} do not fit a state of {batch}; give (..., n, 2), (..., n), (..., n)")
    if not batch:
        return _step(skin, state, contacts)
    return _in_portions(partial(_step, skin, axis=ENVIRONMENTS), (state, contacts), batch[0], portion)


def _in_portions(one: Callable[..., T], environments: Any, count: int, portion: int) -> T:
    """``one(*environment)`` for all environments, `portion` of them at a time; as `jax.lax.map` does, but that they
    know each other by the name of their axis."""
    several: Callable[..., T] = jax.vmap(one, axis_name=ENVIRONMENTS)
    whole = count // portion * portion
    if not whole:
        return several(*environments)
    first = jax.tree.map(lambda a: a[:whole].reshape(-1, portion, *a.shape[1:]), environments)
    mapped = jax.lax.map(lambda some: several(*some), first)
    found: T = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), mapped)
    if whole < count:
        rest = several(*jax.tree.map(lambda a: a[whole:], environments))
        found = jax.tree.map(lambda *parts: jnp.concatenate(parts), found, rest)
    return found


def _step(
    skin: SimulatedSkin, state: SkinState, contacts: ContactPoints, axis: str | None = None
) -> tuple[SkinState, SkinReadings]:
    model, effects = skin.model, skin.model.effects
    pressure = _pressure(model, contacts, axis)

    def continued(family: type, values: Array, before: Any, purpose: int, stream: Any = None) -> tuple[Array, Any]:
        mine = fx.chosen(effects, family, stream)
        pattern = model.pattern if stream is fx.StreamKind.EIT and model.mixing is None else model.pattern[:0]
        key = jax.random.fold_in(jax.random.fold_in(state.key, purpose), state.number)
        still = jnp.zeros(1, model.dtype)
        series, after = fx.history(
            mine, values[None], before, fx.HistoryInputs(key, skin.interval, still, still, pattern)
        )
        return series[0], after

    felt, material = continued(fx.AbstractMemoryEffect, pressure, state.material, 0)
    load = jnp.sum(pressure * model.areas)
    frame = skin.frames(model, je.conductivity(model, felt))
    frame = jnp.where(jnp.isfinite(load), frame, jnp.nan)  # laws of pressure take what is no number for no pressure
    inside, pads = continued(fx.AbstractPneumaticEffect, skin.response @ pressure, state.pads, 1)
    frame, eit = continued(fx.AbstractReadoutEffect, frame, state.eit, 2, fx.StreamKind.EIT)
    gage, recorded = continued(fx.AbstractReadoutEffect, inside, state.pressure, 3, fx.StreamKind.PRESSURE)
    after = SkinState(state.key, state.number + 1, material, pads, eit, recorded)
    return after, SkinReadings(frame, gage, load)


def _pressure(model: je.Model, contacts: ContactPoints, axis: str | None) -> Float[Array, " elements"]:
    """Pressure of all contacts on the sheet, Pa; a row that is empty in all environments costs nothing."""
    position, force, diameter = (jnp.asarray(part, model.dtype) for part in contacts)
    empty = force <= 0  # and a force that is not a number is none of those
    force, diameter = jnp.where(empty, 0, force), jnp.where(empty, 1, diameter)
    vacant = empty if axis is None else jax.lax.pmin(empty.astype(jnp.int32), axis) > 0

    def add(sum_: Array, row: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
        place, load, tip, nobody = row
        added = jax.lax.cond(nobody, lambda: sum_, lambda: sum_ + load * je.model.load_spread(model, place, tip))
        return added, None

    return jax.lax.scan(add, jnp.zeros_like(model.background), (position, force, diameter, vacant))[0]
