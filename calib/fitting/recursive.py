"""Calibration that goes on in use: recursive least squares, and the pads as calibrators of the image.

Everything is a pure step from one state to the next, so that the same function runs live, frame by frame, and over a
recording as a scan (`follow`, `follow_frames`).

With gain K = P phi / (mu + phi' P phi) the step is theta + K (y - phi' theta), P <- (P - K phi' P) / mu, which after n
updates is the least-squares solution in which a sample k updates ago weighs mu^k (Ljung 1999, System Identification,
11.2). Forgetting without new information lets P grow without bound (wind-up); so a frame that is not used, or says
nothing, changes nothing, and P is scaled down wherever its trace exceeds a cap.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import jaxeit as je

from .fields import AbstractField, Bilinear, Geometry, Places, pad_features


class Estimate(NamedTuple):
    """Coefficients (k,) and their covariance (k, k), in units of the noise if targets are; a state to step from."""

    theta: Float[Array, " k"]
    covariance: Float[Array, "k k"]


_NOTHING = 1e-12  # of a unit of noise: a frame whose prediction is that certain says nothing


class RecursiveLeastSquares(eqx.Module):
    """How much is forgotten and how uncertain a state may become.

    | field      | meaning                                                                | default |
    |------------|------------------------------------------------------------------------|---------|
    | forgetting | mu: weight of the past at each update; 1 / (1 - mu) updates are remembered | 0.999 |
    | cap        | largest trace of the covariance, over its number of coefficients       | 1.0     |

    Targets and features are to be divided by the noise of the target.
    """

    forgetting: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.999)
    cap: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def start(self, theta: Float[Array, " k"], deviation: float | Array) -> Estimate:
        """A state before the first update: coefficients known to within `deviation`, each by itself."""
        theta = jnp.asarray(theta)
        return Estimate(theta, jnp.eye(len(theta), dtype=theta.dtype) * jnp.asarray(deviation, theta.dtype) ** 2)

    def update(
        self,
        state: Estimate,
        features: Float[Array, " k"],
        target: Float[Array, ""],
        use: Bool[Array, ""] | bool = True,
    ) -> Estimate:
        """The state after one sample; unchanged where it is not used, not finite or without information."""
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
        go = use & finite & (news > _NOTHING)
        return Estimate(jnp.where(go, new, theta), jnp.where(go, shrunk, covariance))


@je.verb
def follow(
    rls: RecursiveLeastSquares,
    state: Estimate,
    features: Float[Array, "n k"],
    targets: Float[Array, " n"],
    use: Bool[Array, " n"] | None = None,
) -> tuple[Estimate, Float[Array, "n k"]]:
    """A series of updates: the last state, and the coefficients after each."""
    use = jnp.ones(len(targets), bool) if use is None else use

    def step(state: Estimate, sample: tuple[Array, Array, Array]) -> tuple[Estimate, Array]:
        after = rls.update(state, *sample)
        return after, after.theta

    return jax.lax.scan(step, state, (features, targets, use))


# --- the pads calibrate the image ------------------------------------------------------------------------------------


class Touched(NamedTuple):
    """What frames say, leading axis n: images' integrals, places, and the pads' forces with their standard errors.

    | field          | meaning                                         | shape     | unit  |
    |----------------|-------------------------------------------------|-----------|-------|
    | image_sum      | integral of the image                           | (n,)      | S m^2 |
    | places         | of the contacts                                 |           |       |
    | pad_force      | by the pads                                     | (n, pads) | N     |
    | standard_error | of it                                           | (n, pads) | N     |
    | valid          | pads within their calibrated range              | (n, pads) |       |
    """

    image_sum: Array
    places: Places
    pad_force: Array
    standard_error: Array
    valid: Array


class SensitivityTracker(eqx.Module):
    """The force per unit of image over the sheet, kept up to date by the pads while the skin is used.

    The model is F = phi(x) @ theta * image_gain * image_sum, with phi the features of `field` at the contact on its
    pad; hats add up to one, so that theta = 1 everywhere is a sheet as calibrated. Learns only from frames with one
    contact on one pad, whose force is well above nothing and whose standard error is small.

    | field      | meaning                                                        | default | unit        |
    |------------|----------------------------------------------------------------|---------|-------------|
    | geometry   | of the skin                                                    |         |             |
    | image_gain | force over the integral of the image, over the whole sheet     |         | N / (S m^2) |
    | rls        | forgetting and cap                                             |         |             |
    | field      | features; they should add up to one                            | corners |             |
    | least      | force below which nothing is learned                           | 1       | N           |
    | confidence | largest relative standard error of a force that is learned from | 0.2    | 1           |
    | share      | least part of the force that one pad must carry                | 0.9     | 1           |
    | scatter    | of a press about the field, relative to its force              | 0.05    | 1           |
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
        """As calibrated, believed to within `deviation` of the sensitivity."""
        return self.rls.start(jnp.ones(self.field.size(self.geometry.pads), self.image_gain.dtype), deviation)

    def forces(
        self, state: Estimate, image_sum: Float[Array, " n"], places: Places
    ) -> tuple[Float[Array, "n pads"], Float[Array, "n pads"]]:
        """Force (N) that the image tells, were the contact on each pad, and its standard error from `state`."""
        phi = self._features(image_sum, places)
        variance = jnp.einsum("npk,kl,npl->np", phi, state.covariance, phi)
        return phi @ state.theta, jnp.sqrt(jnp.maximum(variance, 0))

    def _features(self, image_sum: Float[Array, " n"], places: Places) -> Float[Array, "n pads k"]:
        size = (self.image_gain * image_sum)[:, None, None]
        return size * pad_features(self.field, self.geometry, places)

    def samples(self, frames: Touched) -> tuple[Array, Array, Array]:
        """Features and targets in units of their noise, and which frames may be learned from."""
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
    """The state after a block of frames, the coefficients after each, and which of them were learned from.

    The state goes on into the next block: live, a block is one frame.
    """
    features, targets, use = tracker.samples(frames)
    after, history = follow(tracker.rls, state, features, targets, use)
    return after, history, use
