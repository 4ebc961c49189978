"""Image bases: the meaning of the coefficients of an image."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from .._compile import verb
from ..budget import require
from ..linalg.base import on_device
from ..registry import Registry, limited, require_limits
from ..registry.limits import LONGEST
from .discretisation import Model
from .matrix.stiffness import Stiffness, stiffness


class BasisError(ValueError):
    """A basis that cannot be laid over the model."""


class Picture(eqx.Module):
    """The places of the coefficients of an image.

    | meaning                                               | shape       | unit |
    |-------------------------------------------------------|-------------|------|
    | centres in the sheet's flat coordinates               | (basis, 2)  | m    |
    | areas on the sheet; zero for a pixel that misses it   | (basis,)    | m^2  |
    | edges: pairs of neighbours, each once                 | (edges, 2)  |      |
    | edge_length: of the border that neighbours share      | (edges,)    | m    |
    | shape: (rows, columns) of a picture, row 0 at low y   |             |      |
    | extent: x0, x1, y0, y1 of that picture                |             | m    |
    """

    centres: Float[Array, "basis 2"]
    areas: Float[Array, " basis"]
    edges: Int[Array, "edges 2"]
    edge_length: Float[Array, " edges"]
    shape: tuple[int, ...] = eqx.field(static=True)
    extent: tuple[float, float, float, float] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.areas.shape[0]


class AbstractPictured(eqx.Module):
    """An object with coefficients that lie on a `Picture`."""

    picture: eqx.AbstractVar[Picture]

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.picture.size

    @property
    def centres(self) -> Float[Array, "basis 2"]:
        """Centres in the sheet's flat coordinates, (basis, 2) m."""
        return self.picture.centres

    @property
    def areas(self) -> Float[Array, " basis"]:
        """Areas on the sheet, (basis,) m^2; zero for a pixel that misses it."""
        return self.picture.areas

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the picture, row 0 at low y; empty without a picture."""
        return self.picture.shape

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """x0, x1, y0 and y1 of the picture, m."""
        return self.picture.extent


class BasisMap(AbstractPictured):
    """A basis laid over one model: conductivity change = sparse matrix times coefficients.

    The matrix is stored in lines of c entries; a coefficient has one line or more.

    | meaning                                               | shape       | unit |
    |-------------------------------------------------------|-------------|------|
    | element, weight: entries of each line; weight 0: none | (lines, c)  |      |
    | coefficient of each line                              | (lines,)    |      |
    | stiffness of each line                                |             |      |
    | picture: where the coefficients lie                   |             |      |
    | elements: number of elements of the model             |             |      |
    | single: whether each coefficient has one line         |             |      |

    Example:
        # once, on the host; then it can be an argument of a jitted function
        pixels = je.Pixels(20).on(model)
        image = jnp.zeros(pixels.size).at[210].set(1e-3)  # S
        sigma = model.background + pixels.expand(image)
    """

    element: Int[Array, "lines c"]
    weight: Float[Array, "lines c"]
    coefficient: Int[Array, " lines"]
    stiffness: Stiffness
    picture: Picture
    elements: int = eqx.field(static=True)
    single: bool = eqx.field(static=True)

    @verb
    def expand(self, image: Float[Array, " basis"]) -> Float[Array, " elements"]:
        """Values on the elements, (elements,), from the coefficients of an image, (basis,)."""
        spread = self.weight * image[self.coefficient][:, None]
        return jnp.zeros(self.elements, spread.dtype).at[self.element].add(spread)

    @verb
    def restrict(self, values: Float[Array, " elements"]) -> Float[Array, " basis"]:
        """The transpose of `expand`: weighted sums over the elements of each coefficient."""
        sums = jnp.sum(self.weight * values[self.element], 1)
        return jnp.zeros(self.size, sums.dtype).at[self.coefficient].add(sums)


class AbstractBasis(ABC):
    """A kind of image; `on` lays the basis over a model, on the host."""

    @abstractmethod
    def on(self, model: Model) -> BasisMap:
        """The basis for this model.

        Raises:
            BasisError: under jit, where the values of the model's geometry are unknown.
        """


@dataclass(frozen=True)
class Elements(AbstractBasis):
    """One coefficient per element: the finest image on the mesh, which is not a picture."""

    def on(self, model: Model) -> BasisMap:
        areas = _host(model.areas)
        every = np.arange(len(areas))
        chart = _host(model.chart)
        weight = np.ones(len(areas))
        neighbours = _across_sides(_host(model.triangles), chart)
        return _basis_map(
            model, (every, every, weight), _host(model.centroids), areas, neighbours, (len(areas),), chart
        )


@dataclass(frozen=True)
class Pixels(AbstractBasis):
    """A regular grid over the sheet's bounding box, projected by exact areas of overlap.

    The conductivity change of an element is the mean of the pixels over it, weighted by the areas
    they share.

    | meaning                                                      | default |
    |--------------------------------------------------------------|---------|
    | columns along x                                              | 40      |
    | rows along y; None: square pixels                            | None    |
    """

    columns: int = limited(40, least=1, most=2000)
    rows: int | None = limited(None, least=1, most=2000, whole=True)

    def __post_init__(self) -> None:
        require_limits(self, BasisError)

    def on(self, model: Model) -> BasisMap:
        chart = _host(model.chart)
        low, high = chart.min(0), chart.max(0)
        rows = self.rows or max(1, round(self.columns * (high[1] - low[1]) / (high[0] - low[0])))
        require("coefficients", self.columns * rows, f"{type(self).__name__} over the sheet", BasisError)
        counts = np.array([self.columns, rows])
        pixel = (high - low) / counts
        corners = (chart[_host(model.triangles)] - low) / pixel  # in units of pixels
        element, place = _candidates(corners, counts)
        shared = overlap_areas(corners[element], place, place + 1)
        kept = shared > 1e-12
        element, place, shared = element[kept], place[kept], shared[kept]
        whole = np.bincount(element, shared, minlength=len(corners))
        weight = shared / whole[element]
        number = place[:, 1] * self.columns + place[:, 0]
        areas = np.bincount(number, weight * _host(model.areas)[element], minlength=counts.prod())
        x, y = np.meshgrid(np.arange(self.columns) + 0.5, np.arange(rows) + 0.5)
        centres = low + np.stack([x.ravel(), y.ravel()], 1) * pixel
        shape = (rows, self.columns)
        neighbours = _grid_neighbours(areas.reshape(shape) > 0, pixel)
        return _basis_map(model, (element, number, weight), centres, areas, neighbours, shape, chart)


@dataclass(frozen=True)
class Bumps(AbstractBasis):
    """Overlapping Gaussian bumps on a regular grid: the conductivity change under a soft round tip.

    The paper samples 41 x 41 bumps and calls the response J (the second interpretation of its text).  A
    coefficient is the height of its bump; a bump ends at four widths.

    | meaning                                                  | default | unit |
    |----------------------------------------------------------|---------|------|
    | columns, rows: centres from rim to rim; rows None: square | 41      |      |
    | width: standard deviation of a bump                      | 0.012   | m    |

    Example:
        bumps = je.Bumps(columns=20, width=0.008).on(model)
        print(je.model.BASES.text(je.Bumps(20)))  # as a recipe and the command line name it
    """

    columns: int = limited(41, least=2, most=500)
    rows: int | None = limited(None, least=2, most=500, whole=True)
    width: float = limited(0.012, above=0, most=LONGEST)

    def __post_init__(self) -> None:
        require_limits(self, BasisError)

    def on(self, model: Model) -> BasisMap:
        chart, places = _host(model.chart), _host(model.centroids)
        low, high = chart.min(0), chart.max(0)
        rows = self.rows or max(2, round((self.columns - 1) * (high[1] - low[1]) / (high[0] - low[0])) + 1)
        require("coefficients", self.columns * rows, f"{type(self).__name__} over the sheet", BasisError)
        counts = np.array([self.columns, rows])
        pitch = (high - low) / (counts - 1)
        x, y = np.meshgrid(np.arange(self.columns), np.arange(rows))
        centres = low + np.stack([x.ravel(), y.ravel()], 1) * pitch
        near = cKDTree(places).query_ball_point(centres, 4 * self.width)
        number = np.repeat(np.arange(len(centres)), [len(some) for some in near])
        element = np.concatenate([np.asarray(some, int) for some in near])
        square = np.sum((places[element] - centres[number]) ** 2, 1)
        weight = np.exp(-0.5 * square / self.width**2)
        areas = np.bincount(number, weight * _host(model.areas)[element], minlength=len(centres))
        neighbours = _grid_neighbours(areas.reshape(rows, self.columns) > 0, pitch)
        return _basis_map(
            model, (element, number, weight), centres, areas, neighbours, (rows, self.columns), chart, pitch / 2
        )


BASES = Registry(AbstractBasis, "basis", "jaxeit.bases")
"""Bases by the names that the command line and recipes use."""


def _grid_neighbours(inside: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of pixels of the picture that share a side, both on the sheet, and the length of the side."""
    number = np.arange(inside.size).reshape(inside.shape)
    beside = (number[:, :-1], number[:, 1:]), (number[:-1], number[1:])
    pairs = [np.stack([a.ravel(), b.ravel()], 1) for a, b in beside]
    length = np.repeat(pixel[::-1], [len(some) for some in pairs])
    edges = np.concatenate(pairs)
    kept = inside.ravel()[edges].all(1)
    return edges[kept], length[kept]


def _across_sides(triangles: np.ndarray, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles that share a side, and its length."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(sides.T)
    same = (np.diff(sides[order], axis=0) == 0).all(1)
    first, second = order[:-1][same], order[1:][same]
    ends = chart[sides[first]]
    return np.stack([owner[first], owner[second]], 1), np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)


def _basis_map(
    model: Model,
    entries: tuple[np.ndarray, np.ndarray, np.ndarray],
    centres: np.ndarray,
    areas: np.ndarray,
    neighbours: tuple[np.ndarray, np.ndarray],
    shape: tuple[int, ...],
    chart: np.ndarray,
    margin: np.ndarray | tuple[float, float] = (0.0, 0.0),
) -> BasisMap:
    (x0, y0), (x1, y1) = (chart.min(0) - margin).tolist(), (chart.max(0) + margin).tolist()
    element, weight, coefficient = _lines(entries, len(areas), _host(model.centroids))
    system = model.system
    with jax.ensure_compile_time_eval():  # so that the values of the basis are known inside a compiled function too
        return BasisMap(
            element=on_device(element, jnp.int32),
            weight=on_device(weight, model.dtype),
            coefficient=on_device(coefficient, jnp.int32),
            stiffness=stiffness(
                element, weight, _host(system.dofs), _host(system.slopes), system.unknowns, model.dtype
            ),
            picture=Picture(
                centres=on_device(centres, model.dtype),
                areas=on_device(areas, model.dtype),
                edges=on_device(neighbours[0], jnp.int32),
                edge_length=on_device(neighbours[1], model.dtype),
                shape=shape,
                extent=(x0, x1, y0, y1),
            ),
            elements=model.areas.shape[0],
            single=np.array_equal(coefficient, np.arange(len(areas))),
        )


def _lines(
    entries: tuple[np.ndarray, np.ndarray, np.ndarray], size: int, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries in lines of the median length, so that there is little padding; the entries of a line are neighbours,
    which share nodes."""
    element, coefficient, weight = entries
    turn = np.empty(len(places), int)
    turn[cKDTree(places).indices] = np.arange(len(places))
    order = np.lexsort((turn[element], coefficient))
    element, coefficient, weight = element[order], coefficient[order], weight[order]
    counts = np.bincount(coefficient, minlength=size)
    length = int(np.clip(np.median(counts[counts > 0]), 1, 128))
    lines = -(-counts // length)
    rank = np.arange(len(element)) - np.repeat(np.cumsum(counts) - counts, counts)
    line = np.repeat(np.cumsum(lines) - lines, counts) + rank // length
    table, weights = np.zeros((lines.sum(), length), int), np.zeros((lines.sum(), length))
    table[line, rank % length], weights[line, rank % length] = element, weight
    return table, weights, np.repeat(np.arange(size), lines)


def _host(array: Array) -> np.ndarray:
    try:
        host = np.asarray(array)
    except jax.errors.TracerArrayConversionError as error:
        raise BasisError(
            "a basis needs a model's geometry, which jit hides; make basis.on(model) outside and pass the result in"
        ) from error
    return host.astype(np.float64) if np.issubdtype(host.dtype, np.floating) else host


def _candidates(corners: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a triangle and a pixel whose bounding boxes meet: (pairs,), (pairs, 2)."""
    first = np.clip(np.floor(corners.min(1)).astype(int), 0, counts - 1)
    last = np.clip(np.ceil(corners.max(1)).astype(int) - 1, first, counts - 1)
    spans = last - first + 1
    element = np.repeat(np.arange(len(corners)), spans.prod(1))
    start = np.cumsum(spans.prod(1)) - spans.prod(1)
    within = np.arange(len(element)) - start[element]
    width = spans[element, 0]
    return element, first[element] + np.stack([within % width, within // width], 1)


def overlap_areas(polygons: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Areas that polygons share with axis-parallel boxes, exactly.

    Each edge is split where it crosses the lines of the box, and the parts outside are moved onto the
    lines; moved parts enclose no area, so the shoelace formula gives the area inside.

    Args:
        polygons: (pairs, corners, 2), counter-clockwise, convex or not.
        low, high: corners of the boxes, (pairs, 2).
    """
    areas = _enclosed(polygons)
    cut = ((polygons.min(1) < low) | (polygons.max(1) > high)).any(1)
    parts = polygons[cut]
    for axis in (0, 1):
        parts = _clamped(parts, axis, low[cut, axis], high[cut, axis])
    areas[cut] = _enclosed(parts)
    return areas


def _enclosed(polygons: np.ndarray) -> np.ndarray:
    """Areas (polygons,) by the shoelace formula."""
    x, y = np.moveaxis(polygons, -1, 0)
    areas: np.ndarray = 0.5 * np.sum(x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1), 1)
    return areas


def _clamped(polygons: np.ndarray, axis: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The polygons, split at the lines ``low`` and ``high`` and clamped between them along one axis."""
    start = polygons
    step = np.roll(polygons, -1, 1) - start
    lines = np.stack([low, high], -1)[:, None, :]
    along = np.where(step[..., axis] == 0, 1.0, step[..., axis])[..., None]
    crossing = np.clip((lines - start[..., axis][..., None]) / along, 0.0, 1.0)
    t = np.concatenate([np.zeros_like(crossing[..., :1]), np.sort(crossing, -1)], -1)
    points: np.ndarray = start[:, :, None] + t[..., None] * step[:, :, None]
    points = points.reshape(len(points), 3 * start.shape[1], 2)
    points[..., axis] = np.clip(points[..., axis], low[:, None], high[:, None])
    return points
