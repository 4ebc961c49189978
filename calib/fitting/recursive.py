"""Calibration while the skin is in use: recursive least squares, in which the pads calibrate the image.

Each update is a pure function from one state to the next. The same function runs live, frame by frame, and as a scan
over a recording (`follow`, `follow_frames`).

With gain K = P phi / (mu + phi' P phi) the step is theta + K (y - phi' theta), P <- (P - K phi' P) / mu, which after n
updates is the least-squares solution in which a sample k updates ago weighs mu^k (Ljung 1999, System Identification,
11.2). Forgetting without new information would let P grow without bound (wind-up). A frame that is not used, or that
carries no information, therefore leaves the state as it is, and P is scaled down where its trace exceeds a cap.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxeit as je

from .fields.base import AbstractField
from .fields.fitted import pad_features
from .fields.geometry import Geometry
from .fields.places import Places
from .fields.tensor_products import Bilinear


class Estimate(NamedTuple):
    """State of the recursion: coefficients (k,) and their covariance (k, k), for targets divided by their noise."""

    theta: Float[Array, " k"]
    covariance: Float[Array, "k k"]


# Least variance of a predicted target, relative to that of its noise, for a frame to carry information.
MIN_INFORMATION = 1e-12


class RecursiveLeastSquares(eqx.Module):
    """Recursive least squares with forgetting and a bound on the covariance.

    | field      | meaning                                                                       | default |
    |------------|-------------------------------------------------------------------------------|---------|
    | forgetting | mu, weight of the past at each update: a memory of 1 / (1 - mu) updates       | 0.999   |
    | cap        | largest trace of the covariance, divided by the number of coefficients        | 1.0     |

    Targets and features must be divided by the noise of the target.
    """

    forgetting: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.999)
    cap: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def start(self, theta: Float[Array, " k"], deviation: float | Array) -> Estimate:
        """The state before the first update: independent coefficients `theta` with standard deviation `deviation`."""
        theta = jnp.asarray(theta)
        return Estimate(theta, jnp.eye(len(theta), dtype=theta.dtype) * jnp.asarray(deviation, theta.dtype) ** 2)

    def update(
        self,
        state: Estimate,
        features: Float[Array, " k"],
        target: Float[Array, ""],
        use: Bool[Array, ""] | bool = True,
    ) -> Estimate:
        """The state after one sample; unchanged if the sample is not used, not finite or without information."""
        theta, covariance = state
        mu = self.forgetting.astype(theta.dtype)
        finite = jnp.isfinite(target) & jnp.all(jnp.isfinite(features))
        phi = jnp.where(finite, features, 0)
        spread = covariance @ phi
        news = phi @ spread
        gain = spread / (mu + news)
        new = theta + gain * (jnp.where(finite, target, 0) - phi @ theta)
        shrunk = (covariance - jnp.outer(gain, spread)) / mu
        shrunk = (shrunk + shrunk.T) / 2
        limit = self.cap.astype(theta.dtype) * len(theta)
        shrunk = shrunk * jnp.minimum(1, limit / jnp.trace(shrunk))
        go = use & finite & (news > MIN_INFORMATION)
        return Estimate(jnp.where(go, new, theta), jnp.where(go, shrunk, covariance))


@je.verb
def follow(
    rls: RecursiveLeastSquares,
    state: Estimate,
    features: Float[Array, "n k"],
    targets: Float[Array, " n"],
    use: Bool[Array, " n"] | None = None,
) -> tuple[Estimate, Float[Array, "n k"]]:
    """A series of n updates: the last state, and the coefficients after each update, (n, k)."""
    use = jnp.ones(len(targets), bool) if use is None else use

    def step(state: Estimate, sample: tuple[Array, Array, Array]) -> tuple[Estimate, Array]:
        after = rls.update(state, *sample)
        return after, after.theta

    return jax.lax.scan(step, state, (features, targets, use))


# --- the pads calibrate the image ------------------------------------------------------------------------------------


class Touched(NamedTuple):
    """Images and pads of n frames.

    | field          | meaning                                         | shape     | unit  |
    |----------------|-------------------------------------------------|-----------|-------|
    | image_sum      | integral of the image                           | (n,)      | S m^2 |
    | places         | places of the contacts                          |           |       |
    | pad_force      | force on each pad, by its pressure              | (n, pads) | N     |
    | standard_error | standard error of that force                    | (n, pads) | N     |
    | valid          | whether the pad is within its calibrated range  | (n, pads) |       |
    """

    image_sum: Array
    places: Places
    pad_force: Array
    standard_error: Array
    valid: Array


class SensitivityTracker(eqx.Module):
    """Tracks the force per unit of image over the sheet, by the forces of the pads while the skin is in use.

    The model is F = phi(x) @ theta * image_gain * image_sum, with phi the features of `field` at the contact on its
    pad. They add up to one, so that theta = 1 everywhere is the sheet as calibrated. It learns only from frames with
    one contact on one pad, whose force is large enough and whose standard error is small enough.

    | field      | meaning                                                        | default | unit        |
    |------------|----------------------------------------------------------------|---------|-------------|
    | geometry   | outlines of the skin's pads and rim                            |         |             |
    | image_gain | force over the integral of the image, over the whole sheet     |         | N / (S m^2) |
    | rls        | the recursion, with forgetting and cap                         |         |             |
    | field      | field whose features add up to one                             | corners |             |
    | least      | force below which nothing is learned                           | 1       | N           |
    | confidence | largest relative standard error of a force that is learned from | 0.2    | 1           |
    | share      | least part of the force that one pad must carry                | 0.9     | 1           |
    | scatter    | scatter of a press about the field, relative to its force      | 0.05    | 1           |
    """

    geometry: Geometry
    image_gain: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    rls: RecursiveLeastSquares = RecursiveLeastSquares(*map(jnp.asarray, (0.98, 0.1)))
    field: AbstractField = Bilinear(nodes=2)
    least: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)
    confidence: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.2)
    share: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.9)
    scatter: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.05)

    def start(self, deviation: float = 0.3) -> Estimate:
        """The state of a sheet as calibrated, with the relative standard deviation `deviation` of its sensitivity."""
        return self.rls.start(jnp.ones(self.field.size(self.geometry.pads), self.image_gain.dtype), deviation)

    def forces(
        self, state: Estimate, image_sum: Float[Array, " n"], places: Places
    ) -> tuple[Float[Array, "n pads"], Float[Array, "n pads"]]:
        """Force by the image, (n, pads) N, if the contact is on that pad, and its standard error from `state`."""
        phi = self._features(image_sum, places)
        variance = jnp.einsum("npk,kl,npl->np", phi, state.covariance, phi)
        return phi @ state.theta, jnp.sqrt(jnp.maximum(variance, 0))

    def _features(self, image_sum: Float[Array, " n"], places: Places) -> Float[Array, "n pads k"]:
        size = (self.image_gain * image_sum)[:, None, None]
        return size * pad_features(self.field, self.geometry, places)

    def samples(self, frames: Touched) -> tuple[Array, Array, Array]:
        """Features (n, k) and targets (n,) divided by the noise of the target, and the frames to learn from (n,)."""
        pad = jnp.argmax(frames.pad_force, 1)[:, None]
        force, error, valid = (jnp.take_along_axis(a, pad, 1)[:, 0] for a in frames[2:])
        phi = jnp.take_along_axis(self._features(frames.image_sum, frames.places), pad[..., None], 1)[:, 0]
        noise = jnp.sqrt(error**2 + (self.scatter * jnp.maximum(force, self.least)) ** 2)
        contacts = jnp.sum(jnp.all(jnp.isfinite(frames.places.position), -1), 1)
        whole = jnp.sum(jnp.maximum(frames.pad_force, 0), 1)
        sure = (force > self.least) & (error < self.confidence * force) & (force >= self.share * whole)
        use = valid & sure & (contacts == 1) & (frames.image_sum > 0)
        return phi / noise[:, None], force / noise, use


@je.verb
def follow_frames(
    tracker: SensitivityTracker, state: Estimate, frames: Touched
) -> tuple[Estimate, Float[Array, "n k"], Bool[Array, " n"]]:
    """The state after a block of frames, the coefficients after each frame, and the frames that were learned from.

    The state is the input of the next block; in live use, a block is one frame.
    """
    features, targets, use = tracker.samples(frames)
    after, history = follow(tracker.rls, state, features, targets, use)
    return after, history, use
