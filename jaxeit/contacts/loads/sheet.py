"""From loads to whitened readings, with sensitivities to the loads and to all unknowns of the sheet.

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
from ...model.forward_model import fields, series_resistance, transfer
from ...model.sensitivity import element_slopes
from ...model.sheet_conductivity import coefficients
from .pressure import Forms, Parameters, elongations, pressure, shape_directions, tilt_directions
from .spreading import Spreading

MAX_MODES = 72  # of the gain, those that change the readings of the loads most; and as many of its texture


class ElementSlopes(NamedTuple):
    """Readings of loads, and their slopes in the conductivity of elements.

    | meaning                                                                  | shape  |
    |--------------------------------------------------------------------------|--------|
    | value: whitened readings                                                 | (r,)   |
    | elements: whose conductivity changes most with the loads                 | (e,)   |
    | by_element: slopes of the pair sums in the conductivity of these         | (e, k) |
    """

    value: Float[Array, " r"]
    elements: Int[Array, " e"]
    by_element: Float[Array, "e k"]


class Sensitivities(NamedTuple):
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
    | untouched_coat_slopes: of the whitened readings in these without loads | (r, c)          |       |
    | shape: standard deviation of the moments of a load's shape            | ()               | 1     |
    | spreading: of loads on their way to the sheet                         |                  |       |
    | element_count: number of elements that loads change                   |                  |       |
    | known_gain: None: its modes have a deviation of one, and mean zero    |                  |       |
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
    untouched_coat_slopes: Float[Array, "r c"]
    shape: Float[Array, ""]
    law: ContactPiezoresistance
    spreading: Spreading
    element_count: int = eqx.field(static=True)
    known_gain: KnownGain | None = None

    def response(self, loads: Parameters, forms: Forms) -> Float[Array, " r"]:
        """Whitened readings of loads."""
        z = transfer(self.model, coefficients(self.model, self._conductivity(loads, forms)))
        return self.whiten(z) - self.untouched

    def linearise(self, loads: Parameters, forms: Forms) -> ElementSlopes:
        """Readings, and their slopes in the conductivity of the elements that changes of the loads change most."""
        sigma = self._conductivity(loads, forms)
        elements = self._changed_elements(loads, forms)
        theta = coefficients(self.model, sigma)
        x = fields(self.model, theta)
        z = x.terminal + jnp.diag(series_resistance(self.model.system, theta))
        slopes = element_slopes(self.model, theta, x.potential, elements, self.pairs)
        return ElementSlopes(self.whiten(z) - self.untouched, elements, slopes)

    def slopes(self, at: ElementSlopes, loads: Parameters, forms: Forms) -> Float[Array, "r m"]:
        """Slopes of the readings in all parameters of the loads."""
        by_loads = jax.jacfwd(lambda loads: self._conductivity(loads, forms, at.elements))(loads)
        return self._reading_changes(at, by_loads.reshape(len(at.elements), -1))

    def sensitivities(self, loads: Parameters, forms: Forms) -> Sensitivities:
        """Slopes of the readings in gain, coat and shapes of loads, and in the loads themselves."""
        at = self.linearise(loads, forms)
        points = self.points[at.elements]
        factor = self._gain_factor(at.elements)
        effective = pressure(loads, forms, points, self.spreading) * factor
        slope = jax.jvp(self.law.factor, (effective,), (jnp.ones_like(effective),))[1]
        by_pressure = self.sigma[at.elements, None] * slope * self.weights
        by_gain, by_pressure = jnp.sum(by_pressure * effective, 1), by_pressure * factor
        gain, strongest = _strongest_modes(by_gain, self.gain[at.elements])
        if self.known_gain is not None:
            gain = gain @ lapack.cholesky(self.known_gain.covariance[jnp.ix_(strongest, strongest)], lower=True)
        gain = jnp.concatenate([gain, _strongest_modes(by_gain, self.texture[at.elements])[0]], 1)
        shapes, tilts = shape_directions(loads, forms, points), tilt_directions(loads, forms, points)
        moments = jnp.concatenate([self.shape * shapes, self.shape * tilts, elongations(loads[0], points)], -1)
        by_shape = jnp.einsum("eq,eqd->ed", by_pressure, moments)
        changes = self._reading_changes(
            at, jnp.concatenate([gain, by_shape, self._law_slopes(at.elements, effective)], 1)
        )
        ends = np.cumsum([gain.shape[1], shapes.shape[-1], tilts.shape[-1], 2])
        _, by_shapes, by_tilts, elongation, by_law = jnp.split(changes, ends, 1)
        nuisances = changes[:, : ends[1]]
        if self.coat.shape[1]:
            by_coat = self.coat_slopes(self._conductivity(loads, forms)) - self.untouched_coat_slopes
            nuisances = jnp.concatenate([nuisances, by_coat], 1)
        return Sensitivities(
            at.value, nuisances, by_shapes, by_tilts, self.slopes(at, loads, forms), elongation, by_law
        )

    def coat_slopes(self, sigma: Float[Array, " elements"]) -> Float[Array, "r c"]:
        """Slopes of the readings of a sheet in its log conductivity."""
        theta = coefficients(self.model, sigma)
        every = jnp.arange(len(sigma))
        slopes = element_slopes(self.model, theta, fields(self.model, theta).potential, every, self.pairs)
        found: Array = self.factor @ (slopes.T @ (sigma[:, None] * self.coat))
        return found

    def whiten(self, z: Float[Array, "a a"]) -> Float[Array, " r"]:
        """Whitened readings of a transfer matrix."""
        return self.factor @ z[self.pairs[:, 0], self.pairs[:, 1]]

    def _conductivity(
        self, loads: Parameters, forms: Forms, elements: Int[Array, " e"] | slice = slice(None)
    ) -> Float[Array, " e"]:
        """Conductivity of elements under loads, S."""
        spread = pressure(loads, forms, self.points[elements], self.spreading)
        effective = spread * self._gain_factor(elements)
        return self.sigma[elements] * (self.law.factor(effective) @ self.weights)

    def _changed_elements(self, loads: Parameters, forms: Forms) -> Int[Array, " e"]:
        """Elements that a change of some load's force changes most, relative to the most changed one.

        Those that are most changed would be the wrong ones: a strong load saturates its middle, where another force is
        not felt, and would leave none to a weaker one.
        """
        by_force = jax.jacfwd(lambda force: self._conductivity(loads.at[:, 3].set(force), forms) / self.sigma)(
            loads[:, 3]
        )
        largest = jnp.maximum(jnp.max(by_force, 0), jnp.finfo(by_force.dtype).tiny)
        elements: Int[Array, " e"] = jax.lax.top_k(jnp.max(by_force / largest, 1), self.element_count)[1]
        return elements

    def _law_slopes(self, elements: Int[Array, " e"], pressure: Float[Array, "e q"]) -> Float[Array, "e 3"]:
        """Slopes of the conductivity of elements in the logs of the parameters of the law."""
        slopes = jax.jacfwd(lambda logs: scaled_law(self.law, logs).factor(pressure) @ self.weights)
        found: Array = self.sigma[elements, None] * slopes(jnp.zeros(3, self.sigma.dtype))
        return found

    def _gain_factor(self, elements: Int[Array, " e"] | slice) -> Float[Array, "e 1"] | float:
        """Factor of the pressure on elements: the mean gain, where it is known."""
        return 1.0 if self.known_gain is None else self.known_gain.factor[elements, None]

    def _reading_changes(self, at: ElementSlopes, change: Float[Array, "e d"]) -> Float[Array, "r d"]:
        """Changes of the readings by changes of the conductivity of some elements."""
        return self.factor @ (at.by_element.T @ change)


def _strongest_modes(
    by_gain: Float[Array, " e"], modes: Float[Array, "e g"]
) -> tuple[Float[Array, "e m"], Int[Array, " m"]]:
    """Changes of the conductivity by the modes that change it most, and the indices of these."""
    strongest: Int[Array, " m"] = jax.lax.top_k(by_gain @ modes, min(MAX_MODES, modes.shape[1]))[1]
    return by_gain[:, None] * modes[:, strongest], strongest


def scaled_law(law: ContactPiezoresistance, logs: Float[Array, "3"] | Sequence[float]) -> ContactPiezoresistance:
    """A law whose amplitude, half pressure and exponent are those of another times exp of these logs.

    Of logs that are Python's floats, the law stays in whatever precision it is used with.
    """
    parts, structure = jax.tree.flatten(law)
    scaled: ContactPiezoresistance = jax.tree.unflatten(
        structure, [part * jnp.exp(log) for part, log in zip(parts, logs, strict=True)]
    )
    return scaled
