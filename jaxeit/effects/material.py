"""Material: from load, pressure, manufacture and temperature to conductivity."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e, i1e
from jaxtyping import Array, Float, Int

from ..registry import computed
from .base import MOST_STD, AbstractMemoryEffect, AbstractSheetEffect, metres, parameter, require_relation
from .quantities import HistoryInputs, Series, Sheet, State
from .random import own_field

PLAY_OPERATORS = 8
"""Number of play operators, which is the number of steps in which a hysteresis loop opens."""

FRACTION_TERMS = 8
"""Terms of the continued fraction for I2 / I0, enough for rounding error where the fraction is used."""


class CoatingNonUniformity(AbstractSheetEffect):
    """A sprayed coat is uneven: ``sigma <- sigma exp(std * field)``, a log-normal random field.

    | meaning                       | default | range    | unit | source     |
    |-------------------------------|---------|----------|------|------------|
    | std of log conductivity       | 0.15    | 0 to 0.4 | 1    | assumption |
    | length of correlation         | 30      | 10 to 60 | mm   | assumption |
    | seed of the sheet             | 0       |          |      |            |
    """

    std: Float[Array, ""] = parameter(0.15, most=MOST_STD)
    length: Float[Array, ""] = metres(30e-3, above=0.0)
    seed: Int[Array, ""] = parameter(0)
    field: Float[Array, " elements"] | None = computed()  # by `laid`

    def __call__(self, sheet: Sheet) -> Sheet:
        field = self._field(sheet.centroids)
        return sheet._replace(sigma=sheet.sigma * jnp.exp(self.std * field))

    def laid(self, centroids: Float[Array, "elements 2"]) -> "CoatingNonUniformity":
        return dataclasses.replace(self, field=self._field(centroids))

    def _field(self, places: Float[Array, "places 2"]) -> Float[Array, " places"]:
        return own_field(self, self.seed, self.length, places) if self.field is None else self.field


class ContactGain(AbstractSheetEffect):
    """The protrusions touch unevenly: the effective pressure is ``p exp(std * field)``.

    | meaning                 | default | range    | unit | source                              |
    |-------------------------|---------|----------|------|-------------------------------------|
    | std of log gain         | 0.12    | 0 to 0.3 | 1    | assumption, chosen like the paper's |
    | length of correlation   | 15      | 5 to 50  | mm   | assumption                          |
    | seed of the outer layer | 0       |          |      |                                     |
    """

    rank: ClassVar[int] = -1  # before the law that turns pressure into conductivity

    std: Float[Array, ""] = parameter(0.12, most=MOST_STD)
    length: Float[Array, ""] = metres(15e-3, above=0.0)
    seed: Int[Array, ""] = parameter(0)
    field: Float[Array, " elements"] | None = computed()  # by `laid`

    def __call__(self, sheet: Sheet) -> Sheet:
        field = self._field(sheet.centroids)
        return sheet._replace(pressure=sheet.pressure * jnp.exp(self.std * field))

    def laid(self, centroids: Float[Array, "elements 2"]) -> "ContactGain":
        return dataclasses.replace(self, field=self._field(centroids))

    def _field(self, places: Float[Array, "places 2"]) -> Float[Array, " places"]:
        return own_field(self, self.seed, self.length, places) if self.field is None else self.field


class ContactPiezoresistance(AbstractSheetEffect):
    """Sheet and metal in contact conduct in parallel: a Hill law of local pressure.

    ``sigma <- sigma (1 + A x / (1 + x))``, ``x = (p / p_half)^n`` with p the pressure

    | meaning                             | default | range      | unit | source                    |
    |-------------------------------------|---------|------------|------|---------------------------|
    | amplitude A, the largest change     | 1       | 0 to 1     | 1    | the paper's 100 % cap     |
    | half_pressure p_half, of half of it | 20      | 1 to 200   | kPa  | assumption                |
    | exponent n                          | 1       | 0.6 to 1.2 | 1    | assumption: many contacts |
    """

    alternative: ClassVar[str] = "how pressure makes the sheet conduct"

    amplitude: Float[Array, ""] = parameter(1.0)
    half_pressure: Float[Array, ""] = parameter(20e3, above=0.0)
    exponent: Float[Array, ""] = parameter(1.0)

    def __call__(self, sheet: Sheet) -> Sheet:
        return _conducting(sheet, self.factor(sheet.pressure))

    def factor(self, pressure: Float[Array, "..."]) -> Float[Array, "..."]:
        """By what a pressure (Pa) multiplies the conductivity."""
        x = power(pressure / self.half_pressure, self.exponent)
        return 1 + self.amplitude * x / (1 + x)


class HomogenisedIslands(AbstractSheetEffect):
    """Islands of perfect metal shunt the current under pressure; an alternative to `ContactPiezoresistance`.

    Islands of radius a on a share f of the area touch the sheet of resistance R_s with the specific
    resistance ``rho = rho_r (p / p_r)^-n``.  The dipole of one, from the modified Bessel equation
    under it, inserted into Maxwell's mixture formula (1873):

        sigma <- sigma (1 + f b) / (1 - f b),  b = I2(k) / I0(k),  k = a sqrt(R_s / rho),

    whose limit at high pressure is ``(1 + f) / (1 - f)``, or 2 for f = 1/3.  The ratio is within 0.006 of
    that of a resolved square lattice up to f = 1/3.

    | meaning                               | default | range      | unit    | source                   |
    |---------------------------------------|---------|------------|---------|--------------------------|
    | fraction f of islands                 | 1/3     | 0 to 0.5   | 1       | gives the paper's 100 %  |
    | radius a of an island                 | 2       | 0.5 to 5   | mm      | assumption               |
    | contact rho_r at pressure p_r         | 16      | 1 to 1000  | ohm mm2 | assumption               |
    | reference p_r, over the whole area    | 64      |            | kPa     | 20 N on a 20 mm tip      |
    | exponent n                            | 1       | 0.6 to 1.2 | 1       | assumption: many spots   |
    """

    alternative: ClassVar[str] = "how pressure makes the sheet conduct"
    rank: ClassVar[int] = 1  # after the effects on the sheet's own resistance

    fraction: Float[Array, ""] = parameter(1 / 3, most=float(np.pi / 4))  # round islands touch
    radius: Float[Array, ""] = metres(2e-3)
    contact: Float[Array, ""] = parameter(1.6e-5, above=0.0)
    reference: Float[Array, ""] = parameter(64e3, above=0.0)
    exponent: Float[Array, ""] = parameter(1.0)

    def __call__(self, sheet: Sheet) -> Sheet:
        conductance = power(sheet.pressure / self.reference, self.exponent) / self.contact
        b = _island_dipole(self.radius**2 * conductance / sheet.sigma)
        return _conducting(sheet, _mixture(self.fraction * b))


class ProtrusionGrid(AbstractSheetEffect):
    """Only protrusions transmit pressure: squares on a square grid, each with the load of its own cell.

    ``p <- p / f`` on a share of each element, ``f = (side / pitch)^2``.  The share is that of the
    protrusions in a square of the element's area around its centroid, in closed form: 0 or 1 where
    elements resolve the grid, and f where elements are larger than the pitch.  The next law is not
    linear in pressure: it acts on the share, and the result is mixed by the formula of `HomogenisedIslands`.

    The spread of a load within a protrusion and the elements on its border are not resolved; the
    load is conserved on the average over cells.

    | meaning                             | default | range   | unit | source     |
    |-------------------------------------|---------|---------|------|------------|
    | pitch                               | 6       | 2 to 20 | mm   | assumption |
    | side, at most the pitch: all of it  | 3.5     | 1 to 20 | mm   | assumption |
    """

    rank: ClassVar[int] = -1  # before the law that turns pressure into conductivity

    pitch: Float[Array, ""] = metres(6e-3, above=0.0)
    side: Float[Array, ""] = metres(3.5e-3, above=0.0)

    def __check_init__(self) -> None:
        require_relation(self, ("side", "pitch"), lambda side, pitch: bool(side <= pitch), "a side within the pitch")

    def __call__(self, sheet: Sheet) -> Sheet:
        half = sheet.size[:, None] / 2
        inside = self._length(sheet.centroids + half) - self._length(sheet.centroids - half)
        share = jnp.prod(inside / (2 * half), 1)
        return sheet._replace(pressure=sheet.pressure * (self.pitch / self.side) ** 2, share=share)

    def _length(self, x: Float[Array, "elements 2"]) -> Float[Array, "elements 2"]:
        """Length of protrusions between 0 and x along an axis; cells start at 0, protrusions lie in their middle."""
        cells = jnp.floor(x / self.pitch)
        beyond = x - cells * self.pitch - (self.pitch - self.side) / 2
        return cells * self.side + jnp.clip(beyond, 0, self.side)


class SheetTemperature(AbstractSheetEffect):
    """A warmer sheet has more resistance: ``sigma <- sigma / (1 + c T)``, T relative to sigma's measurement.

    | meaning                                 | default | range        | unit | source     |
    |-----------------------------------------|---------|--------------|------|------------|
    | coefficient c of the sheet's resistance | 1e-3    | -5e-4 to 2e-3 | 1/K | assumption |
    """

    coefficient: Float[Array, ""] = parameter(1e-3, least=-0.02, most=0.02)  # 50 K change no sign

    def __call__(self, sheet: Sheet) -> Sheet:
        return sheet._replace(sigma=sheet.sigma / (1 + self.coefficient * sheet.temperature))


class Creep(AbstractMemoryEffect):
    """The effective load of a contact grows with its age: ``load (1 + c log10(1 + age / t0))``.

    Age is the mean time for which the load has been present: added load has age zero, removed load
    has the mean age, and a lifted contact has no age.  After a step this is the logarithmic creep
    of printed force sensors; no effect remains at zero load.

    | meaning                            | default | range      | unit | source                           |
    |------------------------------------|---------|------------|------|----------------------------------|
    | rate c per decade of time          | 0.05    | 0 to 0.1   | 1    | FSR 400 sheet: drift < 5 %       |
    | onset t0                           | 0.1     | 1e-3 to 10 | s    | assumption                       |
    """

    rate: Float[Array, ""] = parameter(0.05)
    onset: Float[Array, ""] = parameter(0.1, above=0.0)

    def start(self, first: Float[Array, " channels"]) -> State:
        return first, jnp.zeros_like(first)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        def older(state: tuple[Array, Array], load: Array) -> tuple[tuple[Array, Array], Array]:
            before, age = state
            grown = load > before
            # the share of the load that was present before
            old = jnp.where(grown, before, 1.0) / jnp.where(grown, load, 1.0)
            age = jnp.where(load > 0, old * (age + inputs.interval.astype(age.dtype)), 0.0)
            return (load, age), age

        state, age = jax.lax.scan(older, state, series)
        return series * (1 + self.rate * jnp.log1p(age / self.onset) / jnp.log(10.0)), state


class Hysteresis(AbstractMemoryEffect):
    """A falling load has more effect than a rising one, at any speed: a Prandtl-Ishlinskii sum.

    The play operators act on the logarithm of the load, so that the loop is a share of the load and
    closes at zero load.  Each has an excess e over the rising branch,

        e_i <- clip(e_i + ln(load before / load), 0, r_i),  felt = load exp(w sum of e_i),

    with evenly spaced ``r_i`` up to ``ln(reach)`` and w such that the operators together open the loop
    by ``loop``.  A rising load has its nominal effect.

    | meaning                                          | default | range     | unit | source              |
    |--------------------------------------------------|---------|-----------|------|---------------------|
    | loop: load felt down over that felt up, less one | 0.1     | 0 to 0.24 | 1    | FSR 400 sheet: 10 % |
    | reach: fall of the load that opens it wholly     | 4       | 2 to 100  | 1    | assumption          |
    """

    loop: Float[Array, ""] = parameter(0.1)
    reach: Float[Array, ""] = parameter(4.0, above=1.0)

    def start(self, first: Float[Array, " channels"]) -> State:
        return _logarithm(first), jnp.zeros((PLAY_OPERATORS, *first.shape), first.dtype)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        widths = jnp.log(self.reach) * jnp.arange(1, PLAY_OPERATORS + 1).astype(series.dtype)[:, None] / PLAY_OPERATORS

        def play(state: tuple[Array, Array], log: Array) -> tuple[tuple[Array, Array], Array]:
            before, excess = state
            excess = jnp.clip(excess + (before - log), 0, widths)
            return (log, excess), jnp.sum(excess, 0)

        state, excess = jax.lax.scan(play, state, _logarithm(series))
        return series * jnp.exp(jnp.log1p(self.loop) * excess / jnp.sum(widths)), state


def _logarithm(load: Float[Array, "..."]) -> Float[Array, "..."]:
    """Logarithm of the load; zero counts as the smallest normal number, to avoid an infinite value."""
    return jnp.log(jnp.maximum(load, jnp.finfo(load.dtype).tiny))


def power(x: Float[Array, "..."], exponent: Float[Array, ""]) -> Float[Array, "..."]:
    """``x^exponent``, and 0 with zero slope without pressure, where a power below one has an infinite slope."""
    touched = x > 0
    return jnp.where(touched, jnp.where(touched, x, 1.0) ** exponent, 0.0)


def _conducting(sheet: Sheet, factor: Float[Array, " elements"]) -> Sheet:
    """The sheet with ``factor`` times the conductivity on its share under pressure."""
    if sheet.share is not None:
        factor = _mixture(sheet.share * (factor - 1) / (factor + 1))
    return sheet._replace(sigma=sheet.sigma * factor)


def _mixture(dipole: Float[Array, " elements"]) -> Float[Array, " elements"]:
    """Conductivity of a plane with inclusions, over that without (Maxwell 1873, in two dimensions), from
    the dipole strength of the inclusions per area: ``share (ratio - 1) / (ratio + 1)`` for homogeneous ones."""
    return (1 + dipole) / (1 - dipole)


def _island_dipole(square: Float[Array, " elements"]) -> Float[Array, " elements"]:
    """``I2(k) / I0(k)`` for k^2: by Gauss's continued fraction where the difference of I0 and I1 cancels."""
    small = square < 1
    quarter = jnp.where(small, square, 0.0) / 4
    tail = jnp.zeros_like(quarter)
    for n in range(FRACTION_TERMS, 1, -1):
        tail = quarter / (n + tail)
    k = jnp.sqrt(jnp.where(small, 1.0, square))
    return jnp.where(small, tail / (1 + tail), 1 - 2 * i1e(k) / (k * i0e(k)))
