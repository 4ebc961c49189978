"""Loads of one frame, fitted through the pressure law and the full forward map: none, one, two, or an edge.

Contacts in load space are pressures (place, force, width, length), not bumps of conductivity. They add before the law
that turns pressure into conductivity, which saturates; bumps that add leave misfits of 7 to 9 on two contacts where the
noise is 1. With p the pressure of all loads and f the law, the readings are those of the conductivity sigma f(p g).

The gain g = exp(std field) of the contact layer is not known, and it is what errs: it moves a load, bends it and splits
it. It is marginalised to first order. With G the slopes of the r whitened readings y in the modes of the field at the
fit, and e the part of the signal by which all else errs, errors have the covariance (1 + e^2 |y|^2 / r) I + G G', and
each kind of load is fitted again with it. Kinds are compared by their evidence in Laplace's approximation (MacKay 1992,
Neural Comput. 4), so that probabilities and covariances hold the model's error as well as the noise.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.scipy.special import erf
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import require_known, verb
from ..effects.material import ContactPiezoresistance
from ..imaging.noise import InverseError, Whitening, whitened_readings
from ..least_squares import ImplicitStep
from ..linalg import lapack
from ..model.discretisation import Model
from ..model.forward_model import conductivity, forward
from .bump_responses import mean_conductivity, points_of
from .fit import SOLVER
from .preparation import sheet_of
from .result import Contacts

FULL, TRIAL = 25, 4  # steps of a fit, and of one that is compared with other starts
REACH = np.array([0.0, 0.25, 0.5, 0.75]) * np.pi  # directions in which a contact is split for a start
SPLIT = 0.013  # m, by which both halves are moved
KEPT_STARTS = 2  # of the trials of two contacts, that are fitted to the end


class LoadKind(IntEnum):
    """What touches the sheet."""

    NONE = 0
    ONE = 1
    TWO = 2
    EDGE = 3


@dataclass(frozen=True)
class LoadSettings:
    """What is known of loads before a frame, and of how the sheet answers to pressure.

    | meaning                                                                      | default      | unit |
    |------------------------------------------------------------------------------|--------------|------|
    | law: factor of conductivity by pressure                                      | Hill, 20 kPa |      |
    | gain: standard deviation of the log gain of the contact layer                | 0.12         | 1    |
    | gain_length: over which it changes                                           | 0.015        | m    |
    | model_error: part of the signal by which mesh, coat and shape of a load err  | 0.005        | 1    |
    | width, width_spread: median of a load's width, standard deviation of its log | 0.012, 0.4   | m, 1 |
    | force, force_spread: median of a force, standard deviation of its log        | 8, 1.2       | N, 1 |
    | length: standard deviation of half an edge, in each direction                | 0.02         | m    |
    | prior: probabilities of none, one, two and an edge                           | 1/4 each     | 1    |

    Raises:
        InverseError: for a value out of range.
    """

    law: ContactPiezoresistance = field(default_factory=ContactPiezoresistance)
    gain: float = 0.12
    gain_length: float = 0.015
    model_error: float = 0.005
    width: float = 0.012
    width_spread: float = 0.4
    force: float = 8.0
    force_spread: float = 1.2
    length: float = 0.02
    prior: tuple[float, float, float, float] = (0.25, 0.25, 0.25, 0.25)

    def __post_init__(self) -> None:
        for name in ("gain_length", "width", "width_spread", "force", "force_spread", "length"):
            if not 0 < getattr(self, name) < np.inf:
                raise InverseError(f"{name} is {getattr(self, name)}; give a number above zero")
        for name in ("gain", "model_error"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InverseError(f"{name} is {getattr(self, name)}; give 0 or more")
        if len(self.prior) != 4 or min(self.prior) < 0 or not np.isclose(sum(self.prior), 1):
            raise InverseError(f"prior is {self.prior}; give four probabilities whose sum is 1")


class LoadShape(eqx.Module):
    """Loads of one kind, as they explain a frame best.

    | meaning                                                                         | shape  | unit  |
    |---------------------------------------------------------------------------------|--------|-------|
    | position in the sheet's flat coordinates; of an edge, its middle                | (n, 2) | m     |
    | width: standard deviation of the load, across an edge                           | (n,)   | m     |
    | force                                                                           | (n,)   | N     |
    | half: from the middle of an edge to its end; zero for others                    | (n, 2) | m     |
    | covariance of all parameters: x, y, log width, log force of each load, half of an edge | (m, m) | mixed |
    | misfit: chi-square over the number of readings, with the covariance of the model's error | ()     | 1     |
    """

    position: Float[Array, "n 2"]
    width: Float[Array, " n"]
    force: Float[Array, " n"]
    half: Float[Array, "n 2"]
    covariance: Float[Array, "m m"]
    misfit: Float[Array, ""]


class Loads(eqx.Module):
    """What a `LoadFitter` finds in a frame.

    | meaning                                            | shape |
    |----------------------------------------------------|-------|
    | probability of none, one, two and an edge          | (4,)  |
    | one, two, edge: the best loads of each kind        |       |
    """

    probability: Float[Array, "4"]
    one: LoadShape
    two: LoadShape
    edge: LoadShape

    @property
    def kind(self) -> LoadKind:
        """The most probable kind."""
        return LoadKind(int(np.argmax(np.asarray(self.probability))))

    @property
    def best(self) -> LoadShape | None:
        """The loads of the most probable kind; None: nothing touches the sheet."""
        return {LoadKind.ONE: self.one, LoadKind.TWO: self.two, LoadKind.EDGE: self.edge}.get(self.kind)


class _Fit(NamedTuple):
    """Fitted parameters (m,), the sum of squares with that of the prior, and half its second derivatives (m, m)."""

    flat: Float[Array, " m"]
    square: Float[Array, ""]
    normal: Float[Array, "m m"]


class LoadFitter(eqx.Module):
    """Fits loads to frames; made by `prepare_loads`, called with a frame and the contacts that a finder saw in it."""

    model: Model
    sigma: Float[Array, " elements"]
    untouched: Float[Array, " readings"]
    background: Float[Array, ""]
    whitening: Whitening
    compress: Float[Array, "r k"]
    points: Float[Array, "elements q 2"]
    weights: Float[Array, " q"]
    modes: Float[Array, "elements q g"]
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    law: ContactPiezoresistance
    usual: Float[Array, "2"]
    spread: Float[Array, "2"]
    length: Float[Array, ""]
    prior: Float[Array, "4"]
    model_error: Float[Array, ""]

    def __call__(self, dv: Float[ArrayLike, " readings"], contacts: Contacts) -> Loads:
        """Loads of one difference frame (readings,) V, from the contacts that a `ContactFinder` saw in it.

        Raises:
            InverseError: if the frame has another shape, or a reading that is used is not finite.
        """
        require_known("LoadFitter", InverseError, dv, contacts)
        dv, used = np.asarray(dv, float), np.asarray(self.whitening.channels)
        if dv.shape != used.shape or contacts.present.ndim != 1:
            raise InverseError(f"dv has shape {dv.shape}; fit one frame of {len(used)} readings at a time")
        if not np.isfinite(dv[used]).all():
            first = int(np.argmax(used & ~np.isfinite(dv)))
            raise InverseError(f"reading {first} is not finite; leave its channel out")
        return _fitted(self, jnp.asarray(dv, self.model.dtype), contacts)

    # --- from loads to readings

    def white(self, dv: Float[Array, " readings"]) -> Float[Array, " r"]:
        """Whitened readings."""
        return self.compress @ self.whitening.sums(dv)

    def response(self, flat: Float[Array, " m"], gain: Float[Array, " g"] | None = None) -> Float[Array, " r"]:
        """Whitened readings of loads, whose number of parameters says the kind: 4 for each, 6 for an edge."""
        spots = [self._line(flat)] if flat.shape == (6,) else [self._spot(one) for one in flat.reshape(-1, 4)]
        pressure = jnp.stack(spots).sum(0)
        if gain is not None:
            pressure = pressure * jnp.exp(self.modes @ gain)
        factor = self.law.factor(pressure) @ self.weights
        return self.white(forward(self.model, self.sigma * factor) - self.untouched)

    def _spot(self, one: Float[Array, "4"]) -> Float[Array, "elements q"]:
        """Pressure of a round load: Gaussian."""
        variance = jnp.exp(2 * one[2])
        square = jnp.sum((self.points - one[:2]) ** 2, -1)
        return jnp.exp(one[3] - 0.5 * square / variance) / (2 * jnp.pi * variance)

    def _line(self, one: Float[Array, "6"]) -> Float[Array, "elements q"]:
        """Pressure of an edge: even along a line, blurred by a Gaussian."""
        width, half = jnp.exp(one[2]), jnp.sqrt(one[4:] @ one[4:] + 1e-10)  # m; a length of zero has no direction
        away = self.points - one[:2]
        along = away @ one[4:] / half
        across = jnp.sum(away**2, -1) - along**2
        root = jnp.sqrt(2.0) * width
        spread = (erf((along + half) / root) - erf((along - half) / root)) / (4 * half)
        return jnp.exp(one[3] - 0.5 * across / width**2) * spread / (jnp.sqrt(2 * jnp.pi) * width)

    # --- fits

    def surprise(self, flat: Float[Array, " m"]) -> Float[Array, " s"]:
        """What is unusual of loads, in standard deviations: log width, log force, half length of an edge."""
        rows = flat[:4].reshape(1, 4) if flat.shape == (6,) else flat.reshape(-1, 4)
        own = ((rows[:, 2:] - self.usual) / self.spread).ravel()
        return jnp.concatenate([own, flat[4:] / self.length]) if flat.shape == (6,) else own

    def fit(
        self, y: Float[Array, " r"], start: Float[Array, " m"], steps: int, root: Float[Array, "r r"] | None = None
    ) -> _Fit:
        """The best loads near a start, with errors of covariance `root` `root`' (default: of noise alone)."""
        low, high = self.bounds(len(start))

        def residual(flat: Float[Array, " m"], of: tuple[Any, ...]) -> Float[Array, " n"]:
            fitter, y, root = of
            left = y - fitter.response(flat)
            left = left if root is None else lapack.solve_triangular(root, left, lower=True)
            return jnp.concatenate([left, fitter.surprise(flat)])

        found: optx.Solution[Array, Any] = optx.least_squares(
            residual,
            SOLVER,
            jnp.clip(start, low, high),
            (self, y, root),
            {"lower": low, "upper": high},
            max_steps=steps + 1,
            adjoint=ImplicitStep(),
            throw=False,
        )
        return _Fit(found.value, found.state.square, found.state.quadratic.hessian.matrix)

    def bounds(self, size: int) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Lowest and highest parameters: on the sheet, and within four deviations of what is usual."""
        rows = 1 if size == 6 else size // 4
        edge = jnp.full(size - 4 * rows, 4 * self.length)
        four = jnp.append(self.low, self.usual - 4 * self.spread), jnp.append(self.high, self.usual + 4 * self.spread)
        return jnp.append(jnp.tile(four[0], rows), -edge), jnp.append(jnp.tile(four[1], rows), edge)

    def errors_of_model(self, y: Float[Array, " r"], flat: Float[Array, " m"]) -> Float[Array, "r r"]:
        """Cholesky factor of the covariance of errors: noise, slopes of the readings in the modes of the gain, rest."""
        slopes = jax.jacfwd(lambda gain: self.response(flat, gain))(jnp.zeros(self.modes.shape[-1], flat.dtype))
        even = 1 + self.model_error**2 * (y @ y) / len(y)
        found: Array = lapack.cholesky(even * jnp.eye(len(y), dtype=y.dtype) + slopes @ slopes.T, lower=True)
        return found

    def finished(self, y: Float[Array, " r"], start: Float[Array, " m"]) -> tuple[LoadShape, Float[Array, ""]]:
        """The loads fitted with the errors of the gain, and the log of their evidence."""
        root = self.errors_of_model(y, start)
        found = self.fit(y, start, FULL // 2, root)
        size, count = len(found.flat), 1 if len(found.flat) == 6 else len(found.flat) // 4
        area = jnp.prod(self.high - self.low)
        norms = -count * (jnp.log(area) + jnp.sum(jnp.log(self.spread)) + np.log(2 * np.pi))
        # Orders of two loads and ends of an edge that are alike: two.
        norms += 0.0 if size == 4 else np.log(2.0)
        norms -= 2 * jnp.log(self.length) + np.log(2 * np.pi) if size == 6 else 0.0
        factor = lapack.cholesky(found.normal + 1e-9 * jnp.diag(jnp.diag(found.normal)), lower=True)
        half_volume = jnp.sum(jnp.log(jnp.diag(factor)))
        evidence = (
            norms - 0.5 * found.square - jnp.sum(jnp.log(jnp.diag(root))) + 0.5 * size * np.log(2 * np.pi) - half_volume
        )
        inverse = lapack.solve_triangular(factor, jnp.eye(size, dtype=y.dtype), lower=True)
        return self._shape(found, inverse.T @ inverse, y), evidence

    def _shape(self, found: _Fit, covariance: Float[Array, "m m"], y: Float[Array, " r"]) -> LoadShape:
        flat, edge = found.flat, found.flat.shape == (6,)
        rows = flat[:4].reshape(1, 4) if edge else flat.reshape(-1, 4)
        half = flat[4:][None] if edge else jnp.zeros((len(rows), 2), flat.dtype)
        left = found.square - self.surprise(flat) @ self.surprise(flat)
        return LoadShape(rows[:, :2], jnp.exp(rows[:, 2]), jnp.exp(rows[:, 3]), half, covariance, left / len(y))

    # --- starts

    def single(self, contacts: Contacts) -> Float[Array, "4"]:
        """One load in the place of all contacts."""
        rows, weight = self.rows(contacts), jnp.where(contacts.present, contacts.strength, 0)
        share = weight / jnp.maximum(weight.sum(), jnp.finfo(weight.dtype).tiny)
        middle = share @ rows[:, :3]
        return jnp.append(middle, jax.nn.logsumexp(jnp.where(contacts.present, rows[:, 3], -jnp.inf)))

    def rows(self, contacts: Contacts) -> Float[Array, "K 4"]:
        """Contacts as loads: the force whose pressure changes the middle of the bump as much."""
        width = jnp.maximum(contacts.width, 1e-3)
        change = jnp.clip(contacts.amplitude / self.background / self.law.amplitude, 0.01, 0.95)
        pressure = self.law.half_pressure * (change / (1 - change)) ** (1 / self.law.exponent)
        force = jnp.log(2 * jnp.pi * width**2 * pressure)
        return jnp.concatenate([contacts.position, jnp.log(width)[:, None], force[:, None]], 1)


def _split(one: Float[Array, "4"], step: Float[Array, "2"]) -> Float[Array, "8"]:
    """A load as two narrower ones."""
    own = jnp.append(one[2] - 0.3, one[3] - np.log(2.0))
    return jnp.concatenate([one[:2] + step, own, one[:2] - step, own])


@verb
def _fitted(fitter: LoadFitter, dv: Float[Array, " readings"], contacts: Contacts) -> Loads:
    y = fitter.white(dv)
    guess = fitter.single(contacts)
    one = fitter.fit(y, guess, FULL).flat
    two = _best_two(fitter, y, one, contacts)
    edge = _best_edge(fitter, y, one, two)
    found = [fitter.finished(y, start) for start in (one, two, edge)]
    evidence = jnp.stack([-0.5 * y @ y, *(log for _, log in found)])
    evidence = jnp.where(jnp.isfinite(evidence), evidence, -jnp.inf) + jnp.log(fitter.prior)
    none = ~contacts.present.any()
    probability = jnp.where(none, jnp.eye(4, dtype=y.dtype)[0], jax.nn.softmax(evidence))
    return Loads(probability, *(shape for shape, _ in found))


def _best_two(
    fitter: LoadFitter, y: Float[Array, " r"], one: Float[Array, "4"], contacts: Contacts
) -> Float[Array, "8"]:
    """Two loads, from the contacts of the finder and from the single load split in several directions."""
    steps = SPLIT * jnp.stack([jnp.cos(REACH), jnp.sin(REACH)], 1).astype(y.dtype)
    starts = jax.vmap(lambda step: _split(one, step))(steps)
    if contacts.present.shape[0] > 1:
        both = jnp.where(contacts.present[1], fitter.rows(contacts)[:2].ravel(), starts[0])
        starts = jnp.concatenate([both[None], starts])
    tried = jax.lax.map(lambda start: fitter.fit(y, start, TRIAL), starts)
    kept = tried.flat[jnp.argsort(tried.square)[:KEPT_STARTS]]
    found = jax.lax.map(lambda start: fitter.fit(y, start, FULL), kept)
    best: Array = found.flat[jnp.argmin(found.square)]
    return best


def _best_edge(
    fitter: LoadFitter, y: Float[Array, " r"], one: Float[Array, "4"], two: Float[Array, "8"]
) -> Float[Array, "6"]:
    """An edge, from the two loads at its ends and from the single load made long."""
    rows = two.reshape(2, 4)
    share = jax.nn.softmax(rows[:, 3])
    between = [share @ rows[:, :3], jax.nn.logsumexp(rows[:, 3])[None], 0.8 * (rows[1, :2] - rows[0, :2])]
    narrow = one.at[2].add(-0.4)
    longer = [jnp.append(narrow, SPLIT * jnp.asarray(way, y.dtype)) for way in ((1.0, 0.0), (0.0, 1.0))]
    tried = jax.lax.map(lambda s: fitter.fit(y, s, TRIAL), jnp.stack([jnp.concatenate(between), *longer]))
    return fitter.fit(y, tried.flat[jnp.argmin(tried.square)], FULL).flat


def prepare_loads(
    model: Model,
    settings: LoadSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> LoadFitter:
    """Prepare the fit of loads to frames of a skin, for use offline.

    Args:
        model: of edges not above 0.04 of the sheet; a draft moves a load by 0.15 mm, which is in no covariance.
        settings: default `LoadSettings()`.
        noise, untouched, sigma, channels: as for `prepare_contacts`.

    Raises:
        InverseError: as for `prepare_contacts`.
    """
    require_known("prepare_loads", InverseError, model, noise, untouched, sigma, channels)
    settings = settings or LoadSettings()
    sigma = sheet_of(model, untouched, sigma, channels)
    found = whitened_readings(model, noise, channels)
    sigma = conductivity(model) if sigma is None else jnp.asarray(sigma, model.dtype)
    points, weights = points_of(model, settings.width)
    chart = np.asarray(model.chart, float)
    low, high = chart.min(0), chart.max(0)
    modes = _gain_modes(points, low, high, settings.gain_length)
    numbers = {
        "background": mean_conductivity(model, np.asarray(sigma, float)),
        "compress": found.compress,
        "points": points,
        "weights": weights,
        "modes": settings.gain * modes,
        "low": low,
        "high": high,
        "usual": np.log([settings.width, settings.force]),
        "spread": [settings.width_spread, settings.force_spread],
        "length": settings.length,
        "prior": settings.prior,
        "model_error": settings.model_error,
    }
    return LoadFitter(
        model=model,
        sigma=sigma,
        untouched=forward(model, sigma),
        whitening=found.whitening,
        law=settings.law,
        **{name: jnp.asarray(number, model.dtype) for name, number in numbers.items()},
    )


def _gain_modes(
    points: Float[np.ndarray, "elements q 2"], low: np.ndarray, high: np.ndarray, length: float
) -> Float[np.ndarray, "elements q g"]:
    """Modes of a Gaussian field of variance one at points: bumps whose sum of products is exp(-d^2 / 2 length^2)."""
    axes = [np.arange(a - length, b + 1.5 * length, length) for a, b in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    modes = np.exp(-((points[:, :, None] - nodes) ** 2).sum(-1) / length**2)
    return np.asarray(modes / np.sqrt(np.mean((modes**2).sum(-1))))
