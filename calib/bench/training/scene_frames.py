"""Frames of random scenes on one drawn skin after another.

A shard is a recording of one skin: the seeds of all effects are drawn, the untouched skin is recorded, and frames with
independent contacts follow at the rate of the bench. Drift, noise and faults run through the whole shard, as in a
recording. What remembers a load (creep, hysteresis, pads) sees a press of its own for each frame.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import jaxeit as je
from jaxeit import effects as fx

from ..bench import Bench, BenchError
from ..dataset import grid
from ..resolution import force_shares
from ..streams import history
from .random_scenes import STRENGTHS, DrawnContacts, RandomScenes, Tips, arrange_tips, draw_contacts

SHARD_FRAMES = 1024  # frames of one skin
CHUNK_FRAMES = 128  # frames that are solved together, and of the untouched skin at the start
HOLD_STEPS = 16  # samples of a hold; the load rises and falls in as many before it
MAX_TIP_ERROR = 0.1  # of the force of a tip on the mesh
LEAST_FORCE = 1e-7  # N: what is less on a pixel is zero, so that maps take less space
UNPRESSED = (
    "the scene has no effect by which pressure changes the sheet, so that all frames would be equal; list one, such as "
    "ContactPiezoresistance"
)


class Press(NamedTuple):
    """What touches the skin in one frame, or in some, along a first axis.

    | field                                                | shape       | unit |
    |------------------------------------------------------|-------------|------|
    | load of each contact                                 | (contacts,) | N    |
    | place of each tip                                    | (tips, 2)   | m    |
    | contact of each tip, and its share of that load      | (tips,)     |      |
    | hold: time since the load is constant                | ()          | s    |
    | peak: highest load before the hold over that of it   | ()          | 1    |
    | warmth: temperature above that at the start          | ()          | K    |
    | air: pressure of the air above that at the start     | ()          | Pa   |
    | number: 0 for the untouched skin, then of the frame  | ()          |      |
    """

    load: Float[Array, "*n contacts"]
    place: Float[Array, "*n tips 2"]
    contact: Int[Array, "*n tips"]
    share: Float[Array, "*n tips"]
    hold: Float[Array, "*n"]
    peak: Float[Array, "*n"]
    warmth: Float[Array, "*n"]
    air: Float[Array, "*n"]
    number: Int[Array, "*n"]


class SolvedFrames(NamedTuple):
    """Frames before the electronics.

    | field                                  | shape              | unit |
    |----------------------------------------|--------------------|------|
    | voltages                               | (frames, readings) | V    |
    | pressures in the pads                  | (frames, pads)     | Pa   |
    | force_map: force on each pixel         | (frames, pixels)   | N    |
    """

    voltages: Float[Array, "*n readings"]
    pressures: Float[Array, "*n pads"]
    force_map: Float[Array, "*n pixels"]


class SceneFrames:
    """Simulates shards of frames of random contacts on skins of one scene; made once per process.

    Raises:
        BenchError: if pressure changes no conductivity in the scene; if a tip is too small for the mesh.
        jaxeit.model.MotionError: if electrodes are to be misplaced that cannot move.
    """

    def __init__(self, bench: Bench, fidelity: je.Fidelity, basis: je.Pixels, scenes: RandomScenes):
        self.bench, self._scenes = bench, scenes
        self._model = je.discretise(bench.scene, fidelity)
        self._motion = je.model.electrode_motion(self._model) if scenes.misplaced else None
        self._diameter = jnp.asarray(bench.tip_diameter, self._model.dtype)
        if not fx.chosen(self._model.effects, fx.AbstractSheetEffect):
            raise BenchError(UNPRESSED)
        _check_tips(bench, self._model)
        self.pixels = basis.on(self._model)
        self._response = je.pad_response(bench.scene.skin, self._model)
        pads = bench.scene.skin.pads
        self._masks = np.asarray(je.pad_masks(bench.scene.skin, self.pixels).weights) if pads else None

    def simulate(self, number: int, seed: int, frames: int = SHARD_FRAMES) -> Mapping[str, np.ndarray]:
        """The first ``frames`` of a shard by the names of `calib.bench.training.training_frames.ARRAYS`.

        All that is drawn depends on the seed and on the number of the shard alone; contacts do not depend on effects.

        Raises:
            BenchError: if the frames do not depend on the pressure, or a number is not finite.
        """
        touches, skins = (np.random.default_rng([seed, number, purpose]) for purpose in range(2))
        key = jax.random.key(int(skins.integers(2**31)))
        rise = skins.random() * self.bench.duration
        warmth, air = rise * self.bench.temperature_rate, rise * self.bench.barometer_rate
        model = self._drawn_skin(skins)
        contacts = draw_contacts(self._scenes, self.bench.scene.skin.domain, SHARD_FRAMES, touches)
        presses = self._presses(contacts, arrange_tips(contacts), warmth, air)
        recorded = self._recorded(model, presses, frames, key, (warmth, air))
        if bad := [name for name, values in recorded.items() if not np.isfinite(values).all()]:
            raise BenchError(f"shard {number}: {', '.join(bad)} are not finite; check the parameters of the effects")
        drawn = {
            "contacts": contacts.number,
            "contact_place": contacts.place,
            "contact_force": contacts.force,
            "contact_footprint": contacts.footprint,
            "contact_size": contacts.size,
            "contact_angle": contacts.angle,
            "load_spread": np.full(SHARD_FRAMES, _load_spread(model)),
        }
        return recorded | {name: values[:frames] for name, values in drawn.items()}

    def _recorded(
        self,
        model: je.Model,
        presses: tuple[np.ndarray, ...],
        frames: int,
        key: Key[Array, ""],
        air: tuple[float, float],
    ) -> dict[str, np.ndarray]:
        """What a skin reads under presses, as it is recorded, and the forces on it."""
        recordings: list[_Recording] = []
        parts = []
        for start in range(0, frames, CHUNK_FRAMES):
            chunk = Press(*(jnp.asarray(_with_first(values, start)) for values in presses))
            solved = solve_presses(model, self.pixels, self._response, self._diameter, chunk, key)
            voltages, pressures, maps = (np.asarray(values, float) for values in solved)
            if not recordings:
                _check_response(voltages, maps)
                kinds = ((fx.StreamKind.EIT, voltages[0]), (fx.StreamKind.PRESSURE, pressures[0]))
                recordings = [_Recording(self.bench, model, kind, resting, key) for kind, resting in kinds]
            streams = zip(recordings, (voltages, pressures), strict=True)
            parts.append([*(stream.record(values[1:], *air) for stream, values in streams), maps[1:]])
        eit, pads = recordings
        voltages, pressures, maps = (np.concatenate(part)[:frames] for part in zip(*parts, strict=True))
        maps = np.where(maps < LEAST_FORCE, 0, maps)
        found = {"frames": voltages - eit.untouched, "untouched": eit.untouched, "force_map": maps}
        if self._masks is None:
            return found
        felt = {"pressures": pressures - pads.untouched, "untouched_pressures": pads.untouched}
        return found | felt | {"pad_forces": maps @ self._masks.T}

    def _drawn_skin(self, rng: np.random.Generator) -> je.Model:
        """The model of a skin of the scene whose effects have drawn seeds; equal in form to that of any other."""
        effects = tuple(_reseeded(effect, rng) for effect in self.bench.scene.effects)
        model = self._model
        if self._scenes.strength != (1.0, 1.0):
            effects = tuple(_of_strength(effect, self._scenes.strength, rng) for effect in effects)
        if self._motion is not None:
            shift = rng.normal(scale=self._scenes.misplaced, size=(model.electrodes, 2))
            model = je.model.moved(model, self._motion, shift)
        return dataclasses.replace(model, effects=_laid(effects, self._model.centroids))

    def _presses(self, contacts: DrawnContacts, tips: Tips, warmth: float, air: float) -> tuple[np.ndarray, ...]:
        """The fields of `Press`, first of the untouched skin, on the host: a slice of them compiles nothing."""
        dtype, even = self._model.dtype, np.ones(SHARD_FRAMES)
        drawn = (
            *(values.astype(dtype) for values in (contacts.force, tips.place)),
            tips.contact.astype(np.int32),
            tips.share.astype(dtype),
            *(contacts.hold, contacts.peak, warmth * even, air * even, np.arange(1, SHARD_FRAMES + 1, dtype=np.int32)),
        )
        untouched = [np.zeros_like(values[:1]) for values in drawn]
        untouched[Press._fields.index("hold")] += 1
        return tuple(np.concatenate(pair) for pair in zip(untouched, drawn, strict=True))


def _with_first(values: np.ndarray, start: int) -> np.ndarray:
    """The first row, and those of a chunk of frames, of a field of `Press`."""
    return np.concatenate([values[:1], values[start + 1 : start + 1 + CHUNK_FRAMES]])


@je.verb
def _laid(
    effects: tuple[fx.AbstractEffect, ...], centroids: Float[Array, "elements 2"]
) -> tuple[fx.AbstractEffect, ...]:
    return fx.laid(effects, centroids)


@je.verb
def solve_presses(
    model: je.Model,
    pixels: je.model.BasisMap,
    response: Float[Array, "pads elements"],
    diameter: Float[Array, ""],
    presses: Press,
    key: Key[Array, ""],
) -> SolvedFrames:
    """Voltages, pressures in the pads, and force maps of some presses, before the electronics; ``key`` of chance."""
    memory = fx.chosen(model.effects, fx.AbstractMemoryEffect)
    pneumatic = fx.chosen(model.effects, fx.AbstractPneumaticEffect)

    def one(press: Press) -> SolvedFrames:
        own = jax.random.fold_in(key, press.number)
        spread = jax.vmap(lambda place: je.model.load_spread(model, place, diameter))(press.place)
        pressure = (press.load[press.contact] * press.share) @ spread
        felt = pressure
        if memory:
            load = _held(memory, press.load, press, jax.random.fold_in(own, 0)).astype(model.dtype)
            felt = (load[press.contact] * press.share) @ spread
        voltages = je.forward(model, je.conductivity(model, felt, press.warmth.astype(model.dtype)))
        pads = response @ pressure
        pads = _held(pneumatic, pads, press, jax.random.fold_in(own, 1)).astype(model.dtype) if pneumatic else pads
        return SolvedFrames(voltages, pads, pixels.restrict(pressure * model.areas))

    found: SolvedFrames = jax.vmap(one)(presses)
    return found


def _held(
    effects: tuple[fx.AbstractHistoryEffect, ...],
    load: Float[Array, " channels"],
    press: Press,
    key: Key[Array, ""],
) -> Float[Array, " channels"]:
    """What effects with memory make of a load at the end of its hold."""
    up, hold = jnp.arange(1, HOLD_STEPS // 2 + 1) / (HOLD_STEPS // 2), jnp.ones(HOLD_STEPS)
    share = jnp.concatenate([up * press.peak, press.peak + up * (1 - press.peak), hold])
    series = share[:, None] * load.astype(share.dtype)
    whole = partial(jnp.full, len(share))
    line = fx.HistoryInputs(key, press.hold / HOLD_STEPS, whole(press.warmth), whole(press.air), jnp.zeros((0, 4), int))
    after, _ = fx.history(effects, series, fx.history_start(effects, jnp.zeros_like(series[0])), line)
    last: Array = after[-1]
    return last


class _Recording:
    """One stream of a shard through its electronics: first the untouched skin, whose mean is `untouched`."""

    def __init__(
        self,
        bench: Bench,
        model: je.Model,
        kind: fx.StreamKind,
        resting: Float[np.ndarray, " channels"],
        key: Key[Array, ""],
    ):
        self._effects = fx.chosen(model.effects, fx.AbstractReadoutEffect, kind)
        self._key = jax.random.fold_in(key, SHARD_FRAMES + 1 + (kind is fx.StreamKind.EIT))  # beyond those of frames
        pattern = jnp.asarray(bench.scene.skin.protocol.pairs, jnp.int32)
        self._pattern = pattern if kind is fx.StreamKind.EIT else pattern[:0]
        self._interval, self._blocks = jnp.asarray(1 / bench.eit_rate), 0
        self._state = fx.history_start(self._effects, jnp.asarray(resting))
        self.untouched = self.record(np.tile(resting, (CHUNK_FRAMES, 1)), 0.0, 0.0).mean(0)

    def record(
        self, rows: Float[np.ndarray, "rows channels"], warmth: float, air: float
    ) -> Float[np.ndarray, "rows channels"]:
        """The next block of samples as it is recorded, at this temperature (K) and pressure (Pa) of the air."""
        self._blocks += 1
        if not self._effects or not rows.shape[1]:
            return rows
        temperature, pressure = (jnp.full(len(rows), rise) for rise in (warmth, air))
        key = jax.random.fold_in(self._key, self._blocks)
        line = fx.HistoryInputs(key, self._interval, temperature, pressure, self._pattern)
        recorded, self._state = history(self._effects, jnp.asarray(rows), self._state, line)
        rows = np.asarray(recorded)
        return rows


def _reseeded(effect: fx.AbstractEffect, rng: np.random.Generator) -> fx.AbstractEffect:
    """The effect with a drawn seed, if it has one."""
    if not any(field.name == "seed" for field in dataclasses.fields(effect)):
        return effect
    changes: Any = {"seed": jnp.asarray(int(rng.integers(2**31)))}
    return dataclasses.replace(effect, **changes)


def _of_strength(
    effect: fx.AbstractEffect, factors: tuple[float, float], rng: np.random.Generator
) -> fx.AbstractEffect:
    """The effect with each of its `STRENGTHS` times a drawn factor."""
    low, high = np.log(factors)
    names = [field.name for field in dataclasses.fields(effect) if field.name in STRENGTHS]
    changes: Any = {name: getattr(effect, name) * float(np.exp(rng.uniform(low, high))) for name in names}
    return dataclasses.replace(effect, **changes)


def _load_spread(model: je.Model) -> float:
    """Standard deviation of the Gaussian that the pad makes of each tip, m; 0: flat tips."""
    found = [effect.width for effect in model.effects if isinstance(effect, fx.LoadSpreading)]
    return float(found[0]) if found else 0.0


def _check_response(voltages: Float[np.ndarray, "n readings"], maps: Float[np.ndarray, "n pixels"]) -> None:
    if maps.any() and not np.ptp(voltages, axis=0).any():
        raise BenchError(UNPRESSED)


def _check_tips(bench: Bench, model: je.Model) -> None:
    """A tip presses on the elements whose centroids are under it, which must be enough of them."""
    domain = bench.scene.skin.domain
    places = grid(bench.scene.skin, 9, 9)
    inner = places[domain.boundary_distance(places) > bench.tip_diameter]
    for place, share in zip(inner, force_shares(model, domain, inner, bench.tip_diameter), strict=True):
        if abs(share - 1) > MAX_TIP_ERROR:
            raise BenchError(
                f"a tip of {bench.tip_diameter:g} m bears {share:.0%} of its force at {place} m on this mesh; take a "
                "finer fidelity or a larger tip, or spread the load wider, as LoadSpreading does"
            )
