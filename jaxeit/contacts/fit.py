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
# Positions of the four bumps of an oblong contact, in half lengths.
LINE_PLACES = np.array([-0.75, -0.25, 0.25, 0.75])

# Map from all parameters of a fit to its bumps.
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
    | square: residual sum of squares                                 | ()    |
    | converged                                                       | ()    |
    """

    flat: Float[Array, " m"]
    square: Float[Array, ""]
    converged: Bool[Array, ""]


class FitState(NamedTuple):
    """An iterate of a fit: the parameters (m,) accepted last, and the state of the solver."""

    flat: Float[Array, " m"]
    state: LeastSquaresState

    @property
    def square(self) -> Float[Array, "..."]:
        """Residual sum of squares."""
        return self.state.square

    @property
    def fit(self) -> ContactFit:
        """The fit at this iterate."""
        return ContactFit(self.flat, self.state.square, self.state.converged)


def contact_rows(flat: Float[Array, " parameters"]) -> Float[Array, "contacts 4"]:
    """Contacts (x, y, log width, strength) from all parameters."""
    return flat.reshape(-1, 4)


def bumps_on_line(flat: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Four bumps that share the strength of one contact, on a line of half length (flat[4], flat[5])."""
    count = len(LINE_PLACES)
    centre = flat[:2] + jnp.asarray(LINE_PLACES, flat.dtype)[:, None] * flat[4:]
    rest = jnp.broadcast_to(flat[2:4] * jnp.array([1, 1 / count], flat.dtype), (count, 2))
    return jnp.concatenate([centre, rest], 1)


class FrameResponse(eqx.Module):
    """Forward model of the signal in a frame, and the bounds of its contacts.

    | meaning                                                                          | shape      |
    |----------------------------------------------------------------------------------|------------|
    | responses: table of responses                                                    |            |
    | low, high: bounds of x, y, log width, strength                                   | (4,), (4,) |
    | root: whitens responses if readings are missing (`imaging.missing`)              | (r, r)     |
    | whole: no reading is missing, and responses need no whitening                    | ()         |
    """

    responses: Responses
    low: Float[Array, "4"]
    high: Float[Array, "4"]
    root: Float[Array, "r r"]
    whole: Bool[Array, ""]

    def response(self, theta: Float[Array, "n 4"]) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
        """Signal of n contacts in the frame, and its slopes."""
        value, slopes = self.responses.contacts(theta)

        def whiten(
            value: Float[Array, " r"], slopes: Float[Array, "r n 4"]
        ) -> tuple[Float[Array, " r"], Float[Array, "r n 4"]]:
            return self.root @ value, jnp.tensordot(self.root, slopes, 1)

        observed: tuple[Array, Array] = jax.lax.cond(self.whole, lambda *a: a, whiten, value, slopes)
        return observed

    def whiten(self, response: Float[Array, " r"]) -> Float[Array, " r"]:
        """Whiten a response as the readings of the frame, of which some may be missing."""
        observed: Array = jax.lax.cond(self.whole, lambda r: r, lambda r: self.root @ r, response)
        return observed

    def fit(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> ContactFit:
        """The best n contacts near these."""
        return self._solve(y, theta.ravel(), MAX_STEPS + 1).fit

    def trial_fit(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> FitState:
        """The first `TRIAL_STEPS` steps of a fit of n contacts."""
        return self._solve(y, theta.ravel(), TRIAL_STEPS + 1)

    def init(self, y: Float[Array, " r"], theta: Float[Array, "n 4"]) -> FitState:
        """The initial state of a fit, before the first step."""
        problem = self._problem(y, contact_rows)
        start = theta.ravel()
        state = SOLVER.init(_residual, start, problem, {"quadratic": _quadratic}, None, None, frozenset())
        return FitState(start, state)

    def finish(
        self, y: Float[Array, " r"], iterate: FitState, aim: Float[Array, ""], outlook: Int[Array, ""]
    ) -> ContactFit:
        """Continue a fit; give it up where chi-square would not be below ``aim`` after ``outlook`` more falls."""
        options = {"state": iterate.state, "aim": aim / 2, "outlook": outlook}
        return self._solve(y, iterate.flat, MAX_STEPS, options).fit

    def fit_oblong(self, y: Float[Array, " r"], pair: Float[Array, "2 4"]) -> ContactFit:
        """Fit one oblong contact from the moments of two: x, y, log width, strength and half length along x and y."""
        share = pair[:, 3] / jnp.maximum(pair[:, 3].sum(), jnp.finfo(y.dtype).tiny)
        half = jnp.sqrt(3 * share[0] * share[1]) * (pair[1, :2] - pair[0, :2])  # equal second moment
        start = jnp.concatenate([share @ pair[:, :3], pair[:, 3].sum()[None], half])
        low, high = self._bounds(bumps_on_line, 6)
        return self._solve(y, jnp.clip(start, low, high).astype(y.dtype), MAX_STEPS + 1, shape=bumps_on_line).fit

    def _bounds(self, shape: Shape, size: int) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        if shape is contact_rows:
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
        shape: Shape = contact_rows,
    ) -> FitState:
        low, high = self._bounds(shape, len(start))
        solution: optx.Solution[Array, Any] = optx.least_squares(
            _residual,
            SOLVER,
            start,
            self._problem(y, shape),
            {"quadratic": _quadratic, "lower": low, "upper": high, **(options or {})},
            max_steps=max_steps,
            adjoint=ImplicitStep(),
            throw=False,
        )
        return FitState(solution.value, solution.state)

    def linearise(
        self, y: Float[Array, " r"], theta: Float[Array, "n 4"], present: Bool[Array, " n"]
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4 4"]]:
        """Linearise the fit: contacts with their derivatives with respect to y, and their covariances.

        At the minimum a Gauss-Newton step is next to zero, but its derivative is that of the minimum.
        """
        value, slopes = self.response(theta)
        j = jnp.where(present[:, None], slopes, 0).reshape(len(y), -1)
        inverse = normal_inverse(j.T @ j, jnp.repeat(present, 4))
        step = inverse(j.T @ (y - value)).reshape(theta.shape)
        covariance = inverse(jnp.eye(theta.size, dtype=y.dtype))
        slot = np.arange(len(theta))
        blocks = covariance.reshape(*theta.shape, *theta.shape)[slot, :, slot]
        return theta + (step - jax.lax.stop_gradient(step)), blocks


class _FrameProblem(NamedTuple):
    """The least-squares problem of one frame: its whitened readings (r,), and the shape of the contacts."""

    bumps: FrameResponse
    y: Float[Array, " r"]
    shape: Shape


def _residual(flat: Float[Array, " m"], problem: _FrameProblem) -> Float[Array, " r"]:
    return problem.y - problem.bumps.response(problem.shape(flat))[0]


def _quadratic(flat: Float[Array, " m"], problem: _FrameProblem) -> HalfSquares:
    """Normal equations by the slopes of the response, with no further differentiation of it."""
    theta = problem.shape(flat)
    value, slopes = problem.bumps.response(theta)
    slopes = slopes.reshape(len(value), -1)
    if problem.shape is not contact_rows:
        slopes = slopes @ jax.jacfwd(problem.shape)(flat).reshape(theta.size, -1)
    return normal_equations(problem.y - value, -slopes)


def contact_bounds(x: np.ndarray, y: np.ndarray, widths: tuple[float, float]) -> dict[str, list[float]]:
    """Bounds of x, y, log width and strength."""
    low, high = ([np.min(x), np.min(y), np.log(widths[0]), 0], [np.max(x), np.max(y), np.log(widths[1]), np.inf])
    return {"low": low, "high": high}
