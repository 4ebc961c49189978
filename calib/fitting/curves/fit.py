"""Robust fit of a curve to pressure and force samples, with covariance and a result code.

For residuals r_i = (F_i - h(P_i)) / (sigma_i s), s a robust scale, the fit minimises sum_i w^2 rho(r_i^2 / w^2) / 2
(an M-estimate of width w). `optimistix.least_squares` gets the residuals transformed to
sign(r) w sqrt(rho(r^2 / w^2)), whose squares are the loss: every least-squares solver can minimise it, without a
reweighting loop. The default solver also uses the curvature of the loss and needs fewer steps. The scale s is 1.4826
times the median absolute residual (MAD); it is estimated at the start of each of a few iterations and held within it.

Slopes and exponents are positive. The solver's unknowns are their multiples of the start, with a lower bound that
stands for zero, because the logarithm of a slope that tends to zero diverges. Where the samples favour a slope at or
just below zero, the slope ends on its bound, and the curve is flat there: a valid fit, with the standard errors of a
slope that may be negative. Where they favour a slope far below zero, so that the bound explains a good part of the
residuals, the curve is the wrong one, and the result is AT_BOUND.

The roughness penalty of a spline (`AbstractCurve.bends`) adds one residual for each bend. Samples may err together,
within a press or a stretch of time, as on the two branches of a hysteresis loop. Such samples count as the few
independent ones that they amount to (`problem.design_effect`); otherwise the spline would follow one branch here and
the other one there. Where many samples err independently, the penalty is negligible. The covariance is that of the
samples alone.

Samples of one press are near-duplicates. With `groups` (the press or location of each sample), the covariance is the
cluster sandwich with the CR2 correction of Bell and McCaffrey (2002), which is valid from about a dozen presses on and
hardly depends on the number of samples in a press. Without groups it is Huber's (Robust Statistics, 1981, 7.6).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

import jaxeit as je
from jaxeit.least_squares import ImplicitStep, LevenbergMarquardt

from ..losses import AbstractLoss, SoftL1
from ..results import FitError, FitResult
from .base import AbstractCurve, scale_of
from .covariance import CurveCovariance, CurveMinimum, covariance_at
from .fitted import FittedCurve
from .own_curves import StartValues, evaluate_start, is_own, require_rising
from .problem import CurveProblem
from .samples import Numbers, Samples, bucket, make_samples

Solver = optx.AbstractLeastSquaresSolver[Any, Any, Any, Any]
Flag = Bool[Array, ""] | bool

# Number of minimisations: each estimates the scale of the residuals where the one before ended.
ITERATIONS = 4
# Relative tolerance of all minimisations but the last, which only serve to estimate the scale of the residuals.
INNER_RTOL = 1e-4
# Largest share of the residuals' influence that slopes below zero would explain; above it samples contradict the curve.
MAX_CONTRADICTION = 0.25
# Least rise of the curve over the fitted pressures, as a fraction of the typical force.
MIN_RISE = 1e-3


def default_solver(dtype: DTypeLike) -> LevenbergMarquardt:
    """The solver with tolerances that `dtype` can reach."""
    tolerance = 1e-9 if dtype == jnp.float64 else 1e-4
    return LevenbergMarquardt(tolerance, tolerance)


def _solve(
    problem: CurveProblem, solver: Solver, max_steps: int, iterations: int
) -> tuple[CurveMinimum, Bool[Array, ""]]:
    """The minimum after `iterations` iterations, and whether the last iteration converged."""
    dtype = problem.start.dtype
    slack = jnp.ones(iterations, dtype).at[:-1].set(max(INNER_RTOL / solver.rtol, 1.0))
    # No penalty in the first iteration, whose residuals show the error of the start rather than that of the samples.
    penalty = jnp.ones(iterations, dtype).at[0].set(0)
    options = {"lower": problem.lower, "curvature": problem.curvature}

    def iterate(multiple: Array, settings: tuple[Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        slack, penalty = settings
        weights = problem.weights(multiple, penalty)
        tolerances = (solver.rtol * slack, solver.atol * slack)
        inner_solver = eqx.tree_at(lambda s: (s.rtol, s.atol), solver, tolerances)
        solution: Any = optx.least_squares(
            lambda multiple, args: args[0].objective(multiple, *args[1]),
            inner_solver,
            multiple,
            (problem, weights),
            options,
            max_steps=max_steps,
            adjoint=ImplicitStep(),
            throw=False,
        )
        return solution.value, (*weights, solution.result == optx.RESULTS.successful)

    multiple, (spread, weight, ended) = jax.lax.scan(iterate, problem.first, (slack, penalty))
    return CurveMinimum(problem.free(multiple), spread[-1], weight[-1], problem.at_bound(multiple)), ended[-1]


def _groups_used(samples: Samples, n_groups: int) -> Int[Array, ""]:
    if not n_groups:
        return jnp.zeros((), jnp.int32)
    counts = jax.ops.segment_sum(samples.valid.astype(jnp.int32), samples.group, n_groups)
    return jnp.sum(counts > 0)


def fill_gaps(pressure: Float[Array, " n"], present: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Pressures (n,) Pa for a curve with memory: the last pressure before a gap fills it, 0 a gap at the start."""
    last = jax.lax.cummax(jnp.where(present, jnp.arange(len(pressure)), -1))
    return jnp.where(last >= 0, jnp.where(present, pressure, 0.0)[last], 0.0)


def _pressure_range(samples: Samples) -> Float[Array, "2"]:
    p = samples.pressure
    low = jnp.min(jnp.where(samples.valid, p, jnp.inf))
    high = jnp.max(jnp.where(samples.valid, p, -jnp.inf))
    return jnp.stack([low, high])


def _result_code(
    finite: Flag, enough: Flag, ended: Flag, rises: Flag, determined: Flag, inside: Flag
) -> Int[Array, ""]:
    """The code of the first check that failed, in the order below; SUCCESS if none did."""
    checks = [
        (finite, FitResult.NOT_FINITE),
        (enough, FitResult.TOO_FEW),
        (rises, FitResult.NO_RESPONSE),
        (inside, FitResult.AT_BOUND),
        (ended, FitResult.MAX_STEPS),
        (determined, FitResult.SINGULAR),
    ]
    bad = [~jnp.asarray(ok) for ok, _ in checks]
    return jnp.select(bad, [jnp.int32(code) for _, code in checks], jnp.int32(FitResult.SUCCESS))


class _Fit(NamedTuple):
    """The fit of one pad: the samples used, their problem, and flags of the finite samples."""

    used: Samples
    problem: CurveProblem
    present: Bool[Array, " n"]


def _prepare(curve: AbstractCurve, samples: Samples, loss: AbstractLoss, n_groups: int) -> _Fit:
    """The fit's problem, in which values that are not valid are replaced by zeros or held pressures."""
    present = jnp.isfinite(samples.pressure) & jnp.isfinite(samples.force)
    valid = samples.valid & present
    used = Samples(
        fill_gaps(samples.pressure, present) if curve.path else jnp.where(valid, samples.pressure, 0.0),
        jnp.where(valid, samples.force, 0.0),
        samples.sigma,
        valid,
        samples.group,
    )
    scale = scale_of(used.pressure, used.force, valid)
    curve = curve.at(scale)
    start = curve.free(curve.initial(used.pressure, used.force, valid, scale), scale)
    seen = eqx.tree_at(lambda s: s.pressure, used, curve.seen(used.pressure))
    return _Fit(used, CurveProblem(curve, seen, scale, loss, start, n_groups), present)


def fit_samples(
    curve: AbstractCurve,
    samples: Samples,
    loss: AbstractLoss,
    solver: Solver,
    *,
    n_groups: int,
    max_steps: int = 64,
    iterations: int = ITERATIONS,
) -> FittedCurve:
    """The pure fit of one pad: fixed shapes, works under jit, vmap and grad, never raises; see `fit_curves`.

    A valid sample that is not finite makes the whole fit NOT_FINITE, with NaN parameters. `n_groups` = 0 means
    that the samples are independent.
    """
    used, problem, present = fit = _prepare(curve, samples, loss, n_groups)
    curve, scale = problem.curve, problem.scale
    end, ended = _solve(problem, solver, max_steps, iterations)
    found = covariance_at(end, problem)

    n, k = jnp.sum(used.valid), end.free.size
    params = curve.bound(end.free, scale)
    limits = _pressure_range(used)
    groups = _groups_used(used, n_groups)
    complete = jnp.all(present | ~samples.valid)
    result = _result_code(
        finite=complete & (n > 0) & jnp.all(jnp.isfinite(params)),
        enough=(n > k) & ((groups > k) if n_groups else True),
        ended=ended,
        rises=jnp.diff(curve(params, limits))[0] > MIN_RISE * scale.force,
        determined=(found.rank == k) & found.enough,
        inside=~jnp.any(end.at_bound) | (found.contradiction < MAX_CONTRADICTION),
    )
    return _fitted_curve(fit, params, end, found, result)


def _fitted_curve(
    fit: _Fit, params: Float[Array, " k"], end: CurveMinimum, found: CurveCovariance, result: Int[Array, ""]
) -> FittedCurve:
    """The fitted curve; NaN for what is not valid by the result code."""
    used, curve = fit.used, fit.problem.curve
    n, k = jnp.sum(used.valid), end.free.size
    limits = _pressure_range(used)
    raw = jnp.where(used.valid, used.force - curve.given(params, fit.problem.samples.pressure), 0.0)
    unusable = (result == FitResult.NOT_FINITE) | (result == FitResult.TOO_FEW)
    return FittedCurve(
        curve=curve,
        parameters=jnp.where(unusable, jnp.nan, params),
        covariance=jnp.where(result != FitResult.SUCCESS, jnp.nan, found.covariance),
        pressure_range=jnp.where(n > 0, limits, jnp.nan),
        scale=jnp.where(unusable, jnp.nan, end.spread),
        residual_rms=jnp.where(unusable, jnp.nan, jnp.sqrt(jnp.sum(raw**2) / (n - k).astype(raw.dtype))),
        n=n,
        n_missing=jnp.sum(~fit.present),
        n_groups=_groups_used(used, fit.problem.n_groups),
        rank=found.rank,
        result=result,
    )


@je.verb
def _fit_pads(
    curve: AbstractCurve,
    samples: Samples,
    loss: AbstractLoss,
    solver: Solver,
    n_groups: int,
    max_steps: int,
    iterations: int,
) -> FittedCurve:
    found: FittedCurve = eqx.filter_vmap(
        lambda s: fit_samples(curve, s, loss, solver, n_groups=n_groups, max_steps=max_steps, iterations=iterations)
    )(samples)
    return found


@je.verb
def _evaluate_starts(curve: AbstractCurve, samples: Samples, loss: AbstractLoss) -> StartValues:
    def one(samples: Samples) -> StartValues:
        used, problem, _ = _prepare(curve, samples, loss, 0)
        return evaluate_start(problem, _pressure_range(used))

    values: StartValues = eqx.filter_vmap(one)(samples)
    return values


def fit_curves(
    curve: AbstractCurve,
    pressures: Numbers,
    forces: Numbers,
    *,
    mask: Numbers | None = None,
    groups: Numbers | None = None,
    sigma: Numbers | None = None,
    loss: AbstractLoss | None = None,
    solver: Solver | None = None,
    max_steps: int = 64,
    dtype: DTypeLike | None = None,
) -> FittedCurve:
    """Fit one curve per pad, all pads in one compiled call.

    Args:
      pressures: (pads, n) Pa, baseline removed. NaN: missing.
      forces: (n,) or (pads, n) N. NaN: missing.
      mask: (n,) or (pads, n) samples to use; default: all finite ones. A sample that the mask selects but that is
        not finite makes its pad NOT_FINITE.
      groups: (n,) or (pads, n) press or location of each sample; samples of a group are taken as dependent.
      sigma: (n,) or (pads, n) noise of the force, up to a common factor; default: equal.
      loss: `SoftL1()` by default; also `Huber`, `Cauchy`, `Squared`.
      solver: an optimistix least-squares solver (default: `default_solver`).
      max_steps: limit of the solver's steps in each iteration.
      dtype: of the fit; default: that of the input. float64 is refused where JAX has 64-bit numbers off.

    Returns:
        A `FittedCurve` with a leading pad axis. Check `result` first. A bad pad does not change the numbers of other
        pads.

    Raises:
        FitError: for shapes that do not fit together, sigma not above zero, or a curve of a user's own that is not
            finite or falls.

    Example:
        for loss in (fitting.Squared(), fitting.SoftL1(), fitting.Cauchy()):  # names: fitting.LOSSES
            lines = calib.fit_curves(calib.Affine(), pressures, forces, loss=loss)
            print(fitting.LOSSES.text(loss), lines.parameters)  # N/Pa and N of each pad
    """
    shape = np.shape(pressures)
    length = bucket(shape[1]) if len(shape) == 2 else None
    samples, n_groups = make_samples(
        pressures, forces, mask=mask, groups=groups, sigma=sigma, dtype=dtype, length=length
    )
    loss = SoftL1() if loss is None else loss
    solver = default_solver(samples.pressure.dtype) if solver is None else solver
    if is_own(curve):
        require_rising(curve, _evaluate_starts(curve, samples, loss))
    return _fit_pads(curve, samples, loss, solver, bucket(n_groups) if n_groups else 0, max_steps, ITERATIONS)


def fit_curve(
    curve: AbstractCurve,
    pressure: Numbers,
    force: Numbers,
    *,
    groups: Numbers | None = None,
    mask: Numbers | None = None,
    **options: Any,
) -> FittedCurve:
    """`fit_curves` for one pad: pressure (n,) Pa, force (n,) N.

    Example:
        # Pa, in order of time
        up_and_down = np.concatenate([np.linspace(0, 6000, 100), np.linspace(6000, 0, 100)])
        force = 2e-3 * np.concatenate([up_and_down[:100], 0.9 * up_and_down[100:]])  # N
        for curve in (fitting.Play(), fitting.AffinePlay(), fitting.PlaySpline()):
            looped = fitting.fit_curve(curve, up_and_down, force)
            print(fitting.CURVES.text(curve), looped.parameters, looped.message())
    """
    p, f = np.asarray(pressure), np.asarray(force)
    if p.ndim != 1 or p.shape != f.shape:
        raise FitError(f"pressure and force must both be (samples,), not {p.shape} and {f.shape}.")
    return fit_curves(curve, p[None], f[None], groups=groups, mask=mask, **options).pad(0)
