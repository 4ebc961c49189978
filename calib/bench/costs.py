"""Measure what each part of the simulation of a scene costs in time, stage by stage, on this machine."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit import effects as fx

from .bench import Bench
from .motion import loads_at
from .streams import SimulatedEit, SimulatedStreams, history, simulated_streams

STAGES = ("mechanics", "material", "electrical", "pneumatics", "readout")


@dataclass(frozen=True)
class PartCost:
    """Cost of one part of a simulation: its stage, its name, number of runs in the session, and seconds per run."""

    stage: str
    name: str
    runs: int
    seconds: float

    @property
    def total(self) -> float:
        """Time in s over the whole session."""
        return self.runs * self.seconds


def measure_costs(bench: Bench, fidelity: je.Fidelity | None = None) -> tuple[PartCost, ...]:
    """Measure each part of the simulation of a scene separately, without compilation; in order of stages.

    Example:
        costs = calib.bench.measure_costs(short, je.Fidelity.draft())
        print(calib.bench.render_costs(short, costs))  # what `jaxeit simulate --explain` prints
    """
    made = simulated_streams(bench, je.Fidelity(edge_length=0.02) if fidelity is None else fidelity)
    parts = [*_session_costs(made), *_solve_costs(made), *_block_costs(made)]
    return tuple(sorted(parts, key=lambda part: STAGES.index(part.stage)))


def render_costs(bench: Bench, parts: tuple[PartCost, ...]) -> str:
    """The table that `jaxeit simulate --explain` prints."""
    whole = sum(part.total for part in parts)
    width = max(len(part.name) for part in parts)
    lines = [f"{'stage':10}  {'effect':{width}}  share of the time", "-" * (30 + width)]
    before = ""
    for part in parts:
        stage = part.stage if part.stage != before else ""
        lines.append(f"{stage:10}  {part.name:{width}}  {100 * part.total / whole:5.1f} %")
        before = part.stage
    lines.append(f"{'':10}  {'':{width}}  of {whole:.3g} s for {bench.duration:.0f} s of recording")
    return "\n".join(lines)


def _session_costs(made: SimulatedStreams) -> Iterator[PartCost]:
    """Costs of the parts that run once per session."""
    motion, model, key = made.motion, made.eit.model, jax.random.key(0)
    path = fx.Path(jnp.asarray(motion.places[:, 0]), jnp.asarray(motion.start), jnp.asarray(motion.pace))
    for effect in fx.chosen(model.effects, fx.AbstractStageEffect):
        yield _part_cost(effect, 1, effect, path, key)
    response = jnp.ones((len(made.bench.scene.skin.pads), model.background.size), model.dtype)
    for effect in fx.chosen(model.effects, fx.AbstractPadEffect):
        yield _part_cost(effect, 1, effect, response, response)
    when = jnp.zeros(model.readings)
    for effect in fx.chosen(model.effects, fx.AbstractScanEffect):
        yield _part_cost(effect, 1, effect, when, when)


def _solve_costs(made: SimulatedStreams) -> Iterator[PartCost]:
    """Costs of the parts that run once per solve."""
    model, solves = made.eit.model, made.eit.solves_expected()
    effects, contacts = model.effects, made.motion.forces.shape[1]
    place, tip = jnp.asarray(made.motion.places[0, 0], model.dtype), jnp.asarray(made.bench.tip_diameter, model.dtype)
    spread = je.model.load_spread(model, place, tip)
    load = jnp.asarray(made.motion.forces[0, 0], model.dtype)
    sheet = fx.Sheet(model.background, load * spread, model.centroids, jnp.sqrt(model.areas), jnp.zeros_like(load))
    for effect in fx.chosen(effects, fx.AbstractLoadEffect):
        yield _part_cost(effect, solves * contacts, effect, spread, fx.Indenter(place, tip), model.centroids)
    for effect in fx.chosen(effects, fx.AbstractSheetEffect):
        yield _part_cost(effect, solves, effect, sheet)
    bare = eqx.tree_at(lambda m: m.effects, model, (), is_leaf=lambda x: x is model.effects)
    pressed = je.conductivity(model, sheet.pressure)  # two sheets if the skin has a metal coating
    yield PartCost("electrical", "the sheet itself", solves, _run_seconds(je.forward, bare, pressed))
    for effect in fx.chosen(effects, fx.AbstractContactEffect):
        yield _part_cost(effect, solves, effect, model.contact)
    circuit = fx.Circuit(jnp.ones((model.electrodes,) * 2, model.dtype), model.pattern, model.current)
    for effect in fx.chosen(effects, fx.AbstractTerminalEffect):
        yield _part_cost(effect, solves, effect, jnp.asarray(made.eit.resting), circuit)


def _block_costs(made: SimulatedStreams) -> Iterator[PartCost]:
    """Costs of the parts that run once per block of samples."""
    for name, recording in made:
        times = recording.times(0)
        line, rest = recording.line(0, 0), jnp.asarray(recording.resting)
        loads = jnp.asarray(loads_at(made.motion, times).load)
        series = jnp.tile(rest, (len(times), 1))
        families: tuple[tuple[type, Any], ...] = ((fx.AbstractReadoutEffect, series),)
        if name == "eit":
            families = ((fx.AbstractMemoryEffect, loads), *families)
            yield PartCost(
                "readout", "frames between the solved ones", recording.blocks, _interpolation_seconds(made.eit)
            )
        if name == "pressure":
            families = ((fx.AbstractPneumaticEffect, series), *families)
        for family, values in families:
            stream = recording.kind if family is fx.AbstractReadoutEffect else None
            for effect in fx.chosen(made.bench.scene.effects, family, stream):
                state = fx.history_start((effect,), values[0])
                yield _part_cost(effect, recording.blocks, history, (effect,), values, state, line)
        packets = fx.Packets(jnp.asarray(times), jnp.asarray(times), jnp.zeros(len(times), bool))
        for effect in fx.chosen(made.bench.scene.effects, fx.AbstractClockEffect, recording.kind):
            yield _part_cost(effect, recording.blocks, effect, packets, line.key)


def _interpolation_seconds(eit: SimulatedEit) -> float:
    """Time in s to evaluate the polynomials of a block; their solves are counted separately."""
    state = eit.start()
    eit.block(0, state)
    start = time.perf_counter()
    eit.quantity(0, eit.times(0), state[0])
    return time.perf_counter() - start


def _part_cost(effect: fx.AbstractEffect, runs: int, function: Callable[..., Any], *arguments: Any) -> PartCost:
    stream = getattr(effect, "stream", None)
    name = type(effect).__name__ + (f" ({stream.value})" if stream else "")
    return PartCost(effect.stage, name, runs, _run_seconds(function, *arguments))


def _run_seconds(function: Callable[..., Any], *arguments: Any, repeats: int = 5) -> float:
    """Median time in s of some runs; the first run compiles and is not counted."""
    compiled = function if function in (je.forward, history) else eqx.filter_jit(function)
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:]))
