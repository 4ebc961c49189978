"""How what covers the sheet spreads a load: the pressure of a point load as a sum of Gaussians.

A load Q on an elastic half-space gives ``3 Q z^3 / (2 pi (r^2 + z^2)^(5/2))`` at depth z and distance r (Boussinesq
1885). This is Student's distribution of three degrees of freedom, a scale mixture of Gaussians, and four of them come
near it. So a Gaussian or an edge that is spread this way is a sum of wider ones, in closed form as before.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

# Standard deviations, over the depth, and shares of the Gaussians that stand for the pressure of a point load. They are
# fitted to it by least squares over the sheet, and differ from it by 0.8 % of the load.
DEVIATIONS = (0.34448759, 0.54881109, 0.94870602, 2.04799112)
SHARES = (0.13106788, 0.45236645, 0.33212127, 0.0844444)
# Standard deviation, over the depth, of the single Gaussian that comes nearest.
CORE_DEVIATION = 0.62141334
# Variance of the narrowest tip, over that of the single Gaussian: towards it the width of a load loses its effect.
NARROWEST = 0.1


class Spreading(eqx.Module):
    """Gaussians that a point load becomes on the sheet.

    The width of a load is that on the sheet: of the single Gaussian nearest to it. Under a tip of which the variance
    is w^2 the sheet sees ``W^2 = w^2 + core``, and parts of the variances ``w^2 + variances``.

    | meaning                                             | shape | unit |
    |-----------------------------------------------------|-------|------|
    | variances                                           | (n,)  | m^2  |
    | shares: of the load, whose sum is one               | (n,)  | 1    |
    | core: variance of the single Gaussian nearest to it | ()    | m^2  |
    """

    variances: Float[Array, " n"]
    shares: Float[Array, " n"]
    core: Float[Array, ""]

    @classmethod
    def at_depth(cls, depth: float, dtype: DTypeLike) -> "Spreading":
        """That of a sheet at a depth, m, in an elastic half-space; at depth zero loads are Gaussian."""
        deviations, shares = (DEVIATIONS, SHARES) if depth else ((0.0,), (1.0,))
        variances = (depth * np.array(deviations)) ** 2
        scaled = np.array(shares) / math.fsum(shares)
        return cls(*(jnp.asarray(values, dtype) for values in (variances, scaled, (CORE_DEVIATION * depth) ** 2)))

    def parts(self, load: Float[Array, "6"]) -> tuple[Float[Array, "n 6"], Float[Array, " n"]]:
        """The loads, (n, 6), whose sum is a load on the sheet, and the slopes of their log widths in its own, (n,)."""
        square, narrowest = jnp.exp(2 * load[2]), 2 * NARROWEST * self.core
        beyond = square - self.core
        root = jnp.sqrt(beyond**2 + narrowest**2)
        squares = 0.5 * (beyond + root) + self.variances
        rows = jnp.broadcast_to(load, (len(squares), len(load)))
        rows = rows.at[:, 2].set(0.5 * jnp.log(squares)).at[:, 3].add(jnp.log(self.shares))
        return rows, 0.5 * (1 + beyond / root) * square / squares

    def pressure(
        self, kind: Callable[[Array, Array], Array], load: Float[Array, "6"], points: Float[Array, "... 2"]
    ) -> Float[Array, "..."]:
        """Pressure at points, Pa, of a load of some kind (`spot`, `line`) that is spread."""
        return jnp.sum(jax.vmap(kind, (0, None))(self.parts(load)[0], points), 0)
