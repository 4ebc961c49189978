"""Material: from pressure and manufacture to conductivity."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._base import AbstractSheetEffect, Sheet, parameter
from ._fields import gaussian_field


class CoatingNonUniformity(AbstractSheetEffect):
    """A sprayed coat is uneven: ``sigma <- sigma exp(std * field)``, a log-normal random field.

    | meaning                       | default | range    | unit | source     |
    |-------------------------------|---------|----------|------|------------|
    | std of log conductivity       | 0.15    | 0 to 0.4 | 1    | assumption |
    | length of correlation         | 30      | 10 to 60 | mm   | assumption |
    | seed of the sheet             | 0       |          |      |            |
    """

    std: Float[Array, ""] = parameter(0.15)
    length: Float[Array, ""] = parameter(30e-3)
    seed: Int[Array, ""] = parameter(0)

    def __call__(self, sheet: Sheet) -> Sheet:
        field = gaussian_field(self.seed, self.length, sheet.centroids)
        return sheet._replace(sigma=sheet.sigma * jnp.exp(self.std * field))


class ContactGain(AbstractSheetEffect):
    """The protrusions touch unevenly: the pressure that acts is ``p exp(std * field)``.

    | meaning                 | default | range    | unit | source                              |
    |-------------------------|---------|----------|------|-------------------------------------|
    | std of log gain         | 0.12    | 0 to 0.3 | 1    | assumption, chosen like the paper's |
    | length of correlation   | 15      | 5 to 50  | mm   | assumption                          |
    | seed of the outer layer | 0       |          |      |                                     |
    """

    rank: ClassVar[int] = -1  # before the law that turns pressure into conductivity

    std: Float[Array, ""] = parameter(0.12)
    length: Float[Array, ""] = parameter(15e-3)
    seed: Int[Array, ""] = parameter(0)

    def __call__(self, sheet: Sheet) -> Sheet:
        field = gaussian_field(self.seed, self.length, sheet.centroids)
        return sheet._replace(pressure=sheet.pressure * jnp.exp(self.std * field))


class ContactPiezoresistance(AbstractSheetEffect):
    """Pressed together, sheet and metal conduct in parallel: a Hill law of local pressure.

    ``sigma <- sigma (1 + A x / (1 + x))``, ``x = (p / p_half)^n``

    | meaning                             | default | range      | unit | source                    |
    |-------------------------------------|---------|------------|------|---------------------------|
    | amplitude A, the largest change     | 1       | 0 to 1     | 1    | the paper's 100 % cap     |
    | p_half, pressure of half the change | 20      | 1 to 200   | kPa  | assumption                |
    | exponent n                          | 1       | 0.6 to 1.2 | 1    | assumption: many contacts |
    """

    amplitude: Float[Array, ""] = parameter(1.0)
    half_pressure: Float[Array, ""] = parameter(20e3)
    exponent: Float[Array, ""] = parameter(1.0)

    def __call__(self, sheet: Sheet) -> Sheet:
        # The power has an infinite slope at zero pressure for n < 1: keep it off that point.
        touched = sheet.pressure > 0
        ratio = jnp.where(touched, sheet.pressure, self.half_pressure) / self.half_pressure
        x = jnp.where(touched, ratio**self.exponent, 0.0)
        return sheet._replace(sigma=sheet.sigma * (1 + self.amplitude * x / (1 + x)))
