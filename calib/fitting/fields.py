"""Correction by location: how much stronger or weaker than on average a pad feels a press, by where it is pressed.

The force on pad i is F_i = exp(g_i(x)) h_i(P_i), with h_i the pad's curve and g_i a *field* of log-gain over the
place x of the contact as the image tells it, never as the stage does. Log-gain keeps the gain positive and makes the
field linear in its coefficients: g_i(x) = (phi_i(x) - c_i) @ beta, where c_i is the mean of the features over the
presses of the pad. So the mean log-gain of every pad is zero over its presses: its level belongs to its curve alone.

Coefficients have a normal prior, beta ~ N(0, noise^2 diag(d)). Its size (and the length of a Gaussian process) is not
chosen but averaged over: every one of a fixed list is weighed by its restricted marginal likelihood, the noise
profiled and the pads' levels integrated out (Patterson and Thompson 1971; Rasmussen and Williams 2006, 5.4). A field
that the presses do not call for is thereby shrunk to none, and what is not known of the prior is part of the variance.

A new field is one class with a `name`; `FIELDS` finds it in the modules of this room.
"""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int

import jaxeit as je
from jaxeit.linalg.lapack import eigh, solve
from jaxeit.registry import Registry

from .order_statistics import MAD_TO_SIGMA
from .results import FitResult

OnPads = Float[Array, "... pads 2"]
Features = Float[Array, "... pads k"]

# --- the places ------------------------------------------------------------------------------------------------------


class Places(eqx.Module):
    """Where frames are touched, as their images tell.

    | field     | meaning                                                              | shape        | unit |
    |-----------|----------------------------------------------------------------------|--------------|------|
    | position  | of each contact, in the sheet's flat coordinates; NaN: none          | (n, K, 2)    | m    |
    | weight    | share of each contact in what a pad carries; a row of zeros: unknown | (n, K, pads) | 1    |
    | width     | of its bump, as in `jaxeit.Contacts`; NaN: not known                 | (n, K)       | m    |
    | amplitude | of its bump; 0: not known, or none                                   | (n, K)       | S    |
    """

    position: Float[Array, "n K 2"]
    weight: Float[Array, "n K pads"]
    width: Float[Array, "n K"]
    amplitude: Float[Array, "n K"]

    @property
    def known(self) -> Bool[Array, "n pads"]:
        """Whether a pad is known to be touched somewhere."""
        return jnp.sum(self.weight, 1) > 0

    def __getitem__(self, rows: Any) -> "Places":
        found: Places = jax.tree.map(lambda leaf: leaf[rows], self)
        return found


def single_places(
    position: Float[ArrayLike, "n 2"] | Sequence[Sequence[float]],
    pads: int,
    width: Float[ArrayLike, "..."] = np.nan,
    amplitude: Float[ArrayLike, "..."] = 0.0,
) -> Places:
    """One contact a frame at (n, 2) m, for all pads, NaN: unknown; of its bump, if known, width and amplitude (n,)."""
    position = jnp.asarray(position)
    known = jnp.all(jnp.isfinite(position), -1)
    weight = jnp.broadcast_to(known[:, None, None], (len(position), 1, pads))
    bump = (jnp.broadcast_to(jnp.asarray(value, position.dtype), known.shape)[:, None] for value in (width, amplitude))
    return Places(position[:, None], weight.astype(position.dtype), *bump)


class Geometry(eqx.Module):
    """Outlines of the pads and the rim of the sheet, as straight sides; sides of length zero fill up.

    | field      | meaning                              | shape              | unit |
    |------------|--------------------------------------|--------------------|------|
    | start, end | of each side of each pad             | (pads, sides, 2)   | m    |
    | rim        | ends of the sides of the sheet's rim | (rim sides, 2, 2)  | m    |
    """

    start: Float[Array, "pads sides 2"]
    end: Float[Array, "pads sides 2"]
    rim: Float[Array, "rim 2 2"]

    @property
    def pads(self) -> int:
        """Number of pads."""
        return self.start.shape[0]


_RIM_SIDES = 128  # of a rim that is not made of straight ones


def geometry_of(skin: je.Skin, dtype: DTypeLike | None = None) -> Geometry:
    """Where a skin's pads and rim are."""
    sides = max((len(pad.outline) for pad in skin.pads), default=1)
    outlines = [np.concatenate([p.outline, np.repeat(p.outline[:1], sides - len(p.outline), 0)]) for p in skin.pads]
    start = np.array(outlines, float).reshape(len(skin.pads), sides, 2)
    corners = np.asarray(skin.domain.corners, float)
    if not len(corners):
        corners = np.linspace(0, skin.domain.perimeter, _RIM_SIDES, endpoint=False)
    rim = np.asarray(skin.domain.boundary_point(corners), float)
    parts = start, np.roll(start, -1, 1), np.stack([rim, np.roll(rim, -1, 0)], 1)
    return Geometry(*(jnp.asarray(part, dtype) for part in parts))


def _nearest(
    point: Float[Array, "... 2"], start: Float[Array, "... 2"], end: Float[Array, "... 2"]
) -> Float[Array, "... 2"]:
    """Nearest place on each side, (..., sides, 2), of points (..., 2)."""
    vector = end - start
    square = jnp.sum(vector**2, -1)
    along = jnp.sum((point[..., None, :] - start) * vector, -1) / jnp.where(square > 0, square, 1)
    return start + jnp.clip(along, 0, 1)[..., None] * vector


def _distance(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Euclidean, with a gradient of zero (not NaN) at zero."""
    square = jnp.sum((a - b) ** 2, -1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _contains(
    point: Float[Array, "... 2"], start: Float[Array, "pads sides 2"], end: Float[Array, "pads sides 2"]
) -> Bool[Array, "... pads"]:
    """Even-odd rule, (..., pads), for points (..., 2)."""
    x, y = point[..., None, None, 0], point[..., None, None, 1]
    spans = (start[..., 1] > y) != (end[..., 1] > y)
    rise = jnp.where(end[..., 1] == start[..., 1], 1, end[..., 1] - start[..., 1])
    crosses = x < start[..., 0] + (y - start[..., 1]) * (end[..., 0] - start[..., 0]) / rise
    return jnp.sum(spans & crosses, -1) % 2 == 1


def _on_pads(geometry: Geometry, point: Float[Array, "... 2"]) -> OnPads:
    """Each point moved onto each pad, (..., pads, 2): a contact beside a pad loads it at its nearest edge."""
    near = _nearest(point[..., None, :], geometry.start, geometry.end)
    best = jnp.argmin(_distance(near, point[..., None, None, :]), -1)
    edge = jnp.take_along_axis(near, best[..., None, None], -2)[..., 0, :]
    inside = _contains(point, geometry.start, geometry.end)
    return jnp.where(inside[..., None], point[..., None, :], edge)


def _relative(geometry: Geometry, place: OnPads) -> OnPads:
    """Places on pads (..., pads, 2) as fractions of the pads' bounding boxes, -1 to 1."""
    low, high = geometry.start.min(1), geometry.start.max(1)
    return (2 * place - low - high) / (high - low)


# --- fields ----------------------------------------------------------------------------------------------------------

_SIZE = 0.01  # m, of a contact whose gain a correction by size leaves as it is
_RATIOS = np.logspace(-3, 7, 41)  # prior variance of a coefficient over the variance of the noise


class AbstractField(eqx.Module):
    """Features of a place on a pad, and the priors that its coefficients may have.

    `shared`: one field in pad-relative terms for all pads; otherwise each pad has its own coefficients.
    """

    shared: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        """Features at places that lie on the pads (m)."""

    @abc.abstractmethod
    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        """Relative prior variances of one pad's coefficients, one row for each shape that is tried."""

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """The box of which presses tell that lie in this one, both in half widths of a pad from its middle."""
        return low, high

    def features(
        self, geometry: Geometry, place: OnPads, width: Float[ArrayLike, "..."] = _SIZE
    ) -> Float[Array, "... pads m"]:
        """Features for every pad, those of a pad alone zero for the others, of contacts at places on each pad (m) and
        of widths (...,) m; NaN is what a width that is not known leaves unknown."""
        own = self.basis(geometry, place)
        if self.shared:
            return own
        apart = own[..., None, :] * jnp.eye(geometry.pads, dtype=own.dtype)[:, :, None]
        return apart.reshape(*own.shape[:-1], -1)

    def size(self, pads: int) -> int:
        """Number of coefficients."""
        return int(self.shapes().shape[1] * (1 if self.shared else pads))


def _cubic(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """The cubic B-spline at z knots from its middle."""
    z = jnp.abs(z)
    inner = 2 / 3 - z**2 + z**3 / 2
    return jnp.where(z < 1, inner, jnp.maximum(2 - z, 0) ** 3 / 6)


class Constant(AbstractField):
    """No correction: a pad is one number everywhere, and its scatter over places is stated."""

    name: ClassVar[str] = "constant"

    shared: bool = eqx.field(static=True, default=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        return jnp.zeros((*place.shape[:-1], 1), place.dtype)

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 1))


class PadEdge(AbstractField):
    """Distance to the walls: a pad is stiff at its edges, and part of a load beyond the sheet's rim is lost.

    Bumps (cubic B-splines) in octaves of distance, the n-th where distance is (2^n - 1) `width`, summed over the sides
    of the pad; and the same of the distance to the rim. A coefficient is of one distance: where no press lies its prior
    holds. Walls are alike, so pads share the coefficients and a few dozen presses suffice.
    """

    name: ClassVar[str] = "edge"

    width: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=8e-3)
    bumps: int = eqx.field(static=True, default=4)
    shared: bool = eqx.field(static=True, default=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        real = jnp.any(geometry.start != geometry.end, -1)
        to_sides = _distance(_nearest(place, geometry.start, geometry.end), place[..., None, :])
        to_rim = _distance(_nearest(place, geometry.rim[:, 0], geometry.rim[:, 1]), place[..., None, :]).min(-1)
        sides = jnp.sum(jnp.where(real[..., None], self._near(to_sides), 0), -2)
        return jnp.concatenate([sides, self._near(to_rim)], -1)

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """As far from the middle on every side: one wall tells of the others."""
        farthest = jnp.max(jnp.maximum(-low, high), -1, keepdims=True)
        return jnp.broadcast_to(-farthest, low.shape), jnp.broadcast_to(farthest, high.shape)

    def _near(self, distance: Float[Array, "..."]) -> Float[Array, "... bumps"]:
        octaves = jnp.log2(1 + distance / self.width.astype(distance.dtype))
        return _cubic(octaves[..., None] - jnp.arange(self.bumps))

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 2 * self.bumps))


class PadEdgeSize(PadEdge):
    """`PadEdge`, and a power of the contact's estimated width: a broad contact may load a pad otherwise than a narrow
    one of the same force. To learn it, press with tips of several diameters."""

    name: ClassVar[str] = "edge-size"

    def features(
        self, geometry: Geometry, place: OnPads, width: Float[ArrayLike, "..."] = _SIZE
    ) -> Float[Array, "... pads m"]:
        edge = super().features(geometry, place)
        size = jnp.log(jnp.asarray(width, edge.dtype) / _SIZE)
        return jnp.concatenate([edge, jnp.broadcast_to(size[..., None, None], (*edge.shape[:-1], 1))], -1)

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 2 * self.bumps + 1))


class _Grid(AbstractField):
    """Products of one bump along each axis of the pad's bounding box, on a grid of nodes."""

    nodes: eqx.AbstractVar[int]

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        centres, pitch = self._centres()
        along = self._bump((_relative(geometry, place)[..., None] - jnp.asarray(centres, place.dtype)) / pitch)
        both = along[..., 0, :, None] * along[..., 1, None, :]
        return both.reshape(*both.shape[:-2], -1)

    def _centres(self) -> tuple[Float[np.ndarray, " nodes"], float]:
        pitch = 2 / (self.nodes - 1)
        return np.linspace(-1, 1, self.nodes), pitch

    @abc.abstractmethod
    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        """The bump at z pitches from its node."""

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, len(self._centres()[0]) ** 2))


class Bilinear(_Grid):
    """Straight between the nodes of a grid over the pad."""

    name: ClassVar[str] = "bilinear"

    nodes: int = eqx.field(static=True, default=3)
    shared: bool = eqx.field(static=True, default=False)

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.maximum(1 - jnp.abs(z), 0)


class RadialBasis(_Grid):
    """Gaussian bumps one pitch wide on a grid over the pad."""

    name: ClassVar[str] = "rbf"

    nodes: int = eqx.field(static=True, default=5)
    shared: bool = eqx.field(static=True, default=False)

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.exp(-0.5 * z**2)


class TensorSpline(_Grid):
    """Uniform cubic B-splines over `nodes` knots along each axis."""

    name: ClassVar[str] = "spline"

    nodes: int = eqx.field(static=True, default=4)
    shared: bool = eqx.field(static=True, default=False)

    def _centres(self) -> tuple[Float[np.ndarray, " nodes"], float]:
        pitch = 2 / (self.nodes - 1)
        return np.linspace(-1 - pitch, 1 + pitch, self.nodes + 2), pitch

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return _cubic(z)


def _floats(values: Sequence[float] | Float[ArrayLike, " n"]) -> tuple[float, ...]:
    return tuple(np.asarray(values, float).tolist())


_BOX = 1.4  # half width of the box of the modes, over that of the pad: what it does at its walls stays outside


class GaussianProcess(AbstractField):
    """A smooth field of unknown length scale (squared exponential), with its variance.

    In the modes of the Laplacian on a box around the pad, whose prior variances are the spectral density (Solin and
    Särkkä 2020, Statistics and Computing 30): the process itself as far as `modes` resolve the length, at the cost of a
    linear fit. `lengths` tried are fractions of half the pad.
    """

    name: ClassVar[str] = "gp"

    lengths: tuple[float, ...] = eqx.field(static=True, converter=_floats, default=(0.3, 0.45, 0.7, 1.0, 1.5))
    modes: int = eqx.field(static=True, default=8)
    shared: bool = eqx.field(static=True, default=False)

    def _frequencies(self) -> Float[np.ndarray, " modes"]:
        return np.pi * np.arange(1, self.modes + 1) / (2 * _BOX)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        u = _relative(geometry, place)[..., None] + _BOX
        along = jnp.sin(u * jnp.asarray(self._frequencies(), place.dtype)) / np.sqrt(_BOX)
        both = along[..., 0, :, None] * along[..., 1, None, :]
        found: Features = both.reshape(*both.shape[:-2], -1)
        return found

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        square = self._frequencies() ** 2
        both = (square[:, None] + square).ravel()
        return np.array([2 * np.pi * length**2 * np.exp(-0.5 * length**2 * both) for length in self.lengths])


FIELDS = Registry(AbstractField, "field", "calib.fields")
"""Fields by the names used on the command line and in calibration files."""


def restored(kind: type[AbstractField], settings: Mapping[str, np.ndarray]) -> AbstractField:
    """The field whose settings were stored as arrays under the names of its fields."""
    return kind(**{name: _setting(value) for name, value in settings.items()})


def _setting(value: np.ndarray) -> Any:
    """A static setting as Python's own number; what is an array stays one."""
    if value.ndim == 0 and value.dtype.kind in "bui":
        return bool(value) if value.dtype.kind in "bu" else int(value)
    return jnp.asarray(value)


# --- the fit ---------------------------------------------------------------------------------------------------------


class LogGain(NamedTuple):
    """Log of a pad's gain and its variance, (n, pads); an unknown place has 0 and the variance over the presses."""

    mean: Array
    variance: Array


_BORNE = 1 / 3  # share of a press from which on it tells of a pad


class FittedField(eqx.Module):
    """A field with its numbers and their honesty.

    | field        | meaning                                                            | shape        | unit |
    |--------------|--------------------------------------------------------------------|--------------|------|
    | field        | the choice                                                         |              |      |
    | geometry     | of the skin                                                        |              |      |
    | coefficients | of the centred features                                            | (m,)         | 1    |
    | covariance   | of the coefficients, posterior                                     | (m, m)       | 1    |
    | reach        | corners of the box of each pad that was pressed; beyond: `log_gain`| (pads, 2, 2) | m    |
    | centre       | mean features of each pad's presses: there log-gain is zero        | (pads, m)    | 1    |
    | noise        | scatter of single presses about the field, in log force            | ()           | 1    |
    | spread       | scatter of single presses about no field, in log force             | ()           | 1    |
    | evidence     | log of the largest marginal likelihood, over that of no field      | ()           | 1    |
    | n            | presses used, those at one place counted as one                    | ()           |      |
    | result       | a `FitResult`; anything but 0 means: no correction                 | ()           |      |
    """

    field: AbstractField
    geometry: Geometry
    coefficients: Float[Array, " m"]
    covariance: Float[Array, "m m"]
    reach: Float[Array, "pads 2 2"]
    centre: Float[Array, "pads m"]
    noise: Float[Array, ""]
    spread: Float[Array, ""]
    evidence: Float[Array, ""]
    n: Float[Array, ""]
    result: Int[Array, ""]

    def log_gain(self, places: Places) -> LogGain:
        """The field at places, each pad's the mean over the contacts that load it.

        Beyond what was pressed it stays level; its variance there is that of a field that goes on, and the square
        of what lies between the two.
        """
        held, there = (self._centred(places, reach) for reach in (self.reach, None))
        between = (there - held) @ self.coefficients
        variance = jnp.einsum("npi,ij,npj->np", there, self.covariance, there) + between**2
        unknown = jnp.maximum(self.spread**2 - self.noise**2, 0)
        return LogGain(held @ self.coefficients, jnp.where(places.known, variance, unknown))

    def _centred(self, places: Places, reach: Float[Array, "pads 2 2"] | None) -> Float[Array, "n pads m"]:
        features = pad_features(self.field, self.geometry, places, reach)
        return jnp.where(places.known[..., None] & jnp.isfinite(features), features - self.centre, 0)

    def message(self) -> str:
        """What became of the fit, for a person."""
        return FitResult(int(self.result)).message


@je.verb
def log_gain(fitted: FittedField, places: Places) -> LogGain:
    """`FittedField.log_gain`, compiled."""
    return fitted.log_gain(places)


def pad_features(
    field: AbstractField, geometry: Geometry, places: Places, reach: Float[Array, "*pads 2 2"] | None = None
) -> Float[Array, "n pads m"]:
    """Features of each pad, the weighted mean over its contacts; 0 where it has none, NaN where not known.

    Contacts beyond a pad's `reach` (lowest, highest corner) count as at its edge.
    """
    present = jnp.all(jnp.isfinite(places.position), -1)
    width = jnp.where(present, places.width, _SIZE)
    place = _on_pads(geometry, jnp.where(present[..., None], places.position, 0))
    held = place if reach is None else jnp.clip(place, reach[..., 0, :], reach[..., 1, :])
    features = field.features(geometry, held, width)
    weight = jnp.where(present[..., None], places.weight, 0)
    total = jnp.sum(weight, 1, keepdims=True)
    return jnp.sum((weight / jnp.where(total > 0, total, 1))[..., None] * features, 1)


def _pressed(
    field: AbstractField,
    geometry: Geometry,
    places: Places,
    share: Float[Array, "n pads"],
    reach: Float[Array, "2 2"],
) -> Float[Array, "pads 2 2"]:
    """Corners of the box of each pad, within `reach`, that presses support: those of which it carried a good part.

    What spills over from a press beside a pad lies at its edge but says little of the gain there: a field that is free
    there would take it for whatever else ails the press. Pads that share a field share their support.
    """
    place = _relative(geometry, _on_pads(geometry, places.position))
    sound = jnp.isfinite(place) & (places.weight > 0)[..., None] & (share >= _BORNE)[:, None, :, None]
    over = (0, 1, 2) if field.shared else (0, 1)
    low, high = jnp.min(jnp.where(sound, place, jnp.inf), over), jnp.max(jnp.where(sound, place, -jnp.inf), over)
    none = low > high
    low, high = field.supported(jnp.where(none, -1, low), jnp.where(none, 1, high))
    corner, far = geometry.start.min(1), geometry.start.max(1)
    box = (corner[:, None] + far[:, None] + (far - corner)[:, None] * jnp.stack([low, high], -2)) / 2
    return jnp.stack([jnp.maximum(box[:, 0], reach[0]), jnp.minimum(box[:, 1], reach[1])], 1)


class _Whitened(NamedTuple):
    """Presses times the root of their weight, the pads' levels projected out."""

    z: Array
    y: Array
    degrees: Array


def _project(
    z: Float[Array, "n m"], y: Float[Array, " n"], share: Float[Array, "n pads"], weight: Float[Array, " n"]
) -> _Whitened:
    """Take each pad's level out of features and log ratios: it is the curve's."""
    root = jnp.sqrt(weight)[:, None]
    z, y, x = z * root, y * root[:, 0], share * root
    present = jnp.sum(x**2, 0) > 0
    gram = x.T @ x + jnp.diag(jnp.where(present, 1e-12, 1.0).astype(x.dtype))
    levels = solve(gram, x.T @ jnp.column_stack([z, y]))
    left = jnp.column_stack([z, y]) - x @ levels
    return _Whitened(left[:, :-1], left[:, -1], jnp.maximum(jnp.sum(weight) - jnp.sum(present), 1.0))


class _Averaged(NamedTuple):
    """Coefficients and covariance over all priors, the largest log evidence, and the variance of the noise."""

    coefficients: Array
    covariance: Array
    evidence: Array
    variance: Array


class _Shape(NamedTuple):
    """One shape of prior, in the axes in which every size of it is diagonal; rows are sizes."""

    evidence: Array
    variance: Array
    shrink: Array
    moment: Array
    axes: Array


def _of_shape(white: _Whitened, shape: Float[Array, " m"]) -> _Shape:
    root, ratio = jnp.sqrt(shape), jnp.asarray(_RATIOS, shape.dtype)[:, None]
    values, vectors = eigh(root[:, None] * (white.z.T @ white.z) * root)
    values, axes = jnp.maximum(values, 0), root[:, None] * vectors
    moment = axes.T @ (white.z.T @ white.y)
    shrink = ratio / (1 + ratio * values)
    square = jnp.maximum(white.y @ white.y - jnp.sum(shrink * moment**2, 1), jnp.finfo(shape.dtype).tiny)
    evidence = -0.5 * (jnp.sum(jnp.log1p(ratio * values), 1) + white.degrees * jnp.log(square))
    return _Shape(evidence, square / white.degrees, shrink, shrink * moment, axes)


def _average(white: _Whitened, shapes: Float[Array, "shapes m"]) -> _Averaged:
    """Posterior over all sizes and shapes of the prior, by the law of total variance."""
    each = jax.lax.map(lambda shape: _of_shape(white, shape), shapes)
    weight = jnp.exp(each.evidence - jnp.max(each.evidence))
    weight = weight / jnp.sum(weight)
    of_shape = jnp.sum(weight, 1)
    share = weight / jnp.where(of_shape > 0, of_shape, 1)[:, None]
    middle = jnp.einsum("sr,srk->sk", share, each.moment)
    about = each.moment - middle[:, None]
    within = jnp.einsum("sr,sri,srj->sij", weight, about, about)
    within = within + jax.vmap(jnp.diag)(jnp.einsum("sr,sr,srk->sk", weight, each.variance, each.shrink))
    means = jnp.einsum("sik,sk->si", each.axes, middle)
    mean = of_shape @ means
    between = jnp.einsum("s,si,sj->ij", of_shape, means - mean, means - mean)
    covariance = jnp.einsum("sik,skl,sjl->ij", each.axes, within, each.axes) + between
    return _Averaged(mean, covariance, jnp.max(each.evidence), jnp.sum(weight * each.variance))


_FAR = 2.5  # standard deviations beyond which a press loses weight


def _robust(white: _Whitened, coefficients: Float[Array, " m"], valid: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Huber's weights: 1 for presses within `_FAR` of the field, falling as 1 / distance beyond."""
    left = jnp.abs(white.y - white.z @ coefficients)
    size = MAD_TO_SIGMA * jnp.nanmedian(jnp.where(valid & (left > 0), left, jnp.nan))
    far = _FAR * jnp.where(size > 0, size, jnp.inf)
    return jnp.minimum(1.0, far / jnp.maximum(left, jnp.finfo(left.dtype).tiny))


def fit_field(
    field: AbstractField,
    geometry: Geometry,
    places: Places,
    log_ratio: Float[Array, " n"],
    share: Float[Array, "n pads"],
    weight: Float[Array, " n"],
    reach: Float[Array, "2 2"],
) -> FittedField:
    """The pure fit: fixed shapes, works under jit and vmap, never raises.

    Args:
      places: of the presses, from their images.
      log_ratio: log of true force over the sum of the pads' curves at each press.
      share: each pad's part of that sum; rows sum to one.
      weight: of each press; 0 leaves it out, k presses at one place have 1 / k each, as their scatter is the place's.
      reach: lowest and highest corner of the box within which was pressed, m.
    """
    finite = jnp.isfinite(log_ratio) & jnp.all(jnp.isfinite(share), -1)
    known = jnp.all(places.known | (share <= 0), -1)
    weight = jnp.where(finite & known, weight, 0)
    share = jnp.where(finite[:, None], share, 0)
    y = jnp.where(weight > 0, log_ratio, 0)
    reach = _pressed(field, geometry, places, jnp.where(weight[:, None] > 0, share, 0), reach)
    features = pad_features(field, geometry, places, reach)
    loads = share * weight[:, None]
    total = jnp.sum(loads, 0)[:, None]
    told = jnp.isfinite(features)
    by_told = jnp.einsum("np,npm->pm", loads, told.astype(loads.dtype))
    features = jnp.where(told, features, 0)
    centre = jnp.einsum("np,npm->pm", loads, features) / jnp.where(by_told > 0, by_told, 1)
    features = jnp.where(told, features, centre)  # what is not known is taken for the mean
    z = jnp.einsum("np,npm->nm", share, features - centre)
    shapes = jnp.asarray(np.tile(field.shapes(), (1, 1 if field.shared else geometry.pads)), z.dtype)

    def one_round(trust: Array, _: None) -> tuple[Array, tuple[_Averaged, Array, Array]]:
        white = _project(z, y, share, weight * trust)
        found = _average(white, shapes)
        # distances are judged for whole presses, not for what is left of those that share a place
        plain = _project(z, y, share, (weight > 0).astype(z.dtype))
        return _robust(plain, found.coefficients, weight > 0), (found, jnp.sum(white.y**2), white.degrees)

    _, rounds = jax.lax.scan(one_round, jnp.ones_like(y), None, length=3)
    found, square, degrees = jax.tree.map(lambda leaf: leaf[-1], rounds)
    n = jnp.sum(weight)
    enough = n >= 2 + jnp.sum(total[:, 0] > 0)
    sound = jnp.all(jnp.isfinite(found.coefficients)) & jnp.all(jnp.isfinite(found.covariance))
    result = jnp.select([~enough, ~sound], [FitResult.TOO_FEW, FitResult.NOT_FINITE], FitResult.SUCCESS)
    good = result == FitResult.SUCCESS
    return FittedField(
        field=field,
        geometry=geometry,
        coefficients=jnp.where(good, found.coefficients, 0),
        covariance=jnp.where(good, found.covariance, 0),
        reach=reach,
        centre=centre,
        noise=jnp.sqrt(found.variance),
        spread=jnp.sqrt(square / degrees),
        evidence=found.evidence + 0.5 * degrees * jnp.log(jnp.maximum(square, jnp.finfo(square.dtype).tiny)),
        n=n,
        result=result,
    )
