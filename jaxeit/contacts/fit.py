"""The fit of a given number of bumps to one frame, by `LevenbergMarquardt`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..least_squares import DampingSearch, ImplicitStep, LeastSquaresState, LevenbergMarquardt, normal_equations
from ..least_squares.searches import HalfSquares, normal_inverse
from .bump_responses import Responses

# Largest half length of an oblong contact, m.
MAX_HALF_LENGTH = 0.04
# Largest number of steps of a fit, and number of steps after which it is compared with others.
MAX_STEPS, TRIAL_STEPS = 20, 4
# Places of the four bumps along the half length of an oblong contact.
PLACES_ALONG = np.array([-0.75, -0.25, 0.25, 0.75])

# From all parameters of a fit to the bumps that they stand for.
Shape = Callable[[Array], Array]

# A fit ends where chi-square will fall by less than a thousandth, or by less than 1e-4 of itself: half of chi-square is
# what is minimised. The damping starts higher and changes less than by default, as starts lie far from the minimum.
SOLVER = LevenbergMarquardt(
    rtol=0.0,
    atol=0.0,
    fall_rtol=1e-4,
    fall_atol=0.5e-3,
    search=DampingSearch(first=1e-2, after_descent=0.2, after_ascent=5.0),
    patience=TRIAL_STEPS,
)


class ContactFit(NamedTuple):
    """Fitted parameters.

    | meaning                                                         | shape |
    |-----------------------------------------------------------------|-------|
    | flat: all parameters, four for each contact                     | (m,)  |
    | square: sum of the squares of what the contacts do not explain  | ()    |
    | converged                                                       | ()    |
    """

    flat: Float[Array, " m"]
    square: Float[Array, ""]
    converged: Bool[Array, ""]


class UnfinishedFit(NamedTuple):
    """Parameters (m,) accepted last, and the state of the solver."""

    flat: Float[Array, " m"]
    state: LeastSquaresState

    @property
    def square(self) -> Float[Array, "..."]:
        """Sum of the squares of what the contacts do not explain."""
        return self.state.square

    @property
    def fit(self) -> ContactFit:
        """The fit as it is."""
        return ContactFit(self.flat, self.state.square, self.state.converged)


def one_row_each(flat: Float[Array, " parameters"]) -> Float[Array, "contacts 4"]:
    """Contacts (x, y, log width, strength) from all parameters."""
    return flat.reshape(-1, 4)


def bumps_along(flat: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """One contact along a line of half length (flat[4], flat[5]): four bumps that share its strength."""
    count = len(PLACES_ALONG)
    centre = flat[:2] + jnp.asarray(PLACES_ALONG, flat.dtype)[:, None] * flat[4:]
    rest = jnp.broadcast_to(flat[2:4] * jnp.array([1, 1 / count], flat.dtype), (count, 2))
    return jnp.concatenate([centre, rest], 1)


class FrameResponse(eqx.Module):
    """How the numbers that a frame holds depend on contacts, and within which bounds contacts are looked for.

    | meaning                                                                          | shape      |
    |----------------------------------------------------------------------------------|------------|
    | responses: table of responses                                                    |            |
    | low, high: bounds of x, y, log width, strength                                   | (4,), (4,) |
    | root: mixes responses as missing readings ask for (`imaging.missing`)            | (r, r)     |
    | whole: no reading is missing, and responses are taken as they are                | ()         |
    """

    responses: Responses
    low: Float[Array, "4"]
    high: Float[Array, "4"]
    root: Float[Array, "r r"]
    whole: Bool[Array, ""]

    def response(self, theta: Float[Array, "n 4"]) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
        """What n contacts do to the numbers that the frame holds, and its slopes."""
        value, slopes = self.responses.contacts(theta)

        def mixed(
            value: Float[Array, " r"], slopes: Float[Array, "r n 4"]
        ) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
            return self.root @ value, jnp.tensordot(self.root, slopes, 1)

        seen: tuple[Array, Array] = jax.lax.cond(self.whole, lambda *a: a, mixed, value, slopes)
        return seen

    def mixed(self, response: Float[Array, " r"]) -> Float[Array, " r"]:
        """A response as the frame shows it."""
        seen: Array = jax.lax.cond(self.whole, lambda r: r, lambda r: self.root @ r, response)
        return seen

    def fit(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> ContactFit:
        """The best n contacts near these."""
        return self._solve(y, theta.ravel(), MAX_STEPS + 1).fit

    def try_out(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> UnfinishedFit:
        """A few steps towards the best n contacts near these."""
        return self._solve(y, theta.ravel(), TRIAL_STEPS + 1)

    def unstarted(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> UnfinishedFit:
        """A fit without a step."""
        problem = self._problem(y, one_row_each)
        start = theta.ravel()
        state = SOLVER.init(_residual, start, problem, {"quadratic": _quadratic}, None, None, frozenset())
        return UnfinishedFit(start, state)

    def finish(
        self, y: Float[Array, " r"], begun: UnfinishedFit, aim: Float[Array, ""], outlook: Int[Array, ""]
    ) -> ContactFit:
        """A fit to its end; given up where chi-square does not come below ``aim`` within ``outlook`` more falls."""
        options = {"state": begun.state, "aim": aim / 2, "outlook": outlook}
        return self._solve(y, begun.flat, MAX_STEPS, options).fit

    def fit_oblong(self, y: Float[Array, " r"], pair: Float[Array, "2 4"]) -> ContactFit:
        """The best oblong contact in the place of two: x, y, log width, strength and half length along x and y."""
        share = pair[:, 3] / jnp.maximum(pair[:, 3].sum(), jnp.finfo(y.dtype).tiny)
        half = jnp.sqrt(3 * share[0] * share[1]) * (pair[1, :2] - pair[0, :2])  # the same second moment
        start = jnp.concatenate([share @ pair[:, :3], pair[:, 3].sum()[None], half])
        low, high = self._bounds(bumps_along, 6)
        return self._solve(y, jnp.clip(start, low, high).astype(y.dtype), MAX_STEPS + 1, shape=bumps_along).fit

    def _bounds(self, shape: Shape, size: int) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        if shape is one_row_each:
            return jnp.tile(self.low, size // 4), jnp.tile(self.high, size // 4)
        length = jnp.full(2, MAX_HALF_LENGTH, self.low.dtype)
        return jnp.append(self.low, -length), jnp.append(self.high, length)

    def _problem(self, y: Float[Array, " r"], shape: Shape) -> "_FrameProblem":
        return _FrameProblem(self, y, shape)

    def _solve(
        self,
        y: Float[Array, " r"],
        start: Float[Array, " m"],
        max_steps: int,
        options: dict[str, Any] | None = None,
        shape: Shape = one_row_each,
    ) -> UnfinishedFit:
        low, high = self._bounds(shape, len(start))
        found: optx.Solution[Array, Any] = optx.least_squares(
            _residual,
            SOLVER,
            start,
            self._problem(y, shape),
            {"quadratic": _quadratic, "lower": low, "upper": high, **(options or {})},
            max_steps=max_steps,
            adjoint=ImplicitStep(),
            throw=False,
        )
        return UnfinishedFit(found.value, found.state)

    def sensitive(
        self, y: Float[Array, " r"], theta: Float[Array, "n 4"], present: Bool[Array, " n"]
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4 4"]]:
        """Contacts with their derivatives with respect to y, and their covariances.

        A Gauss-Newton step from where the search ended changes next to nothing, but has the right derivative.
        """
        value, slopes = self.response(theta)
        j = jnp.where(present[:, None], slopes, 0).reshape(len(y), -1)
        inverse = normal_inverse(j.T @ j, jnp.repeat(present, 4))
        step = inverse(j.T @ (y - value)).reshape(theta.shape)
        covariance = inverse(jnp.eye(theta.size, dtype=y.dtype))
        slot = np.arange(len(theta))
        own = covariance.reshape(*theta.shape, *theta.shape)[slot, :, slot]
        return theta + (step - jax.lax.stop_gradient(step)), own


class _FrameProblem(NamedTuple):
    """The numbers (r,) of a frame, and contacts of some shape that are to explain them."""

    bumps: FrameResponse
    y: Float[Array, " r"]
    shape: Shape


def _residual(flat: Float[Array, " m"], problem: _FrameProblem) -> Float[Array, " r"]:
    return problem.y - problem.bumps.response(problem.shape(flat))[0]


def _quadratic(flat: Float[Array, " m"], problem: _FrameProblem) -> HalfSquares:
    """The response knows its slopes."""
    theta = problem.shape(flat)
    value, slopes = problem.bumps.response(theta)
    slopes = slopes.reshape(len(value), -1)
    if problem.shape is not one_row_each:
        slopes = slopes @ jax.jacfwd(problem.shape)(flat).reshape(theta.size, -1)
    return normal_equations(problem.y - value, -slopes)


def bounds_of(x: np.ndarray, y: np.ndarray, widths: tuple[float, float]) -> dict[str, list[float]]:
    """Bounds of x, y, log width and strength."""
    low, high = ([np.min(x), np.min(y), np.log(widths[0]), 0], [np.max(x), np.max(y), np.log(widths[1]), np.inf])
    return {"low": low, "high": high}
