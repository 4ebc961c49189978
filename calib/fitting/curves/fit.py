"""Robust fit of a curve to pressure and force samples, with covariance and a result code.

For residuals r_i = (F_i - h(P_i)) / (sigma_i s), s a robust scale, the fit minimises sum_i w^2 rho(r_i^2 / w^2) / 2
(an M-estimate of width w). `optimistix.least_squares` gets the residuals transformed to
sign(r) w sqrt(rho(r^2 / w^2)), whose squares are the loss: every least-squares solver can minimise it, without a
reweighting loop. The default solver also uses the curvature of the loss and needs fewer steps. The scale s is 1.4826
times the median absolute residual (MAD); it is estimated at the start of each of a few rounds and held within it.

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
from .own_curves import Trial, is_own, require_sound, trial
from .problem import CurveProblem
from .samples import Numbers, Samples, bucket, gather

Solver = optx.AbstractLeastSquaresSolver[Any, Any, Any, Any]
Flag = Bool[Array, ""] | bool

# Rounds of minimisation: each estimates the scale of the residuals where the one before ended.
ROUNDS = 4
# Relative precision of all rounds but the last, which only serve to find the scale of the residuals.
ROUND_PRECISION = 1e-4
# Part of the residuals' influence that slopes below zero may explain; beyond it the samples contradict a rising curve.
MAX_CONTRADICTION = 0.25
# Least rise of the curve over the fitted pressures, as a fraction of the typical force.
MIN_RISE = 1e-3


def default_solver(dtype: DTypeLike) -> LevenbergMarquardt:
    """The solver with tolerances that `dtype` can reach."""
    tolerance = 1e-9 if dtype == jnp.float64 else 1e-4
    return LevenbergMarquardt(tolerance, tolerance)


def _solve(problem: CurveProblem, solver: Solver, max_steps: int, rounds: int) -> tuple[CurveMinimum, Bool[Array, ""]]:
    """The minimum after `rounds` rounds, and whether the last round converged."""
    dtype = problem.start.dtype
    slack = jnp.ones(rounds, dtype).at[:-1].set(max(ROUND_PRECISION / solver.rtol, 1.0))
    # No penalty in the first round, whose residuals show the error of the start rather than that of the samples.
    bent = jnp.ones(rounds, dtype).at[0].set(0)
    options = {"lower": problem.lower, "curvature": problem.curvature}

    def one_round(multiple: Array, settings: tuple[Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        slack, bent = settings
        weights = problem.weights(multiple, bent)
        tolerances = (solver.rtol * slack, solver.atol * slack)
        looser = eqx.tree_at(lambda s: (s.rtol, s.atol), solver, tolerances)
        solution: Any = optx.least_squares(
            lambda multiple, args: args[0].objective(multiple, *args[1]),
            looser,
            multiple,
            (problem, weights),
            options,
            max_steps=max_steps,
            adjoint=ImplicitStep(),
            throw=False,
        )
        return solution.value, (*weights, solution.result == optx.RESULTS.successful)

    multiple, (spread, weight, ended) = jax.lax.scan(one_round, problem.first, (slack, bent))
    return CurveMinimum(problem.free(multiple), spread[-1], weight[-1], problem.vanished(multiple)), ended[-1]


def _groups_used(samples: Samples, n_groups: int) -> Int[Array, ""]:
    if not n_groups:
        return jnp.zeros((), jnp.int32)
    counts = jax.ops.segment_sum(samples.valid.astype(jnp.int32), samples.group, n_groups)
    return jnp.sum(counts > 0)


def held_pressure(pressure: Float[Array, " n"], present: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Pressures (n,) Pa for a curve with memory: the last pressure before a gap fills it, 0 a gap at the start."""
    last = jax.lax.cummax(jnp.where(present, jnp.arange(len(pressure)), -1))
    return jnp.where(last >= 0, jnp.where(present, pressure, 0.0)[last], 0.0)


def _pressure_range(samples: Samples) -> Float[Array, "2"]:
    p = samples.pressure
    low = jnp.min(jnp.where(samples.valid, p, jnp.inf))
    high = jnp.max(jnp.where(samples.valid, p, -jnp.inf))
    return jnp.stack([low, high])


def _judge(finite: Flag, enough: Flag, ended: Flag, rises: Flag, determined: Flag, inside: Flag) -> Int[Array, ""]:
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
    """What one pad's fit works on: the samples used, the problem made of them, and which samples are finite."""

    used: Samples
    problem: CurveProblem
    present: Bool[Array, " n"]


def _prepare(curve: AbstractCurve, samples: Samples, loss: AbstractLoss, n_groups: int) -> _Fit:
    """The fit's problem, in which values that are not valid are replaced by zeros or held pressures."""
    present = jnp.isfinite(samples.pressure) & jnp.isfinite(samples.force)
    valid = samples.valid & present
    used = Samples(
        held_pressure(samples.pressure, present) if curve.path else jnp.where(valid, samples.pressure, 0.0),
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
    rounds: int = ROUNDS,
) -> FittedCurve:
    """The pure fit of one pad: fixed shapes, works under jit, vmap and grad, never raises; see `fit_curves`.

    A valid sample that is not finite makes the whole fit NOT_FINITE, with NaN parameters. `n_groups` = 0 means
    that the samples are independent.
    """
    used, problem, present = fit = _prepare(curve, samples, loss, n_groups)
    curve, scale = problem.curve, problem.scale
    end, ended = _solve(problem, solver, max_steps, rounds)
    found = covariance_at(end, problem)

    n, k = jnp.sum(used.valid), end.free.size
    params = curve.bound(end.free, scale)
    limits = _pressure_range(used)
    groups = _groups_used(used, n_groups)
    clean = jnp.all(present | ~samples.valid)
    result = _judge(
        finite=clean & (n > 0) & jnp.all(jnp.isfinite(params)),
        enough=(n > k) & ((groups > k) if n_groups else True),
        ended=ended,
        rises=jnp.diff(curve(params, limits))[0] > MIN_RISE * scale.force,
        determined=(found.rank == k) & found.enough,
        inside=~jnp.any(end.vanished) | (found.missed < MAX_CONTRADICTION),
    )
    return _estimates(fit, params, end, found, result)


def _estimates(
    fit: _Fit, params: Float[Array, " k"], end: CurveMinimum, found: CurveCovariance, result: Int[Array, ""]
) -> FittedCurve:
    """What the fit tells of its curve; NaN for what its result code does not let be used."""
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
    rounds: int,
) -> FittedCurve:
    found: FittedCurve = eqx.filter_vmap(
        lambda s: fit_samples(curve, s, loss, solver, n_groups=n_groups, max_steps=max_steps, rounds=rounds)
    )(samples)
    return found


@je.verb
def _try_pads(curve: AbstractCurve, samples: Samples, loss: AbstractLoss) -> Trial:
    def one(samples: Samples) -> Trial:
        used, problem, _ = _prepare(curve, samples, loss, 0)
        return trial(problem, _pressure_range(used))

    tried: Trial = eqx.filter_vmap(one)(samples)
    return tried


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
      max_steps: limit of the solver's steps in each round.
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
    samples, n_groups = gather(pressures, forces, mask=mask, groups=groups, sigma=sigma, dtype=dtype, length=length)
    loss = SoftL1() if loss is None else loss
    solver = default_solver(samples.pressure.dtype) if solver is None else solver
    if is_own(curve):
        require_sound(curve, _try_pads(curve, samples, loss))
    return _fit_pads(curve, samples, loss, solver, bucket(n_groups) if n_groups else 0, max_steps, ROUNDS)


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
