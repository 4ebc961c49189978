"""Reconstruction: from a difference of frames to an image of the conductivity change."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from .basis import AbstractBasis, BasisMap, Pixels
from .discretise import Model
from .jacobian import jacobian
from .priors import AbstractPrior, Noser


class InverseError(ValueError):
    """Settings from which no reconstruction can be made."""


class Reconstructor(eqx.Module):
    """A linear reconstruction, ready for use without mesh or solver: ``image = Q dv``.

    | meaning                                              | shape             | unit |
    |------------------------------------------------------|-------------------|------|
    | matrix Q                                             | (basis, readings) | S/V  |
    | centres in the sheet's flat coordinates              | (basis, 2)        | m    |
    | areas of the pixels on the sheet                     | (basis,)          | m^2  |
    | channels: readings that are used                     | (readings,)       |      |
    | shape, extent: of the picture, as in `BasisMap`      |                   | m    |
    """

    matrix: Float[Array, "basis readings"]
    centres: Float[Array, "basis 2"]
    areas: Float[Array, " basis"]
    channels: Bool[Array, " readings"]
    shape: tuple[int, ...] = eqx.field(static=True)
    extent: tuple[float, float, float, float] = eqx.field(static=True)

    @eqx.filter_jit
    def __call__(self, dv: Float[Array, "... readings"]) -> Float[Array, "... basis"]:
        """The image, S, of a difference of frames, V; any leading axes are batches.

        Readings that `prepare` was told to leave out are not looked at, whatever they hold.
        """
        dv = jnp.where(self.channels, jnp.asarray(dv, self.matrix.dtype), 0)
        return dv @ self.matrix.T


class AbstractMethod(eqx.Module):
    """How data and prior are weighed against each other."""

    @abstractmethod
    def matrix(
        self,
        jacobian: Float[Array, "readings basis"],
        prior: Float[Array, " basis"],
        hyperparameter: Float[Array, ""],
    ) -> Float[Array, "basis readings"]:
        """Q for whitened readings."""


class OneStep(AbstractMethod):
    """One regularised Gauss-Newton step, ``Q = (J^T J + l^2 R)^-1 J^T``  (the paper's equation 2).

    Solved by Cholesky in the smaller of the two spaces; with R diagonal they agree to rounding:
    ``Q = R^-1 J^T (J R^-1 J^T + l^2 I)^-1``.  The scale ``l^2 = hyperparameter^2 tr(J R^-1 J^T) / m``
    makes the hyperparameter a number without unit that means the same on every skin.
    """

    def matrix(self, jacobian, prior, hyperparameter):
        root = jnp.sqrt(prior)
        b = jacobian / root  # J R^-1/2
        readings, basis = b.shape
        square = hyperparameter**2 * jnp.sum(b**2) / readings
        if readings <= basis:
            small = b @ b.T + square * jnp.eye(readings, dtype=b.dtype)
            return (b.T / root[:, None]) @ cho_solve(cho_factor(small), jnp.eye(readings, dtype=b.dtype))
        small = b.T @ b + square * jnp.eye(basis, dtype=b.dtype)
        return cho_solve(cho_factor(small), b.T) / root[:, None]


def prepare(
    model: Model,
    prior: AbstractPrior | None = None,
    method: AbstractMethod | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[Array, " readings"] | None = None,
    hyperparameter: float = 0.1,
    *,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[Array, " readings"] | None = None,
) -> Reconstructor:
    """Everything that does not depend on the frame, done once.

    Args:
        prior: default `Noser`.
        method: default `OneStep`.
        basis: default `Pixels`, 40 along x.
        noise: standard deviation of each reading, (readings,) V; default: the same for all.
        hyperparameter: weight of the prior, without unit; 0.1 suits a signal-to-noise ratio of
            60 dB and 0.3 to 1 one of 40 dB.
        sigma: conductivity to linearise at, (elements,) S; default: the untouched sheet.
        channels: readings to use; a dead one is left out, never taken for zero.

    Raises:
        InverseError: if a value is out of range or no channel is left, or the result is not finite.
    """
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels()).on(model)
    readings = model.pattern.shape[0]
    used = _channels(channels, readings)
    std = _noise(noise, readings, used)
    if not (np.isfinite(hyperparameter) and hyperparameter > 0):
        raise InverseError(f"the hyperparameter is {hyperparameter}; give a number above zero")
    j = jacobian(model, sigma, image)
    matrix = _build(
        j,
        image.areas,
        jnp.asarray(np.where(used, 1 / std, 0.0), model.dtype),
        jnp.asarray(hyperparameter, model.dtype),
        Noser() if prior is None else prior,
        OneStep() if method is None else method,
    )
    if not bool(jnp.isfinite(matrix).all()):
        raise InverseError(
            "the reconstruction matrix is not finite: the conductivity must be positive, and in "
            "float32 the hyperparameter not below 1e-3"
        )
    return Reconstructor(matrix, image.centres, image.areas, jnp.asarray(used), image.shape, image.extent)


@eqx.filter_jit
def _build(j, areas, whitening, hyperparameter, prior, method):
    scale = jnp.max(whitening)  # keeps the numbers near those of the Jacobian
    weight = whitening / scale
    white = weight[:, None] * j
    return method.matrix(white, prior.diagonal(white, areas), hyperparameter) * weight


def _channels(channels, readings: int) -> np.ndarray:
    used = np.ones(readings, bool) if channels is None else np.asarray(channels, bool)
    if used.shape != (readings,):
        raise InverseError(f"channels has shape {used.shape}; this model has {readings} readings")
    if not used.any():
        raise InverseError("every channel is left out: there is nothing to reconstruct from")
    return used


def _noise(noise, readings: int, channels: np.ndarray) -> np.ndarray:
    if noise is None:
        return np.ones(readings)
    std = np.array(noise, float)
    if std.shape != (readings,):
        raise InverseError(f"noise has shape {std.shape}; this model has {readings} readings")
    bad = channels & ~(np.isfinite(std) & (std > 0))
    if bad.any():
        raise InverseError(
            f"the noise of reading {int(np.argmax(bad))} is {std[bad][0]} V; give a positive "
            "number, or leave the channel out with channels=..."
        )
    return np.where(channels, std, 1.0)
