"""What presses of known place and force tell of loads: the law of pressure, the texture of the gain, the model's error.

A frame tells the force and the shape of a load through the law that turns pressure into conductivity. Under a law that
saturates too early a strong press is fitted as a far stronger one, too narrow and in another place, and what is left of
the frame is explained by further loads. So one load p_i is fitted to each press, whose force is known, and the
parameters theta of the law, which all presses share, by Gauss-Newton steps of

    |log theta|^2_S + sum_i min over p_i (|y_i - h(p_i, theta)|^2_R + |u(p_i)|^2 + log det R)  ->  min over theta,

where R is the covariance of what a fit errs by, gain and shape of the load among it, u what is unusual of a load, and S
what is known of laws before. The loads are eliminated from each step (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10,
413). A press that fits far worse than most, as one whose frame is not its own, is left out.

Fits of weak or long loads seldom find their end under a law of a large exponent, so that S holds the exponent near
one, and weak presses are told too weak, strong ones too strong. By how much the fits of presses, as if their force were
unknown, miss it, tells the law by which the forces of fits are told (`ForceLaw`): a regression on the slopes of the
found force in the logs of the law, with errors of Student's law (Lange, Little and Taylor 1989, J. Am. Stat. Assoc. 84,
881), so that a press whose force is stated wrong counts little.

What the law leaves has two parts. Protrusions, and loads that are not Gaussians, are like a gain that changes over a
few millimetres: its standard deviation, the texture, is the one under which all presses together are most probable.
What is left even so is the model error (`select_model_error`).
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float
from scipy.linalg import solve_triangular

from ...._compile import require_known
from ....imaging.inputs import InverseError, require_real
from ....messages.kinds import require_unmasked
from ....model.discretisation import Model
from ..belief import LoadBelief
from ..fits.comparison import log_evidence
from ..fits.kinds import FINAL_FALL_ATOL, Fit, FrameFits
from ..fits.shape_errors import inverse_of, law_sensitivities, mean_errors
from ..preparation import prepare_loads, texture_modes
from ..pressure import FORCE_INDEX
from ..result import LoadKind
from ..settings import ForceLaw, LoadSettings
from ..sheet import AbstractGain, scaled_law
from .model_error import select_model_error

# Prior standard deviations of the logs of amplitude, half pressure and exponent. Amplitude and half pressure of a layer
# are hardly known; with larger exponents fits of weak or long loads seldom converge.
LAW_STD = np.array([0.7, 1.0, 0.05])
# Standard deviations of the gain's texture that are tried, until presses are less probable.
TEXTURES = (0.0, 0.1, 0.2)
# Standard deviation of the log of a force that a load cell measures.
FORCE_ERROR = 0.03
# Smallest number of presses to learn from.
MIN_PRESSES = 6
# Smallest log of the ratio of probabilities with which a press supports a larger model error; weak ones hardly do.
MIN_LOG_RATIO = 2.0
# Largest number of steps of the law under each texture, and of halvings of one; largest change of a log in a step, and
# the one below which steps end.
MAX_STEPS, MAX_HALVINGS, MAX_STEP, MIN_STEP = 4, 2, 0.7, 0.03
# Prior standard deviations of the logs of amplitude, half pressure and exponent, by which the law of forces differs.
FORCE_LAW_STD = np.array([0.3, 0.3, 0.5])
# Degrees of freedom of the errors of fitted forces; number of presses that count as much as the errors that fits state.
DEGREES_OF_FREEDOM, PRIOR_WEIGHT = 4, 8
# Log of the largest force over the smallest, below which no law of forces is learned: presses do not tell then how
# fitted forces depend on the force, and the law would be a guess for others.
MIN_LOG_FORCE_RANGE = np.log(2)
REWEIGHTINGS = 30  # of presses, of which a few suffice
# Chi-square over the median beyond which a press is an outlier, and left out.
OUTLIER_RATIO = 5.0


def learn_loads(
    model: Model,
    dv: Float[ArrayLike, "n readings"],
    position: Float[ArrayLike, "n 2"],
    force: Float[ArrayLike, " n"],
    settings: LoadSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
    gain: AbstractGain | None = None,
) -> LoadSettings:
    """Settings of loads for `prepare_loads`, by presses of known place and force.

    The law of pressure, the law of forces, the texture of the gain and the model error are learned; the other settings
    stay. Give presses of several forces all over the sheet: one force alone tells one number of the law of pressure,
    and no law of forces.

    Args:
        dv: difference frames, (n, readings) V, in each of which one tip presses, as means over holds.
        position: of the tips, (n, 2) m. Fits begin there, and may end some millimetres away.
        force: of the tips, (n,) N, as a load cell tells them.
        settings: before the presses; default `LoadSettings()`.
        noise, untouched, sigma, channels, gain: as for `prepare_loads`.

    Raises:
        InverseError: if there are fewer than `MIN_PRESSES` presses, an array has another shape, a place or a force is
            not a number or the force not above zero, or jit hides the values; and as for `prepare_loads`.

    Example:
        x, y = jnp.meshgrid(jnp.array([0.05, 0.1, 0.15]), jnp.array([0.06, 0.14]))
        pressed, forces = jnp.stack([x, y], -1).reshape(-1, 2), jnp.array([5.0, 10, 20, 8, 15, 12])  # m, N
        squares = jnp.sum((model.centroids - pressed[:, None]) ** 2, -1)
        pressure = forces[:, None] * jnp.exp(-squares / (2 * 0.012**2)) / (2 * jnp.pi * 0.012**2)  # Pa
        law = je.effects.ContactPiezoresistance(amplitude=1.5, half_pressure=25e3)
        frames = jnp.stack([je.forward(model, model.background * f) for f in law.factor(pressure)]) - v0
        learned = je.contacts.learn_loads(model, frames, pressed, forces, noise=noise, untouched=v0)
        fitter = je.contacts.prepare_loads(model, learned, noise=noise, untouched=v0)
        print(learned.changed())
    """
    require_known("learn_loads", InverseError, dv, position, force)
    require_real(dv=dv)
    require_unmasked({"position": position, "force": force}, InverseError)
    frames, places, forces = (np.asarray(values, float) for values in (dv, position, force))
    _require_presses(frames, places, forces)
    usual = replace(settings or LoadSettings(), forces=ForceLaw())
    fitter = prepare_loads(model, usual, noise=noise, untouched=untouched, sigma=sigma, channels=channels, gain=gain)
    presses = _Presses(fitter.belief, np.stack([fitter.whitened(frame, 0) for frame in frames]), np.log(forces))
    learned, best_presses, best, logs, informative = usual, presses, -np.inf, np.zeros(3), np.ones(len(forces), bool)
    starts = list(np.column_stack([places, np.full(len(forces), np.log(usual.width)), np.log(forces)])[:, None])
    for texture in TEXTURES:
        candidate = replace(usual, texture=texture)
        textured = presses.with_texture(candidate)
        logs, fits = _fit_law(textured, logs, starts)
        fitted = textured.with_law(logs)
        error, evidences = _model_error(fitted, fits)
        if learned is usual:
            informative = np.isfinite(evidences)  # a press that no load explains tells nothing under any texture
        if not (evidence := float(evidences[informative].sum())) > best:
            break
        learned, best = replace(candidate, law=fitted.belief.sheet.law, model_error=error), evidence
        starts, best_presses = [fit.rows[:, :4] for fit in fits], fitted.with_error(error)
    if np.ptp(np.log(forces[informative])) < MIN_LOG_FORCE_RANGE:
        return learned
    return replace(learned, forces=_force_law(best_presses, starts, informative))


def _require_presses(frames: np.ndarray, places: np.ndarray, forces: np.ndarray) -> None:
    count = len(frames)
    if count < MIN_PRESSES or frames.ndim != 2 or places.shape != (count, 2) or forces.shape != (count,):
        raise InverseError(
            f"dv {frames.shape}, position {places.shape} and force {forces.shape} tell no law of pressure; give "
            f"{MIN_PRESSES} presses or more, as (n, readings), (n, 2) and (n,)"
        )
    wrong = ~(np.isfinite(places).all(1) & np.isfinite(forces) & (forces > 0))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InverseError(
            f"press {first} has place {places[first]} m and force {forces[first]} N; give places that are numbers and "
            "forces above zero"
        )


class _Presses(NamedTuple):
    """Single presses, and the prior of loads in their fits.

    | meaning                            | shape  |
    |------------------------------------|--------|
    | y: whitened readings               | (n, r) |
    | log_force: logs of their forces, N | (n,)   |
    """

    belief: LoadBelief
    y: np.ndarray
    log_force: np.ndarray

    def with_law(self, logs: np.ndarray) -> "_Presses":
        """The presses under a law whose amplitude, half pressure and exponent are those of now times exp of these."""
        return self._with_sheet(law=scaled_law(self.belief.sheet.law, logs.tolist()))

    def with_texture(self, settings: LoadSettings) -> "_Presses":
        """The presses on a sheet whose gain has the texture of these settings."""
        sheet = self.belief.sheet
        return self._with_sheet(texture=texture_modes(sheet.points, sheet.weights, settings, sheet.gain.dtype))

    def with_error(self, error: float) -> "_Presses":
        """The presses under another model error."""
        found = jnp.asarray(error, self.belief.model_error.dtype)
        return self._replace(belief=replace(self.belief, model_error=found))

    def _with_sheet(self, **parts: Any) -> "_Presses":
        return self._replace(belief=replace(self.belief, sheet=replace(self.belief.sheet, **parts)))

    def frame(self, k: int) -> FrameFits:
        """The fits of one press, whose force is known."""
        usual, spread = (
            self.belief.prior_mean.at[1].set(self.log_force[k]),
            self.belief.prior_std.at[1].set(FORCE_ERROR),
        )
        return FrameFits(replace(self.belief, prior_mean=usual, prior_std=spread), self.y[k])

    def fits(self, starts: list[np.ndarray]) -> list[Fit]:
        """One load for each press, from where it begins, (1, 4)."""
        return [self.frame(k).fit(LoadKind.ONE, start, FINAL_FALL_ATOL) for k, start in enumerate(starts)]

    def force_error(self, k: int, start: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Log of the fitted force of one press over the true one; its variance; its slopes in the law (3,)."""
        frame = FrameFits(self.belief, self.y[k])
        fit = frame.fit(LoadKind.ONE, start, FINAL_FALL_ATOL)
        linear = frame.linearise(fit)
        square = mean_errors(linear, fit.free, np.asarray(self.belief.shapes, float))[1]
        slopes = law_sensitivities(linear, fit.free)[FORCE_INDEX]
        log_error = float(fit.loads[0, FORCE_INDEX] - self.log_force[k])
        return log_error, float(square[FORCE_INDEX, FORCE_INDEX]), slopes

    def normal_equations(self, fits: list[Fit], inliers: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (3, 3) and gradient (3,) of some presses in the logs of the law, with loads eliminated."""
        matrix, gradient = np.zeros((3, 3)), np.zeros(3)
        for k in inliers:
            slopes, residual = self._law_residual(k, fits[k])
            matrix, gradient = matrix + slopes.T @ slopes, gradient + slopes.T @ residual
        return matrix, gradient

    def _law_residual(self, k: int, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Slopes of a press in the logs of the law, and its residual, in standard deviations, with its load
        eliminated."""
        frame = self.frame(k)
        residual, sensitivities = frame.residual(fit)
        prior_residual, prior_slopes = frame.prior_residual(fit)
        slopes = np.concatenate([sensitivities.law, np.asarray(sensitivities.loads)[:, fit.free]], 1)
        slopes = solve_triangular(fit.root, slopes, lower=True)
        basis = np.linalg.qr(np.concatenate([slopes[:, 3:], prior_slopes]))[0]
        law_slopes = np.pad(slopes[:, :3], ((0, len(prior_residual)), (0, 0)))
        columns = np.column_stack([law_slopes, np.append(residual, -prior_residual)])
        projected = columns - basis @ (basis.T @ columns)
        return projected[:, :3], projected[:, 3]


def _fit_law(presses: _Presses, logs: np.ndarray, starts: list[np.ndarray]) -> tuple[np.ndarray, list[Fit]]:
    """Fit the law of pressure: logs (3,) by which it changes, under which presses are most probable, and the fits."""

    def deviance(fits: list[Fit], logs: np.ndarray, inliers: list[int]) -> float:
        return sum(fits[k].deviance for k in inliers) + float(np.sum((logs / LAW_STD) ** 2))

    # Not `LevenbergMarquardt`: a trial fits all presses anew, by programs that the host chooses and no traced solver
    # can call; the deviance has log det R besides the squares; and outliers, chosen before each step, change it.
    fits = presses.with_law(logs).fits(starts)
    for _ in range(MAX_STEPS):
        squares = np.array([fit.square for fit in fits])
        inliers = np.flatnonzero(squares <= OUTLIER_RATIO * np.median(squares)).tolist()
        matrix, gradient = presses.with_law(logs).normal_equations(fits, inliers)
        step = np.linalg.solve(matrix + np.diag(LAW_STD**-2.0), gradient - logs / LAW_STD**2)
        step *= min(1, MAX_STEP / max(np.abs(step).max(), MIN_STEP))
        current, starts = deviance(fits, logs, inliers), [fit.rows[:, :4] for fit in fits]
        for _ in range(1 + MAX_HALVINGS):
            found = presses.with_law(logs + step).fits(starts)
            if deviance(found, logs + step, inliers) < current:
                break
            step /= 2
        else:
            return logs, fits
        logs, fits = logs + step, found
        if np.abs(step).max() < MIN_STEP:
            break
    return logs, fits


def _force_law(presses: _Presses, starts: list[np.ndarray], informative: np.ndarray) -> ForceLaw:
    """The law of forces, by fits of presses as if their force were unknown."""
    errors = [presses.force_error(k, starts[k]) for k in np.flatnonzero(informative).tolist()]
    log_errors, variance, slopes = (np.array([one[part] for one in errors]) for part in range(3))
    return fit_force_law(log_errors, variance, slopes)


def fit_force_law(
    log_errors: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"], slopes: Float[np.ndarray, "n 3"]
) -> ForceLaw:
    """Fit the law of forces to errors of fitted forces, by a regression with errors of Student's law.

    Args:
        log_errors, variance: logs of fitted forces over the true ones, and their variances, as fits state them.
        slopes: of the logs of fitted forces in those of the law.
    """
    variance, weight = variance + FORCE_ERROR**2, np.ones(len(log_errors))
    for _ in range(REWEIGHTINGS):
        weighted = slopes * (weight / variance)[:, None]
        covariance = inverse_of(slopes.T @ weighted + np.diag(FORCE_LAW_STD**-2.0))[0]
        logs = covariance @ weighted.T @ log_errors
        squares = (log_errors - slopes @ logs) ** 2 / variance
        weight = (DEGREES_OF_FREEDOM + 1) / (DEGREES_OF_FREEDOM + squares)
    variance_ratio = (PRIOR_WEIGHT + float(weight @ squares)) / (PRIOR_WEIGHT + len(log_errors))
    return ForceLaw(tuple(logs.tolist()), tuple(map(tuple, covariance.tolist())), variance_ratio)


def _model_error(presses: _Presses, fits: list[Fit]) -> tuple[float, np.ndarray]:
    """The model error of single presses, of unknown force, and the log of the probability of each under it, (n,)."""

    def evidence(own: np.ndarray, fit: Fit, error: float) -> float:
        frame = FrameFits(presses.with_error(error).belief, own)
        return log_evidence(frame.belief, frame.fit(LoadKind.ONE, fit.rows[:, :4], FINAL_FALL_ATOL))

    evidences = [cache(partial(evidence, *one)) for one in zip(presses.y, fits, strict=True)]
    error = select_model_error(evidences, float(presses.belief.model_error), MIN_LOG_RATIO)
    return error, np.array([one(error) for one in evidences])
