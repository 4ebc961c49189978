"""Levenberg-Marquardt within bounds, for `optimistix.least_squares`: curves, contacts and absolute images.

A solver is a descent and a search, and the only loop is that of optimistix. Levenberg and Marquardt's method is
`BoundedDescent` with `DampingSearch`; Gauss and Newton's is `optimistix.NewtonDescent` with a line search.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..messages.spelling import did_you_mean
from .searches import BoundedDescent, Cholesky, DampingSearch, HalfSquares, Parameters, Scalar, normal_equations

OPTIONS = frozenset({"lower", "upper", "curvature", "quadratic", "aim", "outlook", "state"})
"""Names of the options of `LevenbergMarquardt`."""


class LeastSquaresState(eqx.Module):
    """Where a fit stands; `optimistix.Solution.state`, and the option ``state`` of a fit that goes on from there.

    | meaning                                                            | shape |
    |--------------------------------------------------------------------|-------|
    | trial: parameters to be evaluated next                             | (k,)  |
    | quadratic at the parameters last taken; infinite before the first  |       |
    | search: state of the search                                        |       |
    | promised: fall of the objective that the step to the trial promises | ()   |
    | steps: evaluations so far                                          | ()    |
    | converged: the step to the trial is next to nothing                | ()    |
    | hopeless: the objective is further from its aim than it will fall  | ()    |
    """

    trial: Parameters
    quadratic: HalfSquares
    search: Any
    promised: Scalar
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    hopeless: Bool[Array, ""]

    @property
    def square(self) -> Float[Array, "..."]:
        """Sum of squares at the solution: where the fit has converged, after the step to the trial."""
        return 2 * (self.quadratic.f - jnp.where(self.converged, self.promised, 0))


def quadratic_at(
    fn: Callable[..., Any], y: Parameters, args: Any, options: Mapping[str, Any]
) -> tuple[HalfSquares, Any]:
    """The quadratic of half the sum of squares of ``fn`` at y, as `LevenbergMarquardt` takes it, and what else ``fn``
    returns."""
    if "quadratic" in options:
        return options["quadratic"](y, args), None
    residual, push, aux = jax.linearize(lambda at: fn(at, args), y, has_aux=True)
    slopes = jax.vmap(push)(jnp.eye(y.size, dtype=y.dtype))
    weight = options["curvature"](residual) if "curvature" in options else None
    return normal_equations(residual, slopes.T, weight), aux


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver[Parameters, Any, Any, LeastSquaresState]):
    """Bounded least squares for parameters (k,) of order one, one few or some hundreds; use `ImplicitStep` as adjoint.

    ``descent`` proposes each step, and ``search`` its damping. The fit ends with a step of full length that changes no
    parameter (by ``norm``, the largest) by more than ``atol + rtol`` of itself, or that promises a
    fall of the objective, half the sum of squares, by no more than ``fall_atol + fall_rtol`` of itself.  That step is
    taken.  A solution that has not converged has another `optimistix.Solution.result`.

    `options` may hold, each for the problem at hand:

    | option       | meaning                                                                              |
    |--------------|--------------------------------------------------------------------------------------|
    | lower, upper | bounds (k,); they need a `BoundedDescent`                                            |
    | curvature    | function: residuals to the share (n,) of J^T J that is the second derivative of a     |
    |              | robust loss (Triggs et al. 2000, Bundle adjustment, 4.3)                             |
    | quadratic    | function: parameters, args to `normal_equations` (default: by differentiation)       |
    | aim, outlook | given up after `patience` steps where the objective is above ``aim``, and would be     |
    |              | after ``outlook`` falls as the last step promised                                     |
    | state        | of a fit that is to go on                                                            |

    Raises:
        ValueError: when a fit begins, if an option has another name, or bounds are given to a descent without bounds.
    """

    rtol: float
    atol: float
    norm: Callable[[Any], Scalar] = optx.max_norm
    fall_rtol: float | Array | None = None
    fall_atol: float | Array = 0.0
    descent: optx.AbstractDescent[Parameters, Any, Any] = BoundedDescent()
    search: optx.AbstractSearch[Parameters, Any, Any, Any] = DampingSearch()
    patience: int = 4

    def init(
        self,
        fn: Callable[..., Any],
        y: Parameters,
        args: Any,
        options: dict[str, Any],
        f_struct: Any,
        aux_struct: Any,
        tags: frozenset[object],
    ) -> LeastSquaresState:
        """Nothing is known yet: the first step evaluates `y` itself."""
        for unknown in options.keys() - OPTIONS:
            raise ValueError(f"no option {unknown!r}; {did_you_mean(unknown, OPTIONS, f'known: {sorted(OPTIONS)}')}")
        if "state" in options:
            state: LeastSquaresState = options["state"]
            return state
        like = eqx.filter_eval_shape(lambda y: quadratic_at(fn, y, args, options)[0], y)
        empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
        quadratic = eqx.tree_at(lambda q: q.f, empty, jnp.full_like(empty.f, jnp.inf))
        no, none = jnp.asarray(False), jnp.zeros((), y.dtype)
        return LeastSquaresState(y, quadratic, self.search.init(y, like), none, jnp.asarray(0), no, no)

    def step(
        self,
        fn: Callable[..., Any],
        y: Parameters,
        args: Any,
        options: dict[str, Any],
        state: LeastSquaresState,
        tags: frozenset[object],
    ) -> tuple[Parameters, LeastSquaresState, Any]:
        """Evaluate the trial, take it if the search says so, and propose the next."""
        seen, aux = quadratic_at(fn, state.trial, args, options)
        first = state.steps == 0
        size, taken, _, search = self.search.step(first, y, state.trial, state.quadratic, seen, state.search)
        y = jnp.where(taken, state.trial, y)
        known = jax.tree.map(lambda new, old: jnp.where(taken, new, old), seen, state.quadratic)
        step = self._step(y, known, size.astype(y.dtype), options)
        promised = -(known.grad @ step + 0.5 * step @ known.hessian.mv(step))
        converged = self._is_next_to_nothing(y, step, promised, known.f) & (size >= 1)
        steps = state.steps + 1
        hopeless = (steps > self.patience) & ~converged & self._is_out_of_reach(known.f, promised, options)
        after = LeastSquaresState(y + step, known, search, promised, steps, converged, hopeless)
        return jnp.where(converged, after.trial, y), after, aux

    def _step(self, y: Parameters, quadratic: HalfSquares, size: Scalar, options: dict[str, Any]) -> Parameters:
        descent = self.descent
        if "lower" in options or "upper" in options:
            if not isinstance(descent, BoundedDescent):
                raise ValueError(f"{type(descent).__name__} knows no bounds; use BoundedDescent, or leave bounds out")
            descent = descent.within(options.get("lower"), options.get("upper"))
        state = descent.query(y, quadratic, descent.init(y, jax.eval_shape(lambda: quadratic)))
        return descent.step(size, state)[0].astype(y.dtype)

    def _is_out_of_reach(self, value: Scalar, promised: Scalar, options: dict[str, Any]) -> Bool[Array, ""]:
        if "aim" not in options:
            return jnp.asarray(False)
        hopeless: Bool[Array, ""] = ~(value - options.get("outlook", 0.0) * promised < options["aim"])
        return hopeless

    def _is_next_to_nothing(self, y: Parameters, step: Parameters, promised: Scalar, value: Scalar) -> Bool[Array, ""]:
        relative = self.rtol**2 if self.fall_rtol is None else self.fall_rtol
        relative = jnp.maximum(relative, 4 * jnp.finfo(y.dtype).eps)  # rounding swallows less
        tolerance = jnp.maximum(self.atol + self.rtol * jnp.abs(y), jnp.finfo(y.dtype).tiny)
        moved = self.norm(step / tolerance) <= 1
        small = (promised >= 0) & (promised <= self.fall_atol + relative * value)
        ended: Bool[Array, ""] = (moved | small) & jnp.isfinite(value)
        return ended

    def terminate(
        self,
        fn: Callable[..., Any],
        y: Parameters,
        args: Any,
        options: dict[str, Any],
        state: LeastSquaresState,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether the fit has ended, and how."""
        given_up = optx.RESULTS.nonlinear_divergence
        result = optx.RESULTS.where(state.hopeless, given_up, optx.RESULTS.successful)
        return state.converged | state.hopeless, result

    def postprocess(
        self,
        fn: Callable[..., Any],
        y: Parameters,
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: LeastSquaresState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Parameters, Any, dict[str, Any]]:
        """As it is."""
        return y, aux, {}


def gauss_newton_solver(fall_rtol: float | Array, fall_atol: float | Array = 0.0) -> LevenbergMarquardt:
    """Gauss and Newton's method: steps without damping, each halved until the objective falls (Armijo).

    The fit ends with the step that promises a fall of the objective by no more than ``fall_atol + fall_rtol`` of
    itself.
    """
    newton: optx.AbstractDescent[Parameters, Any, Any] = optx.NewtonDescent(linear_solver=Cholesky())
    ends: dict[str, Any] = {"fall_rtol": fall_rtol, "fall_atol": fall_atol}
    return LevenbergMarquardt(0.0, 0.0, descent=newton, search=optx.BacktrackingArmijo(), **ends)
