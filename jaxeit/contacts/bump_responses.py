"""Whitened readings of Gaussian bumps, from a table.

A contact multiplies the conductivity by ``1 + a g(r - p; s) / mean(sigma_0)``, g a Gaussian bump of height one and
standard deviation s: pressed together, sheet and metal conduct better in proportion to the coating.  To second order,
and measured against the full forward map, the readings see K contacts as if the sheet had changed by sigma_0 e,

    e = u - c u^2 / (1 + d u),        u = sum_k a_k g_k / mean(sigma_0),   c = 0.8,  d = 0.7,

through the linear response (the field inside a conductive spot falls).  Up to +100 % this leaves out 1 to 3 % of a
single contact's signal, where the linear response, scaled at best, leaves 4 to 11 %.  The product of two Gaussians is a
Gaussian,

    g(p, s) g(q, t) = exp(-|p - q|^2 / 2(s^2 + t^2)) g((p t^2 + q s^2) / (s^2 + t^2), s t / sqrt(s^2 + t^2)),

so that K contacts are K + K (K + 1) / 2 bumps.  The table holds cubic B-splines over place and log width, with exact
derivatives, in the signal subspace: the few directions of whitened readings (`imaging.whitening`) that bumps reach.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model.discretisation import Model

# c and d above: part of the second order, and its saturation.
SECOND_ORDER, SATURATION = 0.8, 0.7
# Distance, in widths, beyond which a bump counts as zero: exp(-18) of its height.
CUTOFF_WIDTHS = 6.0
# Number of rows of nodes that are computed together.
TILE_ROWS = 8
# Pitch of the table in log width.
WIDTH_PITCH = 0.25


class Responses(eqx.Module):
    """Whitened readings of a bump anywhere, as B-splines; see the head of this file.

    | meaning                                                                     | shape               | unit |
    |-----------------------------------------------------------------------------|---------------------|------|
    | table: coefficients over y, x and log width; of bumps of unit u (s / scale)^2 | (ny, nx, nw, r)   | 1    |
    | origin, pitch of its nodes: y, x, log width                                 | (3,), (3,)          | m, 1 |
    | scale: the width of which strengths are counted                             | ()                  | m    |
    | background: mean of sigma_0                                                 | ()                  | S    |
    """

    table: Float[Array, "ny nx nw r"]
    origin: Float[Array, "3"]
    pitch: Float[Array, "3"]
    scale: Float[Array, ""]
    background: Float[Array, ""]

    def bump(self, place: Float[Array, "3"]) -> tuple[Float[Array, " r"], Float[Array, "3 r"]]:
        """Response of one bump at x, y, log width, and its slopes with respect to these."""
        t = (place[jnp.array([1, 0, 2])] - self.origin) / self.pitch
        cells = jnp.array(self.table.shape[:3], t.dtype) - 4
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(t)), 0, cells)
        value, slope = _cubic_splines(t - cell)
        corner = *cell.astype(int), 0
        block = jax.lax.dynamic_slice(self.table, corner, (4, 4, 4, self.table.shape[3])).reshape(64, -1)
        (a, b, c), (da, db, dc) = value, slope / self.pitch[:, None]
        weights = jnp.stack([_outer(*abc) for abc in ((a, b, c), (a, db, c), (da, b, c), (a, b, dc))])
        responses = weights @ block
        return responses[0], responses[1:]

    def contacts(self, theta: Float[Array, "n 4"]) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
        """Response of n contacts (x, y, log width, strength in units of sigma_0 scale^2), and its slopes."""
        place, weight = self._equivalent_bumps(theta)
        places, weights = jax.jacfwd(self._equivalent_bumps)(theta)
        value, slope = jax.vmap(self.bump)(place)
        by_place = jnp.einsum("m,mcr,mcnp->rnp", weight, slope, places)
        return weight @ value, by_place + jnp.einsum("mr,mnp->rnp", value, weights)

    def _equivalent_bumps(self, theta: Float[Array, "n 4"]) -> tuple[Float[Array, "m 3"], Float[Array, " m"]]:
        """The bumps whose linear responses add to that of n contacts: x, y, log width, and their strengths."""
        centre, width, strength = theta[:, :2], theta[:, 2], theta[:, 3]
        square = jnp.exp(2 * width)
        u = strength * self.scale**2 / square
        i, j = np.triu_indices(len(theta))
        total = square[i] + square[j]
        place = (centre[i] * square[j, None] + centre[j] * square[i, None]) / total[:, None]
        product = square[i] * square[j] / total
        overlap = jnp.exp(-0.5 * jnp.sum((centre[i] - centre[j]) ** 2, 1) / total)
        pairs = jnp.where(i == j, 1, 2) * u[i] * u[j] * overlap / (1 + SATURATION * 0.5 * (u[i] + u[j]))
        second = jnp.concatenate([place, 0.5 * jnp.log(product)[:, None]], 1)
        weight = -SECOND_ORDER * pairs * product / self.scale**2
        return jnp.concatenate([theta[:, :3], second]), jnp.concatenate([strength, weight])


def _outer(a: Float[Array, " i"], b: Float[Array, " j"], c: Float[Array, " k"]) -> Float[Array, " ijk"]:
    return (a[:, None, None] * b[:, None] * c).ravel()


def _cubic_splines(t: Float[Array, "..."]) -> tuple[Float[Array, "... 4"], Float[Array, "... 4"]]:
    """The four cubic B-splines that are nonzero at t in [0, 1], (..., 4), and their slopes."""
    t = t[..., None]
    u = 1 - t
    value = [u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]
    slope = [-3 * u**2, 9 * t**2 - 12 * t, 12 * u - 9 * u**2, 3 * t**2]
    return jnp.concatenate(value, -1) / 6, jnp.concatenate(slope, -1) / 6


class Nodes(NamedTuple):
    """Nodes of the table along y, x and log width, and the scale of `Responses`."""

    axes: tuple[np.ndarray, np.ndarray, np.ndarray]
    scale: float

    def subsample(self, stride: int) -> "Nodes":
        """Every ``stride``-th node along each axis."""
        y, x, log_width = self.axes
        return self._replace(axes=(y[::stride], x[::stride], log_width[::stride]))


def mean_conductivity(model: Model, sigma: np.ndarray) -> float:
    """The mean conductivity of the sheet, S."""
    return float(np.average(sigma, weights=np.asarray(model.areas, float)))


def table_nodes(model: Model, widths: tuple[float, float], columns: int) -> Nodes:
    """Nodes for bumps of widths (smallest, largest), with so many columns along x."""
    chart = np.asarray(model.chart, float)
    low, high = chart.min(0), chart.max(0)
    rows = max(5, round((columns - 1) * (high[1] - low[1]) / (high[0] - low[0])) + 1)
    lowest, highest = np.log(widths[0] / np.sqrt(2)), np.log(widths[1])  # the square of a bump is narrower by sqrt(2)
    levels = max(5, int(np.ceil((highest - lowest) / WIDTH_PITCH)) + 1)
    x, y = np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)
    return Nodes((y, x, np.linspace(lowest, highest, levels)), float(np.sqrt(widths[0] * widths[1])))


def tabulate(model: Model, jacobian: np.ndarray, nodes: Nodes) -> np.ndarray:
    """Responses at the nodes, (ny, nx, nw, r): the Jacobian times the means of the bumps over the elements.

    Tiles of nodes are computed together with the elements that their bumps reach.  Further away a bump would be a
    number below 1e-308, with which a processor is ten times slower.
    """
    y, x, log_widths = nodes.axes
    out = np.empty((len(y), len(x), len(log_widths), len(jacobian)))
    centres, size = _element_centres(model)
    order = np.argsort(centres[:, 1])
    centres, jacobian = centres[order], jacobian[:, order]
    for level, width in enumerate(np.exp(log_widths)):
        points, weights = quadrature_points(model, width)
        points, reach = points[order], CUTOFF_WIDTHS * width + size
        for columns in _tiles(x, int((x[-1] - x[0]) / (2 * reach))):
            near_columns = _within_reach(centres[:, 0], x[columns], reach)
            across = _bumps(points[near_columns, :, 0], x[columns], width) * weights[:, None]
            for rows in _tiles(y, len(y) // TILE_ROWS):
                first, last = np.searchsorted(centres[near_columns, 1], [y[rows][0] - reach, y[rows][-1] + reach])
                near_tile = near_columns[first:last]
                along = np.swapaxes(_bumps(points[near_tile, :, 1], y[rows], width), 1, 2)
                means = along @ across[first:last]  # (elements, rows, columns)
                responses = jacobian[:, near_tile] @ means.reshape(len(means), -1)
                part = np.moveaxis(responses.reshape(-1, *means.shape[1:]), 0, -1)
                out[rows, columns, level] = (nodes.scale / width) ** 2 * part
    return out


def _tiles(axis: np.ndarray, count: int) -> list[slice]:
    """The nodes of an axis in so many parts, or one."""
    ends = np.linspace(0, len(axis), max(1, count) + 1).round().astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(ends.tolist())]


def _within_reach(centres: np.ndarray, tile: np.ndarray, reach: float) -> np.ndarray:
    """Indices of the elements whose centres lie within ``reach`` of a tile of an axis."""
    return np.flatnonzero((centres > tile[0] - reach) & (centres < tile[-1] + reach))


def _bumps(points: np.ndarray, centres: np.ndarray, width: float) -> np.ndarray:
    """Bumps in one dimension, (elements, q, centres), at points (elements, q)."""
    return np.asarray(np.exp(-0.5 * ((points[..., None] - centres) / width) ** 2))


def _element_centres(model: Model) -> tuple[np.ndarray, float]:
    """Centres of the elements, (elements, 2), and the largest extent of one, m."""
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    return corners.mean(1), float(np.ptp(corners, axis=1).max())


# Symmetric rule of degree 4 on a triangle (Dunavant 1985): barycentric coordinates and weights.
_A, _B = 0.445948490915965, 0.091576213509771
_RULE = np.array([[1 - 2 * c if i == k else c for i in range(3)] for c in (_A, _B) for k in range(3)])
_RULE_WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


def quadrature_points(model: Model, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature points of each element, (elements, q, 2), as dense as the width needs, and their weights, (q,)."""
    rule, weights = quadrature_rule(model, width)
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    return np.einsum("qk,ekd->eqd", rule, corners), weights


def quadrature_rule(model: Model, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of the quadrature points of each element, (q, 3), and their weights, (q,)."""
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2).max()
    parts = int(np.clip(np.ceil(longest / (3 * width)), 1, 3))
    triangles = _subdivide(parts)
    rule = np.einsum("qk,pkc->pqc", _RULE, triangles).reshape(-1, 3)
    return rule, np.tile(_RULE_WEIGHTS, len(triangles)) / len(triangles)


def _subdivide(n: int) -> np.ndarray:
    """The reference triangle cut into n^2 equal ones: barycentric coordinates of their corners, (n^2, 3, 3)."""
    cuts = [(i, j) for i in range(n) for j in range(n - i)]
    upright = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in cuts]
    inverted = [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in cuts if i + j < n - 1]
    corners = np.array(upright + inverted) / n
    return np.concatenate([corners, 1 - corners.sum(2, keepdims=True)], 2)


def signal_subspace(values: np.ndarray, threshold: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Directions of whitened readings in which the rms of bumps is above ``threshold``, and their complement."""
    flat = values.reshape(-1, values.shape[-1])
    squares, vectors = np.linalg.eigh(flat.T @ flat / len(flat))
    signal = squares > max(threshold**2, 1e-14 * squares[-1])
    return vectors[:, signal], vectors[:, ~signal]


def spline_responses(values: np.ndarray, nodes: Nodes, background: float, dtype: np.dtype) -> Responses:
    """Responses by the splines through a table of `tabulate`."""
    coefficients = jnp.asarray(spline_coefficients(values), dtype)
    numbers = ([axis[0] for axis in nodes.axes], [axis[1] - axis[0] for axis in nodes.axes], nodes.scale, background)
    return Responses(coefficients, *(jnp.asarray(np.asarray(number, dtype)) for number in numbers))


def spline_coefficients(values: np.ndarray) -> np.ndarray:
    """Coefficients of the cubic splines through values on a grid, along the first three axes."""
    for axis, n in enumerate(values.shape[:3]):
        matrix = np.zeros((n + 2, n + 2))
        matrix[0, :5] = matrix[-1, -5:] = [1, -4, 6, -4, 1]  # the third derivative does not jump next to the ends
        for i in range(n):
            matrix[i + 1, i : i + 3] = 1 / 6, 4 / 6, 1 / 6
        moved = np.moveaxis(values, axis, 0)
        padded = np.pad(moved.reshape(n, -1), ((1, 1), (0, 0)))
        values = np.moveaxis(np.linalg.solve(matrix, padded).reshape(n + 2, *moved.shape[1:]), 0, axis)
    return values
