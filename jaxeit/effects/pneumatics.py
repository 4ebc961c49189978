"""Pneumatics: from the pressure on a pad to the pressure in it.

The gas in a pad and the structure around it share the load.  The history effects start from the series of an
ideal pad: isothermal, in equilibrium, linear and sealed.  Each effect takes all that the other effects describe
as ideal.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Int

from .base import AbstractPadEffect, AbstractPneumaticEffect, metres, parameter, require_relation
from .quantities import HistoryInputs, Series, State
from .random import own_normal


class PadEdgeDip(AbstractPadEffect):
    """A pad is stiff near its walls: the response falls by ``d exp(-distance / w)``.

    | meaning                     | default | range    | unit | source                         |
    |-----------------------------|---------|----------|------|--------------------------------|
    | depth d at the outline      | 0.4     | 0 to 0.9 | 1    | chosen: gives the paper's 0.14 |
    | width w of the stiff border | 10      | 2 to 30  | mm   | chosen: gives the paper's 0.14 |
    """

    depth: Float[Array, ""] = parameter(0.4, most=1.0)
    width: Float[Array, ""] = metres(10e-3, above=0.0)

    def __call__(
        self, response: Float[Array, "pads elements"], distance: Float[Array, "pads elements"]
    ) -> Float[Array, "pads elements"]:
        return response * (1 - self.depth * jnp.exp(-distance / self.width))


class PadCrosstalk(AbstractPneumaticEffect):
    """Pads share walls: each feels its own pressure and a fraction of the mean of the other pads' pressures.

    A series does not state which pads are neighbours, so all other pads count alike, nearly true in a 2 x 2 square.

    | meaning                         | default | range    | unit | source     |
    |---------------------------------|---------|----------|------|------------|
    | fraction of the others' mean    | 0.02    | 0 to 0.1 | 1    | assumption |
    """

    rank: ClassVar[int] = -4  # acts on the load, before everything in the pad

    fraction: Float[Array, ""] = parameter(0.02, most=1.0)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        others = (series.sum(1, keepdims=True) - series) / max(series.shape[1] - 1, 1)
        return series + self.fraction * others, state


class TpuRelaxation(AbstractPneumaticEffect):
    """The structure relaxes under load, and the gas carries more of it: the pressure rises while a press is held.

    The structure's stiffness falls as ``E(t) / E(0) = 1 - sum_i g_i (1 - exp(-t / tau_i))``: a Prony series, or
    Maxwell elements in parallel.  With s the gas's share of a constant load, p the ideal pressure and P that of
    the gas, ``p = P + (1 - s) sum_i g_i / (1 - sum g) h_i``, ``h_i' = P' - h_i / tau_i``: solved sample by sample,
    exactly if P is linear between samples.

    | meaning                                     | default          | range         | unit | source          |
    |---------------------------------------------|------------------|---------------|------|-----------------|
    | shares g_i of the stiffness at first        | 0.10, 0.08, 0.07 | sum below 1   | 1    | assumption      |
    | times tau_i                                 | 0.1, 1, 10       | 0.01 to 1000  | s    | assumption      |
    | gas_share s of a lasting load               | 0.5              | 0 to 1        | 1    | assumption      |
    """

    rank: ClassVar[int] = -3

    shares: Float[Array, " elements"] = parameter((0.10, 0.08, 0.07))
    times: Float[Array, " elements"] = parameter((0.1, 1.0, 10.0), finite=False)
    gas_share: Float[Array, ""] = parameter(0.5, most=1.0)

    def __check_init__(self) -> None:
        require_relation(self, ("shares", "times"), _is_series, "as many shares as times, with a sum below 1")

    def start(self, first: Float[Array, " channels"]) -> State:
        return first, jnp.zeros((self.times.size, first.size), first.dtype)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        excess = (1 - self.gas_share) * self.shares / (1 - self.shares.sum())
        weight = excess.astype(series.dtype)[:, None]
        keep, gain = (part[:, None] for part in _relaxation(inputs.interval, self.times, series.dtype))

        def step(state: tuple[Array, Array], ideal: Array) -> tuple[tuple[Array, Array], Array]:
            before, h = state
            left = ideal - (weight * (keep * h - gain * before)).sum(0)
            now = left / (1 + (weight * gain).sum())
            return (now, keep * h + gain * (now - before)), now

        after, out = jax.lax.scan(step, state, series)
        return out, after


class GasLaw(AbstractPneumaticEffect):
    """The gas stiffens under compression: ``(P0 + P)(V0 - dV) = P0 V0``, at constant temperature.

    The structure yields by its compliance C under the load that the gas does not carry, so that the gas's share of a
    small load is ``s = C / (C + V0 / P0)`` and the ideal pressure p makes a compression ``y = dV / V0`` with
    ``p / P0 = s y / (1 - y) + (1 - s) y``.  Its smaller root gives ``P = P0 y / (1 - y)``, which is p for small p,
    and for every p if the gas carries the whole load.  `GasRelaxation` describes the time until temperatures are equal.

    | meaning                               | default | range       | unit   | source                       |
    |---------------------------------------|---------|-------------|--------|------------------------------|
    | volume V0                             | 70      | 20 to 200   | cm3    | assumption                   |
    | compliance C of the structure         | 7e-10   | 0 to inf    | m3/Pa  | assumption: a share s of 0.5 |
    | pressure P0 around the pad            | 101.325 | 60 to 110   | kPa    | standard atmosphere          |
    """

    rank: ClassVar[int] = -2

    volume: Float[Array, ""] = parameter(70e-6, above=0.0)
    compliance: Float[Array, ""] = parameter(7e-10, finite=False)
    pressure: Float[Array, ""] = parameter(101325.0, above=0.0)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        structure = 1 / (1 + self.compliance * self.pressure / self.volume)
        q = series / self.pressure
        y = 2 * q / (1 + q + jnp.sqrt((1 + q) ** 2 - 4 * structure * q))
        return self.pressure * y / (1 - y), state


class GasRelaxation(AbstractPneumaticEffect):
    """A fast compression warms the gas, which then cools to its walls: adiabatic at first, isothermal finally.

    With s the gas's share of a constant load, p the ideal pressure and P that of the gas, ``P = p + (1 - s) e``,
    where the pressure e from heating follows ``m e' = (gamma - 1) p' - e / tau``, ``m = 1 + s (gamma - 1)``: exactly if
    p is linear between samples.  An imposed volume (s = 0) has gamma times the final pressure at first.

    | meaning                        | default | range     | unit | source                                     |
    |--------------------------------|---------|-----------|------|--------------------------------------------|
    | time tau                       | 0.31    | 0.05 to 2 | s    | h2 / (pi2 alpha): air, a chamber 8 mm high |
    | heat_ratio gamma               | 1.4     | 1 to 1.67 | 1    | air                                        |
    | gas_share s of a lasting load  | 0.5     | 0 to 1    | 1    | assumption                                 |
    """

    rank: ClassVar[int] = -1

    time: Float[Array, ""] = parameter(0.31, finite=False)
    heat_ratio: Float[Array, ""] = parameter(1.4, least=1.0)
    gas_share: Float[Array, ""] = parameter(0.5, most=1.0)

    def start(self, first: Float[Array, " channels"]) -> State:
        return first, jnp.zeros_like(first)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        stiffer = 1 + self.gas_share * (self.heat_ratio - 1)
        warmth, state = _transient(series, state, inputs.interval, stiffer * self.time)
        return series + (1 - self.gas_share) * (self.heat_ratio - 1) / stiffer * warmth, state


class PadTemperature(AbstractPneumaticEffect):
    """Sealed gas gains pressure as it warms, and gage pressure falls as the barometer rises: ``P + k dT - b dP_air``.

    The gas has the temperature of the ambient air.

    | meaning                                         | default | range      | unit | source                        |
    |-------------------------------------------------|---------|------------|------|-------------------------------|
    | sensitivity k                                   | 346     | 0 to 400   | Pa/K | P0 / T0; less if a pad gives  |
    | barometer: share b of a change of air pressure  | 1       | 0 to 1     | 1    | a rigid sealed pad            |
    """

    sensitivity: Float[Array, ""] = parameter(346.0)
    barometer: Float[Array, ""] = parameter(1.0)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        shift = self.sensitivity * inputs.temperature - self.barometer * inputs.barometer
        return series + shift.astype(series.dtype)[:, None], state


class PadLeak(AbstractPneumaticEffect):
    """A pad leaks: ``P' = p' - P / tau``, solved exactly if p is linear between samples.

    Pressure from temperature and barometer leaks away as well.

    | meaning   | default | range     | unit | source     |
    |-----------|---------|-----------|------|------------|
    | time tau  | 300     | 30 to inf | s    | assumption |
    """

    rank: ClassVar[int] = 1

    time: Float[Array, ""] = parameter(300.0, finite=False)

    def start(self, first: Float[Array, " channels"]) -> State:
        return first, first

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return _transient(series, state, inputs.interval, self.time)


class SensorError(AbstractPneumaticEffect):
    """The sensor of each pad has an offset and an error of its span: ``a + (1 + b) P``, both normal and constant.

    | meaning                              | default | range        | unit | source                               |
    |--------------------------------------|---------|--------------|------|--------------------------------------|
    | offset: std of a                     | 86      | 0 to 345     | Pa   | HSC: 0.25 % of 34,474 Pa; 1 % in all |
    | span: std of b                       | 0.0025  | 0 to 0.01    | 1    | HSC: 0.25 %; 1 % in all              |
    | seed of the sensors                  | 0       |              |      |                                      |
    """

    rank: ClassVar[int] = 2

    offset: Float[Array, ""] = parameter(86.0)
    span: Float[Array, ""] = parameter(0.0025)
    seed: Int[Array, ""] = parameter(0)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        a, b = own_normal(self, self.seed, (2, series.shape[1]), series.dtype)
        return self.offset * a + (1 + self.span * b) * series, state


def _is_series(shares: np.ndarray, times: np.ndarray) -> bool:
    """Whether there is a structure with these Maxwell elements that carries a lasting load."""
    return shares.ndim == 1 and shares.shape == times.shape and bool(shares.sum() < 1)


def _relaxation(
    interval: Float[Array, ""], time: Float[Array, "*times"], dtype: DTypeLike
) -> tuple[Float[Array, "*times"], Float[Array, "*times"]]:
    """Factors of ``h' = x' - h / time`` over an interval in which x is linear: the part of h that is kept, and the
    gain of h per change of x."""
    steps = interval / time  # zero for an infinite time constant
    gain = jnp.where(steps > 0, -jnp.expm1(-steps) / jnp.where(steps > 0, steps, 1), 1)
    return jnp.exp(-steps).astype(dtype), gain.astype(dtype)


def _transient(
    series: Series, state: tuple[Array, Array], interval: Float[Array, ""], time: Float[Array, ""]
) -> tuple[Series, tuple[Array, Array]]:
    """The decaying changes h of a series, ``h' = series' - h / time``; the state is (last sample, h)."""
    keep, gain = _relaxation(interval, time, series.dtype)

    def step(state: tuple[Array, Array], now: Array) -> tuple[tuple[Array, Array], Array]:
        before, h = state
        h = keep * h + gain * (now - before)
        return (now, h), h

    after, out = jax.lax.scan(step, state, series)
    return out, after
