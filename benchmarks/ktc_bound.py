"""What readings of a phantom tell of its outline: how probable the true one is beside one that was found.

Errors of readings are believed to be independent,
as `je.imaging.segment` takes them, or to have parts that readings have in common: gains of drives, offsets of sensing
pairs, the level of the water, contacts and places of electrodes. `ktc_phantoms` says how large these are.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

import jaxeit as je

from .ktc_phantoms import (
    ANGLE,
    CONDUCTIVE,
    CONTACTS,
    CORNER_SHARES,
    DRIVE,
    GRID,
    INSIDE,
    MOVED_CONTACT,
    MOVED_DEPTH,
    MOVED_DRIVE,
    MOVED_OFFSET,
    RADIUS,
    WATER,
    Data,
)
from .rows import Row

INDEPENDENT = 0.2  # of the errors of `segment`: what readings do not have in common
HEIGHTS = (0.5, 4.5)  # ends of the logarithm of a conductivity over the water's


def compared(model: je.Model, image: je.model.BasisMap, missed: np.ndarray, data: Data, place: int) -> Row:
    """Scores and objectives of fits from the image and from the truth; log odds of the truth over what is found."""
    frame, truth = data.frames[place], data.truth[place]
    fits = {"image": je.imaging.segment(model, data.reference, frame, image, missed=missed)}
    fits["truth"] = je.imaging.segment(model, data.reference, frame, image, start=truth[::-1], missed=missed)
    row: Row = {}
    for start, fit in fits.items():
        classes = np.where(INSIDE, fit.classes[::-1], WATER)
        row[f"{start}_score"] = round(float(je.metrics.ktc_score(classes, truth)), 3)
        row |= {f"{start}_misfit": round(float(fit.misfit), 3), f"{start}_objective": round(float(fit.objective), 1)}
    seen = Seen(model, data, frame, np.asarray(fits["image"].errors))
    found = np.mean(model.background) * jnp.exp(image.expand(fits["image"].pieces))
    alone, common = log_odds(seen, truth, found)
    return row | {"log_odds": round(alone, 1), "log_odds_common": round(common, 1)}


class Seen(NamedTuple):
    """A phantom's frame: model of the water; pattern; reference, frame and errors of `segment`, (readings,) V."""

    model: je.Model
    data: Data
    frame: np.ndarray
    errors: np.ndarray

    @property
    def used(self) -> np.ndarray:
        """Readings that there are."""
        return np.isfinite(self.frame)

    def left(self, sigma: jnp.ndarray) -> np.ndarray:
        """What a conductivity leaves of the change, V, of the readings that there are."""
        change = np.asarray(_read(self.model, sigma) - _read(self.model, self.model.background))
        return (self.frame - self.data.reference - change)[self.used]


def covered(model: je.Model, classes: np.ndarray) -> np.ndarray:
    """Share of each triangle that is not water, above zero where it conducts more; of classes with row 0 at +y."""
    corners = np.asarray(model.chart)[np.asarray(model.triangles)] / RADIUS
    points = np.einsum("sc,ecd->esd", CORNER_SHARES, corners)
    columns, rows = (np.rint((way * points[..., axis] + 1) / 2 * (GRID - 1)) for axis, way in ((0, 1), (1, -1)))
    place = (np.clip(index, 0, GRID - 1).astype(int) for index in (rows, columns))
    signs = np.where(classes == WATER, 0, np.where(classes == CONDUCTIVE, 1, -1))
    return signs[tuple(place)].mean(1)


def log_odds(seen: Seen, truth: np.ndarray, found: jnp.ndarray) -> tuple[float, float]:
    """Logarithm of the probability of the readings by the true classes, (256, 256), over that by the conductivity that
    was found, (elements,) S: of errors that are independent, and of errors in common.

    The pieces of the truth have one height, the one that explains the readings best.
    """
    share, errors = covered(seen.model, truth), seen.errors[seen.used]

    def of_truth(height: float) -> jnp.ndarray:
        return seen.model.background * jnp.exp(jnp.asarray(height * share))

    def alone(sigma: jnp.ndarray) -> float:
        return float(0.5 * np.sum((seen.left(sigma) / errors) ** 2))

    best = _least(lambda height: alone(of_truth(height)))
    columns = [common_errors(seen, sigma)[seen.used] for sigma in (of_truth(best.x), found)]

    def common(sigma: jnp.ndarray, columns: np.ndarray) -> float:
        return surprise(seen.left(sigma), INDEPENDENT * errors, columns)

    in_common = _least(lambda height: common(of_truth(height), columns[0]))
    return alone(found) - best.fun, common(found, columns[1]) - in_common.fun


def _least(cost: Callable[[float], float]) -> Any:
    return minimize_scalar(cost, bounds=HEIGHTS, method="bounded", options={"xatol": 0.02})


def surprise(left: np.ndarray, errors: np.ndarray, columns: np.ndarray) -> float:
    """Minus the logarithm of the density of what is left, over that of zeros without N: Gaussian, of covariance
    ``D^2 + N N^T``, of independent errors D and columns N of errors in common."""
    left, columns = left / errors, columns / errors[:, None]
    factor = cho_factor(np.eye(columns.shape[1]) + columns.T @ columns)
    sums = columns.T @ left
    return float(0.5 * (left @ left - sums @ cho_solve(factor, sums)) + np.sum(np.log(np.diag(factor[0]))))


def common_errors(seen: Seen, sigma: jnp.ndarray) -> np.ndarray:
    """Errors of the change that readings have in common, (readings, k) V: a column for each, of one standard error."""
    pattern, even = seen.data.pattern, seen.model.background
    drives, pairs = (np.eye(n.max() + 1)[n.ravel()] for n in map(_numbers, (pattern[:, :2], pattern[:, 2:])))
    before, after = (np.asarray(_read(seen.model, s))[:, None] for s in (even, sigma))
    touch = np.asarray(_by_contacts(seen.model, sigma))
    aside = je.model.electrode_motion(seen.model)
    moved = [np.asarray(je.model.shift_jacobian(seen.model, aside, s)).reshape(len(after), -1) for s in (even, sigma)]
    return np.hstack(
        [
            DRIVE * (after - before) * drives,
            MOVED_DRIVE * after * drives,
            MOVED_OFFSET * pairs,
            MOVED_DEPTH * after,
            CONTACTS * (touch - np.asarray(_by_contacts(seen.model, even))),
            MOVED_CONTACT * touch,
            ANGLE * RADIUS * (moved[1] - moved[0]),
        ]
    )


def _numbers(pairs: np.ndarray) -> np.ndarray:
    return np.unique(pairs, axis=0, return_inverse=True)[1]


@eqx.filter_jit
def _read(model, sigma):
    return je.forward(model, sigma)


@eqx.filter_jit
def _by_contacts(model, sigma):
    """Derivative of the readings by the logarithm of each contact conductance, (readings, electrodes) V."""

    def read(logarithm):
        return je.forward(eqx.tree_at(lambda m: m.contact, model, model.contact * jnp.exp(logarithm)), sigma)

    _, change = jax.linearize(read, jnp.zeros_like(model.contact))
    return jax.vmap(change)(jnp.eye(model.electrodes)).T
