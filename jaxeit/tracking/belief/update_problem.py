"""The least-squares problem of one update: which change of the belief makes a frame most probable.

Only the parameters that a frame informs are active in it: positions, widths, forces, half lengths, the level and the
modes around contacts. With their covariance ``P = C C^T`` it is ``|y - h|^2 / s^2 + |z|^2`` to be minimised over z,
where ``C z`` is the change of the active parameters; all others follow by their covariance with these.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...contacts.search import WhitenedFrame
from ...least_squares import normal_equations
from ...linalg import lapack
from .contact_filter import ContactFilter, active_indices, informative_pads, noise_scales, whitened_frame
from .response import Neighbourhood, PredictedMeasurement
from .state import LOAD_SIZE, Belief, Pads


class UpdateProblem(NamedTuple):
    """The least-squares problem of one update.

    | meaning                                                                  |
    |--------------------------------------------------------------------------|
    | filter, frame, pads; complete: whether the frame has all readings        |
    | belief before the frame                                                  |
    | active: indices of the parameters that the frame informs                 |
    | factor C of their covariance                                             |
    | scale: standard deviation of a whitened reading                          |
    | single_frame_scale: the same in a frame that no other one precedes       |
    | neighbourhood: of the contacts before the frame                          |
    """

    contact_filter: ContactFilter
    frame: WhitenedFrame
    complete: Bool[Array, ""]
    pads: Pads
    belief: Belief
    active: Int[Array, " a"]
    factor: Float[Array, "a a"]
    scale: Float[Array, ""]
    single_frame_scale: Float[Array, ""]
    neighbourhood: Neighbourhood

    def predict_measurement(self, z: Float[Array, " a"]) -> PredictedMeasurement:
        """Predict readings and pad forces if the active parameters change by C z, with slopes in z."""
        change, before = self.factor @ z, self.belief.contacts[:, :LOAD_SIZE]
        modes = self.active[before.size :] - self.belief.contacts.size
        gain = self.belief.gain.at[modes].add(change[before.size :])
        contacts = before + change[: before.size].reshape(-1, LOAD_SIZE)
        full = self.contact_filter.sheet.predict_measurement(contacts, gain, modes, self.neighbourhood)
        readings, slopes = self._as_observed(full.readings, full.reading_slopes)
        return PredictedMeasurement(readings, full.pads, self.factor.T @ slopes, self.factor.T @ full.pad_slopes)

    def signals(self) -> Float[Array, "K r"]:
        """Readings of each contact before the frame, to first order."""
        sheet, belief = self.contact_filter.sheet, self.belief
        full = sheet.signals(belief.contacts[:, :LOAD_SIZE], belief.gain, self.neighbourhood)
        return self._as_observed(full)[0]

    def _as_observed(self, *readings: Array) -> tuple[Array, ...]:
        """Whiten readings as those of the frame, which may lack some."""

        def whiten(*a: Array) -> tuple[Array, ...]:
            return tuple(one @ self.frame.root.T for one in a)

        found: tuple[Array, ...] = jax.lax.cond(self.complete, lambda *a: a, whiten, *readings)
        return found

    def residual(self, z: Float[Array, " a"], predicted: PredictedMeasurement) -> Float[Array, " n"]:
        """Residuals of the frame, of the pads and of the prior, in standard deviations."""
        frame = (predicted.readings - self.frame.y) / self.scale
        return jnp.concatenate([frame, (predicted.pads - self.pads.force) / self.pads.error, z])


def quadratic(z: Float[Array, " a"], problem: UpdateProblem) -> Any:
    """The normal equations of the residuals at z."""
    predicted = problem.predict_measurement(z)
    slopes = [predicted.reading_slopes / problem.scale, predicted.pad_slopes / problem.pads.error, jnp.eye(len(z))]
    return normal_equations(problem.residual(z, predicted), jnp.concatenate(slopes, 1).T)


def residual(z: Float[Array, " a"], problem: UpdateProblem) -> Float[Array, " n"]:
    """All residuals at z."""
    return problem.residual(z, problem.predict_measurement(z))


def prepare_problem(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> UpdateProblem:
    """The problem of a difference frame (readings,) V and pads, so many seconds after the last frame."""
    frame, complete, model_variance = whitened_frame(contact_filter, dv)
    scales = noise_scales(contact_filter, model_variance, seconds)
    active = active_indices(contact_filter, belief.contacts)
    factor = lapack.cholesky(belief.covariance[jnp.ix_(active, active)], lower=True)
    near = contact_filter.sheet.neighbourhood(belief.contacts[:, :LOAD_SIZE])
    pads = informative_pads(contact_filter, belief.contacts, near, pads)
    return UpdateProblem(contact_filter, frame, complete, pads, belief, active, factor, *scales, near)
