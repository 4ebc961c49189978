"""The place of contact of a log, by its stage.

Two models use the place x: a gain over the place, F = exp(g(x)) h(s), with g a field as for pads
(`calib.fitting.fields`) and h the curve of the signal s; or the combination of channels takes the two coordinates as
further inputs. A log has no outline of a pad. Coordinates are relative to the box of the presses instead.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxeit as je

from ..curves.samples import by_rows
from ..fields import AbstractField, FittedField, Geometry, fit_field, log_gain, single_places

# Fraction of the largest force above which a sample belongs to a press.
LOADED_FRACTION = 0.1
# Largest distance of two presses at one place, over the diagonal of the box of all presses.
MERGE_DISTANCE = 0.03
# m; presses nearer to each other are at one place in any case. Stages and robot arms that stand still say places that
# differ by some micrometres, and repeat a place to some tens of them.
REPEATABILITY = 5e-5
MIN_PLACES = 8
"""Places of contact without which a log determines no field."""
# Part of the box of the presses by which a place may lie outside it; as for the range of a channel.
BOX_MARGIN = 0.05
# Least side of the box over the longer one: presses along a line determine a field along it.
MIN_SIDE_RATIO = 0.1


@dataclass(frozen=True, eq=False)
class LogLocation:
    """How a model of a log uses the place of contact.

    | field  | meaning                                                                       | shape  | unit |
    |--------|-------------------------------------------------------------------------------|--------|------|
    | box    | lowest and highest corner of the fitted presses                               | (2, 2) | m    |
    | gain   | field of log-gain; None: the combination takes the place as two further inputs |        |      |

    Example:
        print(logs.MIN_PLACES, "places are needed at least")
    """

    box: Float[np.ndarray, "2 2"]
    gain: FittedField | None

    def inputs(self, values: Float[np.ndarray, "n channels"], place: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """What the combination takes: the channels and, without a gain, the place from -1 to 1 over the box."""
        return values if self.gain is not None else np.column_stack([values, box_coordinates(self.box, place)])

    def inside(self, place: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Flags (n,) of the places that are known and lie in the box of the presses, or little outside it."""
        return in_box(self.box, place)

    def gains(self, place: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Gain (n,) and variance of its logarithm; where the place is not known, 1 and the scatter over places."""
        if self.gain is None:
            return np.ones(len(place)), np.zeros(len(place))
        mean, variance = by_rows(_log_gains, np.asarray(place, self.gain.coefficients.dtype), before=(self.gain,))
        return np.exp(mean), variance


def box_coordinates(box: Float[np.ndarray, "2 2"], place: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Places (n, 2) from -1 to 1 over the box; outside of it at its border."""
    return np.asarray(np.clip((2 * place - box[0] - box[1]) / (box[1] - box[0]), -1, 1))


def in_box(box: Float[np.ndarray, "2 2"], place: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Flags (n,) of places within the box, or less than `BOX_MARGIN` of it outside."""
    margin = BOX_MARGIN * (box[1] - box[0])
    return np.asarray(((place >= box[0] - margin) & (place <= box[1] + margin)).all(1))


def bounding_box(place: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 2"]:
    """Lowest and highest corner of places, at least `MIN_SIDE_RATIO` as wide as long."""
    low, high = place.min(0), place.max(0)
    side = np.maximum(high - low, max(MIN_SIDE_RATIO * float((high - low).max()), 1e-6))
    middle = (low + high) / 2
    return np.stack([middle - side / 2, middle + side / 2])


def loaded_rows(place: Float[np.ndarray, "n 2"], force: Float[np.ndarray, " n"]) -> np.ndarray:
    """Flags (n,) of the samples of presses whose place is known."""
    size = np.nan_to_num(np.abs(force))
    return np.asarray((size > LOADED_FRACTION * size.max(initial=0)) & np.isfinite(place).all(1))


def cluster_sites(place: Float[np.ndarray, "n 2"], force: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Number (n,) of the place of contact of each sample, in random order.

    Presses nearer to each other than `MERGE_DISTANCE` or `REPEATABILITY` are at one place. A sample without contact has
    the number of the press before.
    """
    rows = np.flatnonzero(loaded_rows(place, force))
    if not len(rows):
        return np.zeros(len(force), int)
    near = max(MERGE_DISTANCE * float(np.linalg.norm(np.ptp(place[rows], axis=0))), REPEATABILITY)
    first = np.empty((0, 2))
    number = np.full(len(force), -1)
    for row in rows:
        distance = np.linalg.norm(first - place[row], axis=1)
        if not len(first) or distance.min() > near:
            number[row], first = len(first), np.concatenate([first, place[row][None]])
        else:
            number[row] = int(np.argmin(distance))
    last = np.maximum.accumulate(np.where(number >= 0, np.arange(len(number)), -1))
    filled = number[np.where(last >= 0, last, rows[0])]
    return np.asarray(np.random.default_rng(0).permutation(len(first))[filled])


def box_geometry(box: Float[np.ndarray, "2 2"]) -> Geometry:
    """The box as the outline of one pad that covers the whole sheet."""
    (x, y), (far_x, far_y) = box
    corners = np.array([[x, y], [far_x, y], [far_x, far_y], [x, far_y]])
    ends = np.roll(corners, -1, 0)
    return Geometry(*map(jnp.asarray, (corners[None], ends[None], np.stack([corners, ends], 1))))


@je.verb
def _log_gains(gain: FittedField, place: Float[Array, "n 2"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    found = log_gain(gain, single_places(place, 1))
    return found.mean[:, 0], found.variance[:, 0]


@je.verb
def _fit_fields(
    field: AbstractField,
    geometry: Geometry,
    place: Float[Array, "places 2"],
    log_ratio: Float[Array, "fits places"],
    weight: Float[Array, "fits places"],
    reach: Float[Array, "2 2"],
) -> FittedField:
    places, share = single_places(place, 1), jnp.ones((len(place), 1), place.dtype)
    found: FittedField = eqx.filter_vmap(
        lambda y, w: fit_field(field, geometry, places, y, share, w, reach), in_axes=(0, 0)
    )(log_ratio, weight)
    return found


def fit_gains(
    field: AbstractField,
    box: Float[np.ndarray, "2 2"],
    place: Float[np.ndarray, "places 2"],
    ratio: Float[np.ndarray, "fits places"],
) -> FittedField:
    """Fields (with a leading axis of fits) of the gains of places; NaN: the fit does not use the place."""
    used = np.isfinite(ratio) & (ratio > 0)
    log_ratio = np.log(np.where(used, ratio, 1.0))
    return _fit_fields(
        field,
        box_geometry(box),
        jnp.asarray(place),
        jnp.asarray(log_ratio),
        jnp.asarray(used.astype(float)),
        jnp.asarray(box),
    )


def gain_ratios(
    force: Float[np.ndarray, " n"],
    curve: Float[np.ndarray, "fits n"],
    rows: np.ndarray,
    site: Int[np.ndarray, " n"],
    count: int,
) -> Float[np.ndarray, "fits places"]:
    """Force over that of the curves at each place, by least squares over its flagged samples (fits, n); NaN: none."""
    rows = rows & np.isfinite(curve)
    product = np.where(rows, np.nan_to_num(force) * curve, 0.0)
    square = np.where(rows, curve**2, 0.0)
    numerator, denominator = (np.stack([np.bincount(site, one, count) for one in part]) for part in (product, square))
    return np.asarray(np.where(denominator > 0, numerator / np.where(denominator > 0, denominator, 1.0), np.nan))
