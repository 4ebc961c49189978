"""Robust fit of a curve to pressure and force samples, with covariance and a result code.

For residuals r_i = (F_i - h(P_i)) / (sigma_i s), s a robust scale, the fit minimises sum_i w^2 rho(r_i^2 / w^2) / 2
(an M-estimate of width w). The loss goes to `optimistix.least_squares` as transformed residuals
sign(r) w sqrt(rho(r^2 / w^2)), whose squares *are* the loss: any solver of least squares will do, and none needs a
reweighting loop; the default one is told the loss's own curvature, and ends sooner. The scale is 1.4826 times the
median absolute residual (MAD), found again after each of a few rounds and then held.

Slopes and exponents are above zero. They are looked for as multiples of their start, down to next to nothing: a slope
that the samples want at zero or below has its logarithm at minus infinity, and no solver arrives there. Where the
samples want a slope at zero or just below, it ends on its bound, and the curve is flat there: a fit like any other,
with the standard errors of slopes that may be below zero. Where they want it far below - the bound explains a good part
of what is left - the curve is the wrong one, and the result says AT_BOUND.

A spline's bends are expected to be of a known size (`AbstractCurve.bends`), as one more residual each. Samples that
err together, by presses or by stretches of time, as they do on the two branches of a loop, weigh as the few that they
are then; else the spline would follow one branch here and the other there. Many samples that err each for itself leave
the bends to the samples, and the covariance is that of the samples alone.

Samples of one press are near-duplicates. Given `groups` (a press or location per sample), the covariance is the
cluster sandwich with the CR2 correction of Bell and McCaffrey (2002), so that it is honest for a dozen presses; the
sample count then hardly matters, which is the point. Without groups it is Huber's (Robust Statistics, 1981, 7.6).
"""

import abc
import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

import jaxeit as je
from calib.curves import AbstractCurve, Scale, scale_of
from calib.solver import BoundedNewton
from jaxeit.lapack import eigh, svd

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation: 1 / Phi^-1(3/4)."""


class FitError(ValueError):
    """Samples that cannot be handed to a fit at all: wrong shapes, weights that are not positive."""


class FitResult(enum.IntEnum):
    """What became of a fit. Anything but SUCCESS: do not use its numbers; `message` says what to do."""

    SUCCESS = 0
    NOT_FINITE = 1
    TOO_FEW = 2
    MAX_STEPS = 3
    NO_RESPONSE = 4
    SINGULAR = 5
    AT_BOUND = 6

    @property
    def message(self) -> str:
        """One sentence for a person."""
        return _MESSAGES[self]


_MESSAGES = {
    FitResult.SUCCESS: "fitted",
    FitResult.NOT_FINITE: "no finite samples, or the fit diverged: is this pad connected? see `jaxeit check`",
    FitResult.TOO_FEW: "too few samples or presses for this curve: record more presses, or choose a curve "
    "with fewer parameters",
    FitResult.MAX_STEPS: "the solver ran out of steps: raise max_steps, or choose a curve with fewer parameters",
    FitResult.NO_RESPONSE: "force does not rise with pressure, or there is only one pressure: check the pad's tube, "
    "its sign and its number, and record presses at more load levels",
    FitResult.SINGULAR: "the samples do not determine all parameters: record presses at more load levels",
    FitResult.AT_BOUND: "somewhere the force falls with pressure or does not rise, and this curve must: choose a curve "
    "with fewer parameters, and check the range of the pressure sensor",
}


class AbstractLoss(eqx.Module):
    """A robust loss rho, with rho(s) = s near zero; `width` in units of the residuals' scale."""

    width: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def ratio(self, s: Array) -> Array:
        """rho(s) / s for s >= 0, smooth at zero."""

    def transform(self, r: Array) -> Array:
        """sign(r) w sqrt(rho(r^2/w^2)): its square is the loss."""
        w = self.width.astype(r.dtype)
        return r * jnp.sqrt(self.ratio(jnp.minimum((r / w) ** 2, 0.1 * jnp.finfo(r.dtype).max)))

    def psi(self, r: Array) -> Array:
        """Influence of a residual: the derivative of half the loss."""
        return jax.grad(lambda x: jnp.sum(self.transform(x) ** 2) / 2)(r)

    def dpsi(self, r: Array) -> Array:
        """Derivative of `psi`."""
        return jax.jvp(self.psi, (r,), (jnp.ones_like(r),))[1]

    def curvature(self, t: Array) -> Array:
        """`dpsi` over the square of the derivative of t = `transform`(r): Newton's share of Gauss and Newton's."""
        return jnp.ones_like(t)


class Squared(AbstractLoss):
    """rho(s) = s: ordinary least squares; one outlier moves it without bound."""

    width: Array = eqx.field(converter=jnp.asarray, default=1.0)

    def ratio(self, s):
        return jnp.ones_like(s)


class Huber(AbstractLoss):
    """rho(s) = s up to 1, then 2 sqrt(s) - 1. Width 1.345: 95 % efficient on normal noise."""

    width: Array = eqx.field(converter=jnp.asarray, default=1.345)

    def ratio(self, s):
        far = jnp.maximum(s, 1.0)
        return jnp.where(s <= 1, 1.0, 2 / jnp.sqrt(far) - 1 / far)

    def curvature(self, t):
        return jnp.where(jnp.abs(t) <= self.width.astype(t.dtype), 1.0, jnp.zeros_like(t))


class SoftL1(AbstractLoss):
    """rho(s) = 2 (sqrt(1 + s) - 1), a smooth Huber. Width 1.287: 95 % efficient on normal noise."""

    width: Array = eqx.field(converter=jnp.asarray, default=1.287)

    def ratio(self, s):
        return 2 / (jnp.sqrt(1 + s) + 1)

    def curvature(self, t):
        root = 1 + (t / self.width.astype(t.dtype)) ** 2 / 2  # sqrt(1 + s)
        return 2 / (root * (root + 1))


class Cauchy(AbstractLoss):
    """rho(s) = log(1 + s): gross outliers lose all influence. Width 2.385: 95 % efficient on normal noise."""

    width: Array = eqx.field(converter=jnp.asarray, default=2.385)

    def ratio(self, s):
        small = s < 1e-4
        safe = jnp.where(small, 1.0, s)
        return jnp.where(small, 1 - s / 2 + s**2 / 3, jnp.log1p(safe) / safe)

    def curvature(self, t):
        u = (t / self.width.astype(t.dtype)) ** 2  # log(1 + s)
        small = u < 1e-4
        safe = jnp.where(small, 1.0, u)
        return jnp.where(small, 1 - 1.5 * u, (1 - jnp.expm1(safe)) * safe / jnp.expm1(safe))


class Samples(eqx.Module):
    """What one pad's fit is given; values at samples that are not `valid` are never looked at.

    | field    | meaning                                    | shape | unit |
    |----------|--------------------------------------------|-------|------|
    | pressure | baseline removed (or what a curve has seen) | (n,) | Pa   |
    | force    | baseline removed                           | (n,)  | N    |
    | sigma    | relative (or absolute) noise of the force  | (n,)  | 1, N |
    | valid    | use this sample                            | (n,)  |      |
    | group    | press of the sample, from 0                | (n,)  |      |
    """

    pressure: Float[Array, "n ..."]
    force: Float[Array, " n"]
    sigma: Float[Array, " n"]
    valid: Bool[Array, " n"]
    group: Int[Array, " n"]


class Prediction(NamedTuple):
    """Force (N), standard error of the curve (N; not of a new sample), and whether to believe it."""

    force: Array
    standard_error: Array
    valid: Array


class FittedCurve(eqx.Module):
    """A curve with its numbers and their honesty. From `fit_curves` every array has a leading pad axis.

    | field          | meaning                                                   | shape  | unit             |
    |----------------|-----------------------------------------------------------|--------|------------------|
    | curve          | the curve, its reference pressure set                     |        |                  |
    | parameters     | as named by `curve.names`                                 | (k,)   | `curve.units`    |
    | covariance     | of the parameters                                         | (k, k) | products thereof |
    | pressure_range | smallest and largest pressure fitted                      | (2,)   | Pa               |
    | scale          | robust standard deviation of the residuals                | ()     | N (1 with sigma) |
    | residual_rms   | root mean square residual, n - k degrees of freedom       | ()     | N                |
    | n, n_missing   | samples used, samples dropped as not finite               | ()     |                  |
    | n_groups       | presses used (0: samples taken as independent)            | ()     |                  |
    | rank           | parameters (directions) that the samples determine        | ()     |                  |
    | result         | a `FitResult`; anything but 0 means: do not use           | ()     |                  |
    """

    curve: AbstractCurve
    parameters: Float[Array, " k"]
    covariance: Float[Array, "k k"]
    pressure_range: Float[Array, " 2"]
    scale: Float[Array, ""]
    residual_rms: Float[Array, ""]
    n: Int[Array, ""]
    n_missing: Int[Array, ""]
    n_groups: Int[Array, ""]
    rank: Int[Array, ""]
    result: Int[Array, ""]

    @property
    def standard_errors(self) -> Float[Array, " k"]:
        """Of the parameters, in their units."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def pad(self, index: int) -> "FittedCurve":
        """One pad of a batch."""
        return jax.tree.map(lambda leaf: leaf[index], self)

    def message(self) -> str:
        """What became of the fit, for a person (one pad)."""
        return FitResult(int(self.result)).message

    def predict(self, pressure: Float[Array, "..."], tolerance: float = 0.05) -> Prediction:
        """Force at `pressure` (any shape, Pa), by the delta method: se^2 = g' C g, g = dh/dparameters (one pad).

        `valid` is false for NaN, for a failed fit, and more than `tolerance` of the fitted range outside that range.
        """
        p = jnp.asarray(pressure, self.parameters.dtype)
        slope = jax.jacfwd(self.curve)(self.parameters, p.ravel())
        variance = jnp.einsum("ni,ij,nj->n", slope, self.covariance, slope).reshape(p.shape)
        low, high = self.pressure_range
        margin = tolerance * (high - low)
        inside = (p >= low - margin) & (p <= high + margin)
        ok = inside & (self.result == FitResult.SUCCESS)
        return Prediction(self.curve(self.parameters, p), jnp.sqrt(variance), ok)


@je.verb
def predict_pads(fitted: FittedCurve, pressures: Float[Array, "pads n"], tolerance: float = 0.05) -> Prediction:
    """`FittedCurve.predict` for every pad of a batch: pressures (pads, n) -> arrays (pads, n)."""
    return eqx.filter_vmap(lambda f, p: f.predict(p, tolerance))(fitted, pressures)


def default_solver(dtype) -> BoundedNewton:
    """The solver with tolerances that `dtype` can reach."""
    tol = 1e-9 if dtype == jnp.float64 else 1e-4
    return BoundedNewton(tol, tol)


def _residuals(free, curve: AbstractCurve, samples: Samples, scale: Scale, spread):
    """Standardised residuals; zero at samples that are not valid. Pressures are as `curve.seen` has them."""
    force = curve.given(curve.bound(free, scale), samples.pressure)
    r = (samples.force - force) / (samples.sigma * spread)
    return jnp.where(samples.valid, r, 0.0)


def _spread(free, curve, samples: Samples, scale: Scale):
    """Robust scale of the residuals; never below rounding, so that perfect samples can be fitted too."""
    r = jnp.abs(_residuals(free, curve, samples, scale, 1.0))
    mad = MAD_TO_SIGMA * jnp.nanmedian(jnp.where(samples.valid, r, jnp.nan))
    floor = 10 * jnp.sqrt(jnp.finfo(r.dtype).eps) * scale.force
    return jnp.where(mad > floor, mad, floor)


_BLOCKS = 20  # of samples in a row, of which each errs for itself if the samples do


def _design_effect(influence, samples: Samples, n_groups: int):
    """By how much fewer independent samples would do (Kish 1965, Survey Sampling, 8.2): variance of sums, over groups
    or else over blocks in the order of the samples, over that of sums of independent ones; one at least.
    """
    count = jnp.cumsum(samples.valid)
    block = (count - 1) * _BLOCKS // count[-1]
    sums = jax.ops.segment_sum(influence, samples.group if n_groups else block, n_groups or _BLOCKS)
    total = jnp.sum(influence**2)
    return jnp.maximum(jnp.sum(sums**2) / jnp.where(total > 0, total, 1), 1)


_NEAR = 1e-4  # relative precision that is enough for all rounds but the last, which only serve to find the scale
_VANISHED = 6e-6  # of its start: where a slope or an exponent is next to nothing, and goes no further


def _solve(curve, samples, scale, start, loss, solver, max_steps, rounds, n_groups):
    """Free parameters, residual scale, weight of the bends, step-limit flag, and which vanished, after `rounds`.

    Derivatives by the implicit function theorem know no bounds: where a slope vanished they are those without.
    """
    positive = curve.positive
    first = jnp.where(positive, 1.0, start)
    bends, n = jnp.asarray(curve.bends, start.dtype), len(samples.force)
    slack = jnp.ones(rounds, start.dtype).at[:-1].set(max(_NEAR / solver.rtol, 1.0))
    bent = jnp.ones(rounds, start.dtype).at[0].set(0)  # the first round's residuals tell only what the start lacks

    def curvature(transformed):
        return jnp.concatenate([loss.curvature(transformed[:n]), jnp.ones(len(bends), start.dtype)])

    options = {"lower": jnp.where(positive, _VANISHED, -jnp.inf).astype(start.dtype), "curvature": curvature}

    def above(multiple):
        return jnp.maximum(multiple, _VANISHED)

    def free_of(multiple):
        return jnp.where(positive, start + jnp.log(above(multiple)), multiple)

    def objective(multiple, args):
        spread, weight = args
        residuals = loss.transform(_residuals(free_of(multiple), curve, samples, scale, spread))
        return jnp.concatenate([residuals, weight * (bends @ above(multiple))])  # clipped alike: as steep at a bound

    def one_round(multiple, settings):
        slack, bent = settings
        spread = _spread(free_of(multiple), curve, samples, scale)
        weight = bent
        if len(bends):
            influence = loss.psi(_residuals(free_of(multiple), curve, samples, scale, spread))
            weight = bent * jnp.sqrt(_design_effect(influence, samples, n_groups))
        args = spread, weight
        solution: optx.Solution = optx.least_squares(
            objective, solver, multiple, args, options | {"slack": slack}, max_steps=max_steps, throw=False
        )
        ended = solution.result == optx.RESULTS.successful
        return solution.value, (spread, weight, ended)

    multiple, (spread, weight, ended) = jax.lax.scan(one_round, first, (slack, bent))
    return free_of(multiple), spread[-1], weight[-1], ended[-1], positive & (multiple < 2 * _VANISHED)


def _iid_covariance(left, psi, dpsi, valid):
    """Huber's covariance in whitened coordinates: independent residuals of one size."""
    n, k = jnp.sum(valid).astype(psi.dtype), left.shape[1]
    mean = jnp.sum(dpsi) / n
    variance = jnp.sum(jnp.where(valid, (dpsi - mean) ** 2, 0.0)) / n
    correction = 1 + k / n * variance / mean**2
    size = (correction / mean) ** 2 * jnp.sum(psi**2) / (n - k)
    return size * jnp.eye(k, dtype=left.dtype)


def _cluster_covariance(left, psi, dpsi, group, n_groups):
    """Sandwich over presses in whitened coordinates, and whether there are presses enough for it.

    Scores are corrected for what their press itself decided (CR2). With G = U S V' the corrected score
    U_g' (I - U_g U_g')^(-1/2) psi_g equals (I - U_g' U_g)^(-1/2) U_g' psi_g, a k x k matter per press. A press that
    alone decides a direction (an eigenvalue of one) leaves no scatter to learn from. The bread weighs each sample
    with its own psi', since residuals grow with load and so does the slope.
    """
    score = jax.ops.segment_sum(left * psi[:, None], group, n_groups)
    leverage = jax.ops.segment_sum(left[:, :, None] * left[:, None, :], group, n_groups)
    values, vectors = jax.vmap(eigh)(leverage)
    decided = values > 1 - 1e-3
    root = jax.lax.rsqrt(1 - values)
    adjusted = jnp.einsum("gij,gj,gkj,gk->gi", vectors, root, vectors, score)
    steepness, axes = eigh(left.T @ (left * dpsi[:, None]))
    bread = axes / steepness @ axes.T
    enough = ~jnp.any(decided) & (steepness[0] > 0.05)
    return bread @ adjusted.T @ adjusted @ bread, enough


def _thin_svd(matrix: Float[Array, "n k"]) -> tuple[Float[Array, "n k"], Float[Array, " k"], Float[Array, "k k"]]:
    """U, singular values and V' of a tall matrix of few columns, by Gram-Schmidt done twice (Giraud et al. 2005)."""
    columns: list[Array] = []
    for column in matrix.T:
        for _ in range(2):
            for earlier in columns:
                column = column - earlier * (earlier @ column)
        length = jnp.sqrt(column @ column)
        columns.append(column / jnp.where(length > 0, length, 1))
    q = jnp.stack(columns, 1)
    left, singular, right = svd(q.T @ matrix)
    return q @ left, singular, right


def _covariance(at_end, curve, samples: Samples, scale: Scale, loss, n_groups, unit):
    """Covariance of the parameters in their units, rank of the Jacobian, whether presses suffice, and what was missed.

    The Jacobian is that of slopes themselves, not of their logarithms, in `unit`s: one on its bound is not degenerate.
    What was missed is the share of the influence of the residuals that lies along the Jacobian: nothing at a minimum.
    There is one but for what vanished; of that, what the samples and the expected bends both want below zero.
    """
    free, spread, weight, vanished = at_end
    r = _residuals(free, curve, samples, scale, spread)
    jacobian = jax.jacfwd(_residuals)(free, curve, samples, scale, spread) * unit
    left, singular, right = _thin_svd(jacobian)
    tiny = singular[0] * max(jacobian.shape) * jnp.finfo(r.dtype).eps
    rank = jnp.sum(singular > tiny)
    psi = jnp.where(samples.valid, loss.psi(r), 0.0)
    dpsi = jnp.where(samples.valid, loss.dpsi(r), 0.0)
    if n_groups:
        inner, enough = _cluster_covariance(left, psi, dpsi, samples.group, n_groups)
    else:
        inner, enough = _iid_covariance(left, psi, dpsi, samples.valid), jnp.array(True)
    back = right.T / singular
    units = jax.jacfwd(curve.bound)(free, scale) * unit @ back
    bends = weight * jnp.asarray(curve.bends, free.dtype)
    push = psi @ jacobian
    less = jnp.where(vanished, jnp.maximum(jnp.minimum(push, push + bends.T @ (bends @ (1 / unit))), 0), 0)
    _, size, axes = _thin_svd(jnp.concatenate([jacobian, bends])) if len(bends) else (left, singular, right)
    missed = jnp.sum(jnp.where(size > tiny, axes @ less / size, 0) ** 2) / jnp.sum(psi**2)
    return units @ inner @ units.T, rank, enough, missed


def _groups_used(samples: Samples, n_groups: int):
    if not n_groups:
        return jnp.zeros((), jnp.int32)
    counts = jax.ops.segment_sum(samples.valid.astype(jnp.int32), samples.group, n_groups)
    return jnp.sum(counts > 0)


def _kept(pressure, present):
    """Pressures with the last one before each gap held: what a curve with memory has been through."""
    last = jax.lax.cummax(jnp.where(present, jnp.arange(len(pressure)), -1))
    return jnp.where(last >= 0, jnp.where(present, pressure, 0.0)[last], 0.0)


def _pressure_range(samples: Samples):
    p = samples.pressure
    low = jnp.min(jnp.where(samples.valid, p, jnp.inf))
    high = jnp.max(jnp.where(samples.valid, p, -jnp.inf))
    return jnp.stack([low, high])


_CONTRADICTED = 0.25  # of what is left is a slope below zero: from there on a curve that must rise is the wrong one


def _judge(finite, enough, ended, rises, determined, inside):
    """The first thing that went wrong, as a FitResult code."""
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


def fit_samples(
    curve: AbstractCurve,
    samples: Samples,
    loss: AbstractLoss,
    solver: optx.AbstractLeastSquaresSolver,
    *,
    n_groups: int,
    max_steps: int = 64,
    rounds: int = 4,
) -> FittedCurve:
    """The pure fit of one pad: fixed shapes, works under jit, vmap and grad, never raises; see `fit_curves`.

    A valid sample that is not finite makes the whole fit NOT_FINITE, with NaN parameters. `n_groups` 0 means
    that samples are independent.
    """
    present = jnp.isfinite(samples.pressure) & jnp.isfinite(samples.force)
    clean = jnp.all(present | ~samples.valid)
    valid = samples.valid & present
    used = Samples(
        _kept(samples.pressure, present) if curve.path else jnp.where(valid, samples.pressure, 0.0),
        jnp.where(valid, samples.force, 0.0),
        samples.sigma,
        valid,
        samples.group,
    )
    scale = scale_of(used.pressure, used.force, valid)
    curve = curve.at(scale)
    start = curve.free(curve.initial(used.pressure, used.force, valid, scale), scale)
    seen = eqx.tree_at(lambda s: s.pressure, used, curve.seen(used.pressure))
    free, spread, weight, ended, vanished = _solve(curve, seen, scale, start, loss, solver, max_steps, rounds, n_groups)
    unit = jnp.where(curve.positive, jnp.exp(start - free), 1.0)
    at_end = free, spread, weight, vanished
    covariance, rank, decided, missed = _covariance(at_end, curve, seen, scale, loss, n_groups, unit)

    n, k = jnp.sum(valid), free.size
    params = curve.bound(free, scale)
    limits = _pressure_range(used)
    groups = _groups_used(used, n_groups)
    rise = jnp.diff(curve(params, limits))[0]
    raw = jnp.where(valid, used.force - curve.given(params, seen.pressure), 0.0)
    result = _judge(
        finite=clean & (n > 0) & jnp.all(jnp.isfinite(params)),
        enough=(n > k) & ((groups > k) if n_groups else True),
        ended=ended,
        rises=rise > 1e-3 * scale.force,
        determined=(rank == k) & decided,
        inside=~jnp.any(vanished) | (missed < _CONTRADICTED),
    )
    unusable = (result == FitResult.NOT_FINITE) | (result == FitResult.TOO_FEW)
    failed = result != FitResult.SUCCESS
    return FittedCurve(
        curve=curve,
        parameters=jnp.where(unusable, jnp.nan, params),
        covariance=jnp.where(failed, jnp.nan, covariance),
        pressure_range=jnp.where(n > 0, limits, jnp.nan),
        scale=jnp.where(unusable, jnp.nan, spread),
        residual_rms=jnp.where(unusable, jnp.nan, jnp.sqrt(jnp.sum(raw**2) / (n - k))),
        n=n,
        n_missing=jnp.sum(~present),
        n_groups=groups,
        rank=rank,
        result=result,
    )


@je.verb
def _fit_batch(curve, samples, loss, solver, n_groups, max_steps, rounds):
    return eqx.filter_vmap(
        lambda s: fit_samples(curve, s, loss, solver, n_groups=n_groups, max_steps=max_steps, rounds=rounds)
    )(samples)


def _floats(values, what: str, dtype) -> Array:
    """Host values -> device array of `dtype` (None: as they come), refusing a silent loss of precision."""
    if dtype is not None and jax.dtypes.canonicalize_dtype(dtype) != np.dtype(dtype):
        raise FitError("float64 was asked for but JAX has 64-bit numbers off; set JAX_ENABLE_X64=1 or ask for float32.")
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise FitError(f"{what} must be numbers, not {array.dtype}.")
    own = np.float64 if array.dtype.kind in "iu" else array.dtype
    return jnp.asarray(array, jax.dtypes.canonicalize_dtype(own if dtype is None else dtype))


def _broadcast(array: Array, shape: tuple[int, ...], what: str) -> Array:
    try:
        return jnp.broadcast_to(array, shape)
    except ValueError:
        raise FitError(f"{what} has shape {array.shape}; pressures have (pads, samples) = {shape}.") from None


def gather(pressures, forces, *, mask=None, groups=None, sigma=None, dtype=None) -> tuple[Samples, int]:
    """Host arrays -> `Samples` with a leading pad axis, and the number of groups (0: none given).

    `groups` may hold any integers or labels; they are numbered from 0 in sorted order.
    """
    p = _floats(pressures, "pressures", dtype)
    if p.ndim != 2:
        raise FitError(f"pressures must be (pads, samples), not {p.shape}.")
    shape = p.shape
    f = _broadcast(_floats(forces, "forces", dtype).astype(p.dtype), shape, "forces")
    s = _broadcast(_floats(1.0 if sigma is None else sigma, "sigma", dtype), shape, "sigma")
    s = s.astype(p.dtype)
    if not bool(jnp.all(jnp.isfinite(s) & (s > 0))):
        raise FitError("sigma must be finite and above zero for every sample; use mask to leave samples out.")
    finite = jnp.isfinite(p) & jnp.isfinite(f)
    valid = finite if mask is None else jnp.asarray(np.asarray(mask, bool))
    valid = _broadcast(valid, shape, "mask")
    labels, index = np.unique(np.zeros(1) if groups is None else groups, return_inverse=True)
    index = index.reshape(np.shape(groups) or (1,)).astype(np.int32)
    group = _broadcast(jnp.asarray(index), shape, "groups")
    return Samples(p, f, s, valid, group), 0 if groups is None else len(labels)


def bucket(n: int) -> int:
    """The next of 64, 96, 128, 192, 256, ...: array lengths that recur, so that compiled fits are reused."""
    power = 1 << max(n - 1, 63).bit_length()
    return power * 3 // 4 if n <= power * 3 // 4 else power


def _fill(samples: Samples) -> Samples:
    """Samples that are not valid, up to the next `bucket`."""
    extra = bucket(samples.valid.shape[1]) - samples.valid.shape[1]
    wide = jax.tree.map(lambda leaf: jnp.pad(leaf, ((0, 0), (0, extra))), samples)
    return eqx.tree_at(lambda s: s.sigma, wide, jnp.where(wide.sigma > 0, wide.sigma, 1.0))


def fit_curves(
    curve: AbstractCurve,
    pressures,
    forces,
    *,
    mask=None,
    groups=None,
    sigma=None,
    loss: AbstractLoss | None = None,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 64,
    dtype=None,
) -> FittedCurve:
    """Fit one curve per pad, all pads in one compiled call.

    Args:
      pressures: (pads, n) Pa, baseline removed. NaN: missing.
      forces: (n,) or (pads, n) N. NaN: missing.
      mask: (n,) or (pads, n) samples to use; left out, all finite ones are. A sample the mask vouches for
        but that is not finite makes its pad NOT_FINITE.
      groups: (n,) or (pads, n) press or location of each sample; samples of a group are taken as dependent.
      sigma: (n,) or (pads, n) noise of the force, relative is enough (left out: equal).
      loss: `SoftL1()` by default; also `Huber`, `Cauchy`, `Squared`.
      solver: an optimistix least-squares solver (default: `default_solver`).
      dtype: None keeps that of the input; float64 with 64-bit numbers off is refused.

    Returns: a `FittedCurve` with a leading pad axis. Look at `result` before anything else; a bad pad does not
      change its neighbours by one bit.

    Raises: `FitError` for shapes that do not fit together, or sigma not above zero.
    """
    samples, n_groups = gather(pressures, forces, mask=mask, groups=groups, sigma=sigma, dtype=dtype)
    loss = SoftL1() if loss is None else loss
    solver = default_solver(samples.pressure.dtype) if solver is None else solver
    return _fit_batch(curve, _fill(samples), loss, solver, bucket(n_groups) if n_groups else 0, max_steps, 4)


def fit_curve(curve: AbstractCurve, pressure, force, *, groups=None, mask=None, **options) -> FittedCurve:
    """`fit_curves` for one pad: pressure (n,) Pa, force (n,) N."""
    p, f = np.asarray(pressure), np.asarray(force)
    if p.ndim != 1 or p.shape != f.shape:
        raise FitError(f"pressure and force must both be (samples,), not {p.shape} and {f.shape}.")
    return fit_curves(curve, p[None], f[None], groups=groups, mask=mask, **options).pad(0)
