"""Robust losses, which limit the influence of outliers on a fit.

A least-squares solver gets the residuals transformed to sign(r) w sqrt(rho(r^2 / w^2)), whose squares are the loss, so
that no reweighting loop is needed. `AbstractLoss.curvature` gives the solver the second derivative of the loss for each
residual, relative to that of Gauss and Newton.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxeit.registry import AbstractChoice, Registry, limited


class AbstractLoss(AbstractChoice):
    """A robust loss rho, with rho(s) = s near zero; `width` in units of the residuals' scale."""

    width: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def ratio(self, s: Array) -> Array:
        """rho(s) / s for s >= 0, smooth at zero."""

    def transform(self, r: Array) -> Array:
        """Transformed residuals sign(r) w sqrt(rho(r^2/w^2)); their squares are the loss."""
        w = self.width.astype(r.dtype)
        return r * jnp.sqrt(self.ratio(jnp.minimum((r / w) ** 2, 0.1 * jnp.finfo(r.dtype).max)))

    def psi(self, r: Array) -> Array:
        """Influence of residuals r of any shape: the derivative of half the loss."""
        found: Array = jax.grad(lambda x: jnp.sum(self.transform(x) ** 2) / 2)(r)
        return found

    def dpsi(self, r: Array) -> Array:
        """Derivative of `psi` at residuals r of any shape."""
        found: Array = jax.jvp(self.psi, (r,), (jnp.ones_like(r),))[1]
        return found

    def curvature(self, t: Array) -> Array:
        """`dpsi` over the square of the derivative of t = `transform`(r): Newton's curvature over Gauss-Newton's."""
        return jnp.ones_like(t)


class Squared(AbstractLoss):
    """rho(s) = s: ordinary least squares, on which one outlier has unbounded influence."""

    width: Array = limited(1.0, above=0, converter=jnp.asarray)

    def ratio(self, s: Array) -> Array:
        return jnp.ones_like(s)


class Huber(AbstractLoss):
    """rho(s) = s up to 1, then 2 sqrt(s) - 1. Width 1.345: 95 % efficient on normal noise."""

    width: Array = limited(1.345, above=0, converter=jnp.asarray)

    def ratio(self, s: Array) -> Array:
        far = jnp.maximum(s, 1.0)
        return jnp.where(s <= 1, 1.0, 2 / jnp.sqrt(far) - 1 / far)

    def curvature(self, t: Array) -> Array:
        return jnp.where(jnp.abs(t) <= self.width.astype(t.dtype), 1.0, jnp.zeros_like(t))


class SoftL1(AbstractLoss):
    """rho(s) = 2 (sqrt(1 + s) - 1), a smooth Huber. Width 1.287: 95 % efficient on normal noise."""

    width: Array = limited(1.287, above=0, converter=jnp.asarray)

    def ratio(self, s: Array) -> Array:
        return 2 / (jnp.sqrt(1 + s) + 1)

    def curvature(self, t: Array) -> Array:
        root = 1 + (t / self.width.astype(t.dtype)) ** 2 / 2  # sqrt(1 + s)
        return 2 / (root * (root + 1))


class Cauchy(AbstractLoss):
    """rho(s) = log(1 + s): gross outliers lose all influence. Width 2.385: 95 % efficient on normal noise."""

    width: Array = limited(2.385, above=0, converter=jnp.asarray)

    def ratio(self, s: Array) -> Array:
        small = s < 1e-4
        safe = jnp.where(small, 1.0, s)
        return jnp.where(small, 1 - s / 2 + s**2 / 3, jnp.log1p(safe) / safe)

    def curvature(self, t: Array) -> Array:
        u = (t / self.width.astype(t.dtype)) ** 2  # log(1 + s)
        small = u < 1e-4
        safe = jnp.where(small, 1.0, u)
        return jnp.where(small, 1 - 1.5 * u, (1 - jnp.expm1(safe)) * safe / jnp.expm1(safe))


LOSSES = Registry(AbstractLoss, "loss", "calib.losses")
"""Losses by the names that the command line and recipes use."""
