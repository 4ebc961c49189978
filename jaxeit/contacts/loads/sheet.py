"""From loads to whitened readings, with slopes in the loads and in all that is not known about the sheet.

All slopes are those of the readings in the conductivity, which the fields of the electrodes hold (`model.sensitivity`),
times changes of the conductivity. These vanish away from the loads, so that the elements with the largest changes
suffice: a slope that is off by a thousandth slows a fit down and does not move its end.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...effects.material import ContactPiezoresistance
from ...linalg import lapack
from ...model.discretisation import Model
from ...model.forward_model import coefficients, fields, series_resistance, transfer
from ...model.sensitivity import element_slopes
from .pressure import Forms, Parameters, elongations, pressure, shape_directions, tilt_directions

MODES = 72  # of the gain that loads reach, of those on the whole sheet; and as many of its texture


class Linearised(NamedTuple):
    """Readings of loads near some.

    | meaning                                                                  | shape  |
    |--------------------------------------------------------------------------|--------|
    | value: whitened readings                                                 | (r,)   |
    | near: elements whose conductivity changes most with the loads            | (e,)   |
    | by_element: slopes of the pair sums in the conductivity of these         | (e, k) |
    """

    value: Float[Array, " r"]
    near: Int[Array, " e"]
    by_element: Float[Array, "e k"]


class Unknowns(NamedTuple):
    """Whitened readings (r,), and their slopes.

    | meaning: in what the slopes are                                                   | shape    |
    |-----------------------------------------------------------------------------------|----------|
    | nuisances: unknowns of standard deviation one, which fits marginalise             | (r, n)   |
    | shapes: moments of the shapes of loads, which are among these                     | (r, s)   |
    | tilts: further moments of shapes, which are not                                   | (r, t)   |
    | loads: all parameters of all loads                                                | (r, 6 k) |
    | elongation: second moments of the first load                                      | (r, 2)   |
    | law: logs of the parameters of the law of pressure                                | (r, 3)   |
    """

    value: Float[Array, " r"]
    nuisances: Float[Array, "r n"]
    shapes: Float[Array, "r s"]
    tilts: Float[Array, "r t"]
    loads: Float[Array, "r m"]
    elongation: Float[Array, "r 2"]
    law: Float[Array, "r 3"]


class AbstractGain(eqx.Module):
    """What is known of the log gain of the contact layer, from which a fitter is prepared."""

    @abstractmethod
    def distribution(
        self, points: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n g"], Float[np.ndarray, "g g"]]:
        """Mean of the log gain at points (n, 2) m, its modes there, and their covariance under the next press."""


class KnownGain(eqx.Module):
    """What is known of the contact layer's gain before a frame.

    | meaning                                                   | shape       | unit |
    |-----------------------------------------------------------|-------------|------|
    | factor: of the pressure on each element, exp of the mean  | (elements,) | 1    |
    | covariance: of the modes of the log gain                  | (g, g)      | 1    |
    """

    factor: Float[Array, " elements"]
    covariance: Float[Array, "g g"]


class PressedSheet(eqx.Module):
    """The sheet under loads.

    | meaning                                                               | shape            | unit  |
    |-----------------------------------------------------------------------|------------------|-------|
    | sigma: conductivity of the untouched sheet                            | (elements,)      | S     |
    | factor: from pair sums to whitened readings; pairs: of electrodes     | (r, k), (k, 2)   | 1/ohm |
    | untouched: whitened readings without loads                            | (r,)             |       |
    | points of the elements, their weights                                 | (elements, q, 2), (q,) | m |
    | gain: modes of the log gain of the contact layer, at centroids        | (elements, g)    | 1     |
    | texture: further modes of that gain, which are never learned          | (elements, t)    | 1     |
    | coat: modes of the log conductivity that is not known                 | (elements, c)    | 1     |
    | by_coat: slopes of the whitened readings in these without loads       | (r, c)           |       |
    | shape: standard deviation of the moments of a load's shape            | ()               | 1     |
    | known: of the gain; None: its modes have a deviation of one, and mean zero |             |       |
    | reach: number of elements that loads change                           |                  |       |
    """

    model: Model
    sigma: Float[Array, " elements"]
    factor: Float[Array, "r k"]
    pairs: Int[Array, "k 2"]
    untouched: Float[Array, " r"]
    points: Float[Array, "elements q 2"]
    weights: Float[Array, " q"]
    gain: Float[Array, "elements g"]
    texture: Float[Array, "elements t"]
    coat: Float[Array, "elements c"]
    by_coat: Float[Array, "r c"]
    shape: Float[Array, ""]
    law: ContactPiezoresistance
    reach: int = eqx.field(static=True)
    known: KnownGain | None = None

    def response(self, loads: Parameters, forms: Forms) -> Float[Array, " r"]:
        """Whitened readings of loads."""
        z = transfer(self.model, coefficients(self.model, self._pressed(loads, forms)))
        return self.white(z) - self.untouched

    def linearised(self, loads: Parameters, forms: Forms) -> Linearised:
        """Readings, and their slopes in the conductivity of the elements that changes of the loads change most."""
        sigma = self._pressed(loads, forms)
        near = self._near(loads, forms)
        theta = coefficients(self.model, sigma)
        x = fields(self.model, theta)
        z = x.terminal + jnp.diag(series_resistance(self.model.system, theta))
        slopes = element_slopes(self.model, theta, x.potential, near, self.pairs)
        return Linearised(self.white(z) - self.untouched, near, slopes)

    def slopes(self, at: Linearised, loads: Parameters, forms: Forms) -> Float[Array, "r m"]:
        """Slopes of the readings in all parameters of the loads."""
        by_loads = jax.jacfwd(lambda loads: self._pressed(loads, forms, at.near))(loads)
        return self._mixed(at, by_loads.reshape(len(at.near), -1))

    def unknowns(self, loads: Parameters, forms: Forms) -> Unknowns:
        """Slopes of the readings in gain, coat and shapes of loads, and in the loads themselves."""
        at = self.linearised(loads, forms)
        points = self.points[at.near]
        factor = self._factor(at.near)
        here = pressure(loads, forms, points) * factor
        slope = jax.jvp(self.law.factor, (here,), (jnp.ones_like(here),))[1]
        by_pressure = self.sigma[at.near, None] * slope * self.weights
        by_gain, by_pressure = jnp.sum(by_pressure * here, 1), by_pressure * factor
        gain, there = _reached(by_gain, self.gain[at.near])
        if self.known is not None:
            gain = gain @ lapack.cholesky(self.known.covariance[jnp.ix_(there, there)], lower=True)
        gain = jnp.concatenate([gain, _reached(by_gain, self.texture[at.near])[0]], 1)
        shapes, tilts = shape_directions(loads, forms, points), tilt_directions(loads, forms, points)
        bent = jnp.concatenate([self.shape * shapes, self.shape * tilts, elongations(loads[0], points)], -1)
        by_shape = jnp.einsum("eq,eqd->ed", by_pressure, bent)
        mixed = self._mixed(at, jnp.concatenate([gain, by_shape, self._by_law(at.near, here)], 1))
        ends = np.cumsum([gain.shape[1], shapes.shape[-1], tilts.shape[-1], 2])
        _, by_shapes, by_tilts, elongation, by_law = jnp.split(mixed, ends, 1)
        nuisances = mixed[:, : ends[1]]
        if self.coat.shape[1]:
            by_coat = self.coat_slopes(self._pressed(loads, forms)) - self.by_coat
            nuisances = jnp.concatenate([nuisances, by_coat], 1)
        return Unknowns(at.value, nuisances, by_shapes, by_tilts, self.slopes(at, loads, forms), elongation, by_law)

    def coat_slopes(self, sigma: Float[Array, " elements"]) -> Float[Array, "r c"]:
        """Slopes of the readings of a sheet in its log conductivity."""
        theta = coefficients(self.model, sigma)
        every = jnp.arange(len(sigma))
        slopes = element_slopes(self.model, theta, fields(self.model, theta).potential, every, self.pairs)
        found: Array = self.factor @ (slopes.T @ (sigma[:, None] * self.coat))
        return found

    def white(self, z: Float[Array, "a a"]) -> Float[Array, " r"]:
        """Whitened readings of a transfer matrix."""
        return self.factor @ z[self.pairs[:, 0], self.pairs[:, 1]]

    def _pressed(
        self, loads: Parameters, forms: Forms, elements: Int[Array, " e"] | slice = slice(None)
    ) -> Float[Array, " e"]:
        """Conductivity of elements under loads, S."""
        felt = pressure(loads, forms, self.points[elements]) * self._factor(elements)
        return self.sigma[elements] * (self.law.factor(felt) @ self.weights)

    def _near(self, loads: Parameters, forms: Forms) -> Int[Array, " e"]:
        """Elements that a change of some load's force changes most, as parts of the most that it changes any.

        Those that are most changed would be the wrong ones: a strong load saturates its middle, where another force is
        not felt, and would leave none to a weaker one.
        """
        by_force = jax.jacfwd(lambda force: self._pressed(loads.at[:, 3].set(force), forms) / self.sigma)(loads[:, 3])
        most = jnp.maximum(jnp.max(by_force, 0), jnp.finfo(by_force.dtype).tiny)
        near: Int[Array, " e"] = jax.lax.top_k(jnp.max(by_force / most, 1), self.reach)[1]
        return near

    def _by_law(self, near: Int[Array, " e"], pressure: Float[Array, "e q"]) -> Float[Array, "e 3"]:
        """Slopes of the conductivity of elements in the logs of the parameters of the law."""
        slopes = jax.jacfwd(lambda logs: scaled_law(self.law, logs).factor(pressure) @ self.weights)
        found: Array = self.sigma[near, None] * slopes(jnp.zeros(3, self.sigma.dtype))
        return found

    def _factor(self, elements: Int[Array, " e"] | slice) -> Float[Array, "e 1"] | float:
        """Factor of the pressure on elements: the mean gain, where it is known."""
        return 1.0 if self.known is None else self.known.factor[elements, None]

    def _mixed(self, at: Linearised, change: Float[Array, "e d"]) -> Float[Array, "r d"]:
        """What a change of the conductivity near the loads does to the readings."""
        return self.factor @ (at.by_element.T @ change)


def _reached(by_gain: Float[Array, " e"], modes: Float[Array, "e g"]) -> tuple[Float[Array, "e m"], Int[Array, " m"]]:
    """Changes of the conductivity by the modes that change it most, and which ones these are."""
    there: Int[Array, " m"] = jax.lax.top_k(by_gain @ modes, min(MODES, modes.shape[1]))[1]
    return by_gain[:, None] * modes[:, there], there


def scaled_law(law: ContactPiezoresistance, logs: Float[Array, "3"] | Sequence[float]) -> ContactPiezoresistance:
    """A law whose amplitude, half pressure and exponent are those of another times exp of these logs.

    Of logs that are Python's floats, the law stays in whatever precision it is used with.
    """
    parts, structure = jax.tree.flatten(law)
    scaled: ContactPiezoresistance = jax.tree.unflatten(
        structure, [part * jnp.exp(log) for part, log in zip(parts, logs, strict=True)]
    )
    return scaled
