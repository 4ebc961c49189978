"""Interpolate the frames of a press between few solves.

Within a press the sheet is a function of few parameters: the load that the sheet feels under each tip, the progress
of each tip along its slide, and the temperature. The voltages are smooth functions of these. They are therefore solved
at Chebyshev points of the ranges of the parameters, and interpolated by a polynomial. Points are added until the
truncation error, estimated as the geometric tail of the series along each axis, is below the tolerance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer
from numpy.polynomial.chebyshev import chebvander
from scipy.fft import dct

import jaxeit as je

MIN_POINTS, MAX_POINTS = 3, 65  # along an axis
FULL_RANGE_POINTS = 17  # typical number along an axis that spans the full range of a parameter
SOLVE_BATCH = 16  # points that are sent to the device together

Solve = Callable[[Float[np.ndarray, "points d"]], Float[np.ndarray, "points readings"]]


@dataclass(frozen=True, eq=False)
class ParameterBox:
    """Ranges of the parameters of a sheet, (d,) each."""

    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]


def enclosing_boxes(
    low: Float[np.ndarray, "phases d"], high: Float[np.ndarray, "phases d"], scale: Float[np.ndarray, " d"]
) -> tuple[list[ParameterBox], Int[np.ndarray, " phases"]]:
    """Boxes that contain all phases of a press with few points in total, and the index of the box of each phase.

    A phase widens an existing box if that takes fewer points than a new box. Rest, loading and unloading thus share a
    box, but a slide under a creeping load does not cover all loads along its way. A phase without samples (low above
    high) gets the first box.

    Args:
        low, high: ranges of the parameters in each phase.
        scale: full range of each parameter over the session.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    owner = np.zeros(len(low), int)
    for phase in np.argsort(-_points(low, high, scale), kind="stable"):
        mine = low[phase], high[phase]
        if (mine[0] > mine[1]).any():
            continue
        joined = [(np.minimum(a, mine[0]), np.maximum(b, mine[1])) for a, b in found]
        more = [_points(*new, scale) - _points(*old, scale) for new, old in zip(joined, found, strict=True)]
        owner[phase] = int(np.argmin([*more, _points(*mine, scale)]))
        found[owner[phase] : owner[phase] + 1] = [[*joined, mine][owner[phase]]]
    return [ParameterBox(a, np.where(_moves(a, b, scale), b, a)) for a, b in found], owner


def _moves(low: np.ndarray, high: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.asarray(high - low > 1e-9 * scale)


def _points(low: np.ndarray, high: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Estimated number of points in a box."""
    share = (high - low) / np.where(scale > 0, scale, 1)
    return np.asarray(
        np.prod(np.where(_moves(low, high, scale), MIN_POINTS + (FULL_RANGE_POINTS - MIN_POINTS) * share, 1), -1)
    )


class FrameInterpolant:
    """Polynomial through solved frames over a box: a product of Chebyshev series."""

    def __init__(self, box: ParameterBox, solve: Solve, rest: Float[np.ndarray, " readings"], tolerance: float):
        """Add points until the error is below ``tolerance`` times the largest change from ``rest``."""
        self._low, self._span = box.low, box.high - box.low
        self._axes = np.flatnonzero(self._span > 0)
        counts, solved = np.full(len(self._axes), MIN_POINTS), _SolvedGrid(box, self._axes, solve)
        while True:
            values = solved(counts)
            self._series = _coefficients(values)
            change = np.abs(values - rest).max()
            self.errors = np.array([_truncation_error(self._series, axis) for axis in range(len(counts))])
            short = (self.errors > tolerance * change) & (counts < MAX_POINTS)
            if not short.any():
                break
            counts = np.where(short, 2 * counts - 1, counts)
        self.solves = len(solved.known)

    def __call__(self, q: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        """Frames at points ``q``: one point for each reading of a frame (m readings), or one for all (m is 1)."""
        x = 2 * (q[..., self._axes] - self._low[self._axes]) / self._span[self._axes] - 1
        counts = self._series.shape[:-1]
        bases = [chebvander(np.clip(x[..., axis], -1, 1), count - 1) for axis, count in enumerate(counts)]
        if q.shape[1] > 1 and bases:
            return self._one_by_one(bases)
        return self._together([basis[:, 0] for basis in bases], len(q))

    def _together(self, bases: list[np.ndarray], frames: int) -> np.ndarray:
        product = np.ones((frames, 1))
        for basis in bases:
            product = (product[:, :, None] * basis[:, None]).reshape(frames, -1)
        return np.asarray(product @ self._series.reshape(-1, self._series.shape[-1]))

    def _one_by_one(self, bases: list[np.ndarray]) -> np.ndarray:
        *others, last = (basis.swapaxes(0, 1) for basis in bases)  # (readings, frames, terms)
        series = np.moveaxis(self._series, -1, 0)
        rows = np.swapaxes(series.reshape(len(series), -1, series.shape[-1]), 1, 2)
        sums = (last @ rows).reshape(*last.shape[:2], *series.shape[1:-1])
        for basis in reversed(others):
            sums = np.einsum("rf...k,rfk->rf...", sums, basis)
        return sums.T


class _SolvedGrid:
    """Frames at the points of nested grids; each point is solved once."""

    def __init__(self, box: ParameterBox, axes: np.ndarray, solve: Solve):
        self.known: dict[tuple[int, ...], np.ndarray] = {}
        self._box, self._axes, self._solve = box, axes, solve

    def __call__(self, counts: Int[np.ndarray, " axes"]) -> Float[np.ndarray, "... readings"]:
        grid = [range(0, MAX_POINTS, (MAX_POINTS - 1) // (n - 1)) for n in counts]
        wanted = list(_product(grid))
        missing = [index for index in wanted if index not in self.known]
        if missing:
            at = np.tile(self._box.low, (len(missing), 1))
            share = 0.5 * (1 - np.cos(np.pi * np.array(missing) / (MAX_POINTS - 1))).reshape(len(missing), -1)
            span = (self._box.high - self._box.low)[self._axes]
            at[:, self._axes] += share * span
            self.known.update(zip(missing, self._solve(at), strict=True))
        return np.array([self.known[index] for index in wanted]).reshape(*counts, -1)


def _product(grid: list[range]) -> list[tuple[int, ...]]:
    return [tuple(g[i] for g, i in zip(grid, index, strict=True)) for index in np.ndindex(*map(len, grid))]


def _coefficients(values: Float[np.ndarray, "... readings"]) -> Float[np.ndarray, "... readings"]:
    """Chebyshev series along all axes but the last, from values at the points cos(pi (1 - share))."""
    for axis in range(values.ndim - 1):
        count = values.shape[axis]
        values = dct(np.flip(values, axis), type=1, axis=axis) / (count - 1)
        ends = np.ones(count)
        ends[[0, -1]] = 0.5
        values = values * ends.reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    return values


def _truncation_error(series: Float[np.ndarray, "... readings"], axis: int) -> float:
    """Truncation error of a series along one axis, by extrapolating its coefficients as a geometric series."""
    other = tuple(a for a in range(series.ndim) if a != axis)
    size = np.abs(series).max(other)
    last = max(size[-1], size[-2])
    if last <= 1e-14 * size.max():
        return 0.0
    ratio = min((last / size[:2].max()) ** (1 / (len(size) - 1)), 0.9)
    return float(last * ratio / (1 - ratio))


def frame_solver(model: je.Model, diameter: float) -> Callable[[np.ndarray, np.ndarray], Solve]:
    """Create a function that solves frames for given places of the tips (contacts, 2) m and their slide (2,) m.

    Its result maps points (points, d) to frames. A point holds the loads of the contacts in N, their progress along
    the slide, and the temperature in K. ``diameter`` is that of the tips in m.
    """
    tip = jnp.asarray(diameter, model.dtype)

    def press(places: np.ndarray, slide: np.ndarray) -> Solve:
        at, way = jnp.asarray(places, model.dtype), jnp.asarray(slide, model.dtype)

        def solve(points: np.ndarray) -> np.ndarray:
            out = []
            for first in range(0, len(points), SOLVE_BATCH):
                part = points[first : first + SOLVE_BATCH]
                padded = np.zeros((SOLVE_BATCH, points.shape[1]))
                padded[: len(part)] = part
                frames = _frames()(model, at, way, tip, jnp.asarray(padded, model.dtype), len(part))
                out.append(np.asarray(frames)[: len(part)])
            return np.concatenate(out)

        return solve

    return press


@cache
def _frames() -> Callable[..., Array]:
    return jax.jit(_solve, compiler_options=je.compiler_options())


def _solve(
    model: je.Model,
    places: Float[Array, "contacts 2"],
    slide: Float[Array, "2"],
    diameter: Float[Array, ""],
    points: Float[Array, "points d"],
    count: Integer[ArrayLike, ""],
) -> Float[Array, "points readings"]:
    contacts = len(places)

    def frame(point: Array) -> Array:
        load, progress, temperature = point[:contacts], point[contacts:-1], point[-1]
        spread = [je.model.load_spread(model, p + s * slide, diameter) for p, s in zip(places, progress, strict=True)]
        return je.forward(model, je.conductivity(model, load @ jnp.stack(spread), temperature))

    def step(i: Array, out: Array) -> Array:
        return out.at[i].set(frame(points[i]))

    out = jnp.zeros((len(points), len(model.pattern)), model.dtype)
    found: Float[Array, "points readings"] = jax.lax.fori_loop(0, count, step, out)
    return found
