"""Frames from few solves.

Within a press the sheet is a function of few numbers: the load that the sheet feels under each tip, how far each tip
has slid, the temperature.  The voltages are smooth in them.  So they are solved at Chebyshev points of the ranges that
these numbers run through, and a polynomial joins them.  Points are added until the coefficients say that what is left
out is below the tolerance: the geometric tail of the series along each axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial.chebyshev import chebvander
from scipy.fft import dct

import jaxeit as je

_START, _MOST = 3, 65  # points along an axis
_WHOLE = 17  # that the whole range of a number takes, about
_AT_ONCE = 16  # points handed to the device together

Solve = Callable[[Float[np.ndarray, "points d"]], Float[np.ndarray, "points readings"]]


@dataclass(frozen=True, eq=False)
class Box:
    """Ranges of the numbers that a sheet is a function of, (d,) each."""

    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]


def boxes(
    low: Float[np.ndarray, "phases d"], high: Float[np.ndarray, "phases d"], scale: Float[np.ndarray, " d"]
) -> tuple[list[Box], Int[np.ndarray, " phases"]]:
    """Boxes that hold all phases of a press at the least cost in points, and the box of each phase.

    A phase joins a box and widens it where that takes fewer points than a box of its own: rest, loading and unloading
    share theirs, but a slide under a load that creeps does not take all loads along its way.  Phases without a
    sample (low above high) take the first.
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
    return [Box(a, np.where(_moves(a, b, scale), b, a)) for a, b in found], owner


def _moves(low, high, scale):
    return high - low > 1e-9 * scale


def _points(low, high, scale):
    """About how many points a box takes."""
    share = (high - low) / np.where(scale > 0, scale, 1)
    return np.prod(np.where(_moves(low, high, scale), _START + (_WHOLE - _START) * share, 1), -1)


class Interpolant:
    """The polynomial through solved frames over a box; a product of Chebyshev series."""

    def __init__(self, box: Box, solve: Solve, rest: Float[np.ndarray, " readings"], tolerance: float):
        """Solve at more points until the error is below ``tolerance`` times the largest change from ``rest``."""
        self._low, self._span = box.low, box.high - box.low
        self._axes = np.flatnonzero(self._span > 0)
        counts, solved = np.full(len(self._axes), _START), _Solved(box, self._axes, solve)
        while True:
            values = solved(counts)
            self._series = _coefficients(values)
            change = np.abs(values - rest).max()
            self.errors = np.array([_tail(self._series, axis) for axis in range(len(counts))])
            short = (self.errors > tolerance * change) & (counts < _MOST)
            if not short.any():
                break
            counts = np.where(short, 2 * counts - 1, counts)
        self.solves = len(solved.known)

    def __call__(self, q: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        """Frames at points, with one for each reading of a frame or one for all (m is 1)."""
        x = 2 * (q[..., self._axes] - self._low[self._axes]) / self._span[self._axes] - 1
        counts = self._series.shape[:-1]
        bases = [chebvander(np.clip(x[..., axis], -1, 1), count - 1) for axis, count in enumerate(counts)]
        if q.shape[1] > 1 and bases:
            return self._one_by_one(bases)
        return self._together([basis[:, 0] for basis in bases], len(q))

    def _together(self, bases, frames: int):
        product = np.ones((frames, 1))
        for basis in bases:
            product = (product[:, :, None] * basis[:, None]).reshape(frames, -1)
        return product @ self._series.reshape(-1, self._series.shape[-1])

    def _one_by_one(self, bases):
        *others, last = (basis.swapaxes(0, 1) for basis in bases)  # (readings, frames, terms)
        series = np.moveaxis(self._series, -1, 0)
        rows = np.swapaxes(series.reshape(len(series), -1, series.shape[-1]), 1, 2)
        sums = (last @ rows).reshape(*last.shape[:2], *series.shape[1:-1])
        for basis in reversed(others):
            sums = np.einsum("rf...k,rfk->rf...", sums, basis)
        return sums.T


class _Solved:
    """Frames at points of the nested grids, each solved once."""

    def __init__(self, box: Box, axes: np.ndarray, solve: Solve):
        self.known: dict[tuple[int, ...], np.ndarray] = {}
        self._box, self._axes, self._solve = box, axes, solve

    def __call__(self, counts: Int[np.ndarray, " axes"]) -> Float[np.ndarray, "... readings"]:
        grid = [range(0, _MOST, (_MOST - 1) // (n - 1)) for n in counts]
        wanted = list(_product(grid))
        missing = [index for index in wanted if index not in self.known]
        if missing:
            at = np.tile(self._box.low, (len(missing), 1))
            share = 0.5 * (1 - np.cos(np.pi * np.array(missing) / (_MOST - 1))).reshape(len(missing), -1)
            span = (self._box.high - self._box.low)[self._axes]
            at[:, self._axes] += share * span
            self.known.update(zip(missing, self._solve(at), strict=True))
        return np.array([self.known[index] for index in wanted]).reshape(*counts, -1)


def _product(grid: list[range]) -> list[tuple[int, ...]]:
    return [tuple(g[i] for g, i in zip(grid, index, strict=True)) for index in np.ndindex(*map(len, grid))]


def _coefficients(values: Float[np.ndarray, "... readings"]) -> Float[np.ndarray, "... readings"]:
    """Chebyshev series along all axes but the last, of values at cos(pi (1 - share))."""
    for axis in range(values.ndim - 1):
        count = values.shape[axis]
        values = dct(np.flip(values, axis), type=1, axis=axis) / (count - 1)
        ends = np.ones(count)
        ends[[0, -1]] = 0.5
        values = values * ends.reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    return values


def _tail(series: Float[np.ndarray, "... readings"], axis: int) -> float:
    """What a series leaves out along one axis: the sum of the geometric series that its size has followed so far."""
    other = tuple(a for a in range(series.ndim) if a != axis)
    size = np.abs(series).max(other)
    last = max(size[-1], size[-2])
    if last <= 1e-14 * size.max():
        return 0.0
    ratio = min((last / size[:2].max()) ** (1 / (len(size) - 1)), 0.9)
    return float(last * ratio / (1 - ratio))


def solver(model: je.Model, diameter: float) -> Callable[[np.ndarray, np.ndarray], Solve]:
    """For the places of the tips (contacts, 2) m and their slide (2,) m: frames at points (points, d), where a point
    holds the loads of the contacts in N, their progress, and the temperature in K."""
    tip = jnp.asarray(diameter, model.dtype)

    def press(places: np.ndarray, slide: np.ndarray) -> Solve:
        at, way = jnp.asarray(places, model.dtype), jnp.asarray(slide, model.dtype)

        def solve(points: np.ndarray) -> np.ndarray:
            out = []
            for first in range(0, len(points), _AT_ONCE):
                part = points[first : first + _AT_ONCE]
                padded = np.zeros((_AT_ONCE, points.shape[1]))
                padded[: len(part)] = part
                frames = _frames()(model, at, way, tip, jnp.asarray(padded, model.dtype), len(part))
                out.append(np.asarray(frames)[: len(part)])
            return np.concatenate(out)

        return solve

    return press


@cache
def _frames():
    return jax.jit(_solve, compiler_options=je.compiler_options())


def _solve(model, places, slide, diameter, points, count):
    contacts = len(places)

    def frame(point):
        load, progress, temperature = point[:contacts], point[contacts:-1], point[-1]
        spread = [je.load_spread(model, p + s * slide, diameter) for p, s in zip(places, progress, strict=True)]
        return je.forward(model, je.conductivity(model, load @ jnp.stack(spread), temperature))

    def step(i, out):
        return out.at[i].set(frame(points[i]))

    out = jnp.zeros((len(points), len(model.pattern)), model.dtype)
    return jax.lax.fori_loop(0, count, step, out)
