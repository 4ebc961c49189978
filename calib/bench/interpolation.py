"""Interpolate the frames of a press between few solves.

Within a press the sheet is a function of few parameters: the load that the sheet feels under each tip, the progress
of each tip along its slide, and the temperature. The voltages are smooth functions of these. They are therefore solved
at few points of the ranges of the parameters, and interpolated by a polynomial in Newton's form on Leja points. Each
point that is added gives the polynomial a term, whose largest value is its coefficient. Terms that are left out are
estimated from those before them; points are added where the estimate is largest, until all that is left out is below
the tolerance. A parameter of little effect, and what parameters do together, thus take few points (adaptive sparse
grids: Gerstner and Griebel, Computing 71, 2003; on Leja points: Chkifa, Cohen and Schwab, Foundations of Computational
Mathematics 14, 2014).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxeit as je

MIN_POINTS, MAX_POINTS = 3, 65  # along an axis
FULL_RANGE_POINTS = 17  # typical number along an axis that spans the full range of a parameter
LARGEST_DROP = 0.3  # a term below this share of the one before it may be small by accident
LARGEST_RATIO = 0.9  # of a term to the one before it, so that the sum of all that follow is finite
NOISE = 200  # rounding errors of a solve, in units of the last place of the largest reading

Index = tuple[int, ...]
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
    """Polynomial through solved frames over a box.

    | attribute | meaning                                                       |
    |-----------|---------------------------------------------------------------|
    | wanted    | points of the frames that it needs next, (points, d); or none |
    """

    def __init__(self, box: ParameterBox, rest: Float[np.ndarray, " readings"], tolerance: float):
        """Ask for points until the error is below ``tolerance`` times the largest change from ``rest``."""
        self._low, self._span, self._rest = box.low, box.high - box.low, rest
        self._axes = np.flatnonzero(self._span > 0)
        noise = NOISE * float(np.finfo(rest.dtype).eps * np.abs(rest).max())
        self._terms, self._tolerance = _NewtonTerms(len(self._axes), noise), tolerance
        self.wanted = self._at(self._terms.places)

    def add(self, frames: Float[np.ndarray, "points readings"]) -> None:
        """Take the frames at the points that are wanted."""
        terms = self._terms
        terms.add(frames - self._rest)
        if terms.error > self._tolerance * terms.change and terms.following is not None:
            terms.want(terms.following)
        self.wanted = self._at(terms.places)
        if not len(self.wanted):
            self._series = terms.dense()

    @property
    def error(self) -> float:
        """Estimate of the largest error, V."""
        return self._terms.error

    @property
    def solves(self) -> int:
        """Number of solved frames."""
        return len(self._terms.known)

    def __call__(self, q: Float[np.ndarray, "frames m d"]) -> Float[np.ndarray, "frames readings"]:
        """Frames at points ``q``: one point for each reading of a frame (m readings), or one for all (m is 1)."""
        x = 2 * (q[..., self._axes] - self._low[self._axes]) / self._span[self._axes] - 1
        counts = self._series.shape[:-1]
        bases = [_newton_basis(np.clip(x[..., axis].T, -1, 1), count) for axis, count in enumerate(counts)]
        if q.shape[1] > 1 and bases:
            return np.asarray(self._rest + self._one_by_one(bases))
        return np.asarray(self._rest + self._together([basis[0] for basis in bases], len(q)))

    def _at(self, points: Float[np.ndarray, "points axes"]) -> Float[np.ndarray, "points d"]:
        """Parameters at places -1 to 1 along each axis."""
        share = np.zeros((len(points), len(self._low)))
        share[:, self._axes] = 0.5 * (1 + points)
        return np.asarray(self._low + share * self._span)

    def _together(self, bases: list[np.ndarray], frames: int) -> np.ndarray:
        product = np.ones((frames, 1))
        for basis in bases:
            product = (product[:, :, None] * basis[:, None]).reshape(frames, -1)
        return np.asarray(product @ self._series.reshape(-1, self._series.shape[-1]))

    def _one_by_one(self, bases: list[np.ndarray]) -> np.ndarray:
        *others, last = bases  # (readings, frames, terms)
        series = np.moveaxis(self._series, -1, 0)
        rows = np.swapaxes(series.reshape(len(series), -1, series.shape[-1]), 1, 2)
        sums = (last @ rows).reshape(*last.shape[:2], *series.shape[1:-1])
        for basis in reversed(others):
            sums = np.einsum("rf...k,rfk->rf...", sums, basis)
        return sums.T


def interpolant(
    box: ParameterBox, solve: Solve, rest: Float[np.ndarray, " readings"], tolerance: float
) -> FrameInterpolant:
    """The polynomial over a box, through frames that ``solve`` makes of parameters."""
    made = FrameInterpolant(box, rest, tolerance)
    while len(made.wanted):
        made.add(solve(made.wanted))
    return made


class _NewtonTerms:
    """Terms of a polynomial in variables from -1 to 1. With a term, it has all those of smaller indices.

    | attribute | meaning                                                             |
    |-----------|---------------------------------------------------------------------|
    | known     | coefficients of the terms, by their index along each axis           |
    | change    | largest value of the function so far                                |
    | error     | estimate of the sum of all terms that are left out                  |
    | following | index of the largest of these; None if there are points for no more |
    """

    def __init__(self, axes: int, noise: float):
        self.known: dict[Index, np.ndarray] = {}
        self.change, self.error = 0.0, 0.0
        self.following: Index | None = None
        self._axes, self._noise = axes, noise  # terms up to the noise count as zero
        self._missing: list[Index] = []
        along = np.eye(axes, dtype=int)
        self.want((0,) * axes, *(tuple((k * row).tolist()) for row in along for k in range(1, MIN_POINTS)))

    @property
    def places(self) -> Float[np.ndarray, "missing axes"]:
        """Places of the values that are missing for the terms that are wanted."""
        return np.asarray(_leja_points()[np.array(self._missing, int).reshape(len(self._missing), self._axes)])

    def want(self, *indices: Index) -> None:
        """Have terms next, with those of smaller indices."""
        wanted = [tuple(place) for index in indices for place in np.ndindex(*(k + 1 for k in index))]
        self._missing = [index for index in dict.fromkeys(wanted) if index not in self.known]

    def add(self, values: Float[np.ndarray, "missing readings"]) -> None:
        """Take the values of the function that are missing."""
        self.change = max(self.change, float(np.abs(values).max()))
        for index, value in zip(self._missing, values, strict=True):
            self.known[index] = value - self._at_point(np.array(index, int)) if self.known else value
        self._missing = []
        self._estimate()

    def dense(self) -> Float[np.ndarray, "... readings"]:
        """All coefficients, with zeros for the terms that are left out."""
        indices = np.array(list(self.known), int)
        found = np.zeros((*indices.max(0) + 1, *self.known[(0,) * indices.shape[1]].shape))
        found[tuple(indices.T)] = np.array(list(self.known.values()))
        return found

    def _at_point(self, place: Int[np.ndarray, " axes"]) -> Float[np.ndarray, " readings"]:
        """Value of the polynomial at a Leja point, by the index of the point along each axis."""
        weights = _basis_at_points()[place, np.array(list(self.known), int)].prod(-1)
        return np.asarray(weights @ np.array(list(self.known.values())))

    def _estimate(self) -> None:
        indices = np.array(list(self.known), int)
        if not indices.size:
            return  # no variable: the first term is the function
        sizes = np.full(indices.max(0) + 2, np.nan)
        largest = np.array([np.abs(term).max() for term in self.known.values()])
        sizes[tuple(indices.T)] = np.where(largest > self._noise, largest, 0)
        along = [np.moveaxis(_left_out(np.moveaxis(sizes, axis, 0)), 0, axis) for axis in range(sizes.ndim)]
        left = np.max(along, axis=0)
        self.error = float(left.sum())
        allowed = left[(slice(MAX_POINTS),) * sizes.ndim]
        place = np.unravel_index(np.argmax(allowed), allowed.shape)
        self.following = tuple(map(int, place)) if allowed[place] > 0 else None


def _left_out(sizes: Float[np.ndarray, "terms_and_1 ..."]) -> Float[np.ndarray, "terms_and_1 ..."]:
    """Estimated sum of the missing terms after each line of terms along the first axis, at the first one that misses.

    The terms of a line decrease as those of any other line do, at most. After the last term that any line has, they
    decrease as slowly as in the last two steps.

    Args:
        sizes: largest values of the terms, NaN where there is none.
    """
    safe = sizes.copy()
    safe[MIN_POINTS:] = np.maximum(sizes[MIN_POINTS:], LARGEST_DROP * sizes[MIN_POINTS - 1 : -1])
    steps = np.nan_to_num(safe[1:] / np.maximum(safe[:-1], np.finfo(float).tiny))
    ratio = steps.reshape(len(steps), -1).max(1)
    ratio[-1] = ratio[-3:-1].max()
    ratio = np.minimum(ratio, LARGEST_RATIO)
    rest = np.nan_to_num(safe[:-1].T * (ratio / (1 - ratio))).T
    return np.concatenate([np.zeros_like(sizes[:1]), np.where(np.isnan(sizes[1:]), rest, 0)])


@cache
def _leja_points() -> Float[np.ndarray, " points"]:
    """Leja points: 0, then always where the product of the distances from the points before is largest.

    At the first point, half the load, all parameters change the frame; without a load, progress changes nothing.
    """
    x = np.cos(np.linspace(0, np.pi, 20001))
    points, product = np.zeros(MAX_POINTS), np.abs(x)
    for k in range(1, MAX_POINTS):
        points[k] = x[np.argmax(product)]
        product *= np.abs(x - points[k])
    return points


@cache
def _basis_at_points() -> Float[np.ndarray, "points terms"]:
    return _newton_basis(_leja_points(), MAX_POINTS)


def _newton_basis(x: Float[np.ndarray, "*n"], count: int) -> Float[np.ndarray, "*n terms"]:
    """Polynomials that are one at their own Leja point and zero at those before it; none is larger than one."""
    points = _leja_points()
    basis = np.ones((count, *x.shape))
    for k in range(1, count):
        step = points[k] - points[: k - 1], points[k - 1] - points[: k - 1]
        share = 1 / ((points[k] - points[k - 1]) * np.prod(step[0] / step[1]))
        np.multiply(x, share, out=basis[k])
        basis[k] -= points[k - 1] * share
        basis[k] *= basis[k - 1]
    return np.moveaxis(basis, 0, -1)


def frame_solver(model: je.Model, diameter: float) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Create a function that solves frames (points, readings) of a press.

    Its arguments are the places of the tips (contacts, 2) m, their slide (2,) m, and parameters of the sheet (points,
    d): the loads of the tips in N, their progress along the slide, and the temperature in K. ``diameter`` is that of
    the tips in m. Frames are solved one by one: points come few at a time, and batches of so few take no less time on a
    CPU.
    """
    frame = je.bind(_frame, model, jnp.asarray(diameter, model.dtype))

    def solve(places: np.ndarray, slide: np.ndarray, points: np.ndarray) -> np.ndarray:
        at, way, each = (array.astype(model.dtype) for array in (places, slide, points))
        return np.stack([frame(at, way, point) for point in each])

    return solve


def _frame(
    model: je.Model,
    diameter: Float[Array, ""],
    places: Float[Array, "contacts 2"],
    slide: Float[Array, "2"],
    point: Float[Array, " d"],
) -> Float[Array, " readings"]:
    contacts = len(places)
    load, progress, temperature = point[:contacts], point[contacts:-1], point[-1]
    spread = [je.model.load_spread(model, p + s * slide, diameter) for p, s in zip(places, progress, strict=True)]
    return je.forward(model, je.conductivity(model, load @ jnp.stack(spread), temperature))
