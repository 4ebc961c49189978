"""Mechanics: from the stage to the indenter, and from the indenter to the pressure on the sheet."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .base import MOST_STD, AbstractLoadEffect, AbstractStageEffect, metres, parameter
from .quantities import Indenter, Path
from .random import normal

RIM_COSINES = np.cos(np.pi * (np.arange(32) + 0.5) / 32)
"""Cosines of the directions at which the rim is sampled: the error is 3e-6 of the pressure at depth a / 5."""


class StageError(AbstractStageEffect):
    """The stage misses its target places and times: each press has its own errors, normally distributed.

    ``place <- place + position n``, ``delay <- delay + jitter n``, ``pace <- pace exp(ripple n)``

    | meaning                                    | default | range     | unit | source     |
    |--------------------------------------------|---------|-----------|------|------------|
    | position: std of each coordinate           | 0.02    | 0 to 1    | mm   | assumption |
    | jitter: std of when a press starts         | 5       | 0 to 50   | ms   | assumption |
    | ripple: relative std of the speed of ramps | 0.02    | 0 to 0.2  | 1    | assumption |
    """

    position: Float[Array, ""] = metres(0.02e-3)
    jitter: Float[Array, ""] = parameter(5e-3)
    ripple: Float[Array, ""] = parameter(0.02, most=MOST_STD)

    def __call__(self, path: Path, key: Key[Array, ""]) -> Path:
        place, start, speed = jax.random.split(key, 3)
        return path._replace(
            places=path.places + self.position * normal(place, path.places),
            delay=path.delay + self.jitter * normal(start, path.delay),
            pace=path.pace * jnp.exp(self.ripple * normal(speed, path.pace)),
        )


class LoadSpreading(AbstractLoadEffect):
    """The pad spreads the load: the tip's pressure arrives as a Gaussian.

    ``p / load = exp(-r^2 / (2 s^2)) / (2 pi s^2)``, whose integral over the plane is one; the frame
    carries the part outside the sheet, which is lost; the rest is not renormalised.

    | meaning                                                          | default | range   | unit | source          |
    |------------------------------------------------------------------|---------|---------|------|-----------------|
    | width s, tip included; half-space under a 20 mm tip: 7 to 10 mm  | 12      | 6 to 20 | mm   | assumption; the |
    |                                                                  |         |         |      | pad is hollow   |
    """

    alternative: ClassVar[str] = "how a load spreads"

    width: Float[Array, ""] = metres(12e-3, above=0.0)

    def __call__(
        self, spread: Float[Array, " elements"], touch: Indenter, centroids: Float[Array, "elements 2"]
    ) -> Float[Array, " elements"]:
        square = jnp.sum((centroids - touch.centre) ** 2, -1)
        return jnp.exp(-0.5 * square / self.width**2) / (2 * jnp.pi * self.width**2)


class IndentationSpreading(AbstractLoadEffect):
    """The sheet lies at a depth in an elastic half-space under the tip; an alternative to `LoadSpreading`.

    A load Q at a point gives ``3 Q z^3 / (2 pi R^5)`` at depth z and distance R (Boussinesq 1885).
    For an even load on a disc of radius a, the divergence theorem gives an integral over the rim alone,

        p / load = 1 / (pi a^2) mean of a (a - r cos t) (R^2 + R z + z^2) / (R^3 (R + z)),
        R^2 = z^2 + a^2 + r^2 - 2 a r cos t, the mean over directions t,

    which is ``(1 - (1 + (a/z)^2)^-1.5) / (pi a^2)`` on the axis and an even pressure at depth 0.  A
    Gaussian fits it with width 7.1, 7.4, 8.5, 10.2 mm at depth 2, 5, 10, 15 mm under a 20 mm tip.
    The load outside the sheet is lost, as in `LoadSpreading`.

    | meaning                            | default | range   | unit | source                        |
    |------------------------------------|---------|---------|------|-------------------------------|
    | depth z of the sheet under the tip | 10      | 0 to 30 | mm   | the paper's pad, taken solid  |
    """

    alternative: ClassVar[str] = "how a load spreads"

    depth: Float[Array, ""] = metres(10e-3)

    def __call__(
        self, spread: Float[Array, " elements"], touch: Indenter, centroids: Float[Array, "elements 2"]
    ) -> Float[Array, " elements"]:
        a, z = touch.diameter / 2, self.depth
        square = jnp.sum((centroids - touch.centre) ** 2, -1)
        off = square > 0  # on the axis the root has no derivative, and that of the pressure is zero
        r = jnp.where(off, jnp.sqrt(jnp.where(off, square, 1.0)), 0.0)[:, None]
        cosine = jnp.asarray(RIM_COSINES, r.dtype)
        rim = a**2 + square[:, None] - 2 * a * r * cosine
        distance = jnp.sqrt(rim + z**2)
        kernel = (distance**2 + distance * z + z**2) / (distance**3 * (distance + z))
        return jnp.mean((1 - r / a * cosine) * kernel, 1) / jnp.pi
