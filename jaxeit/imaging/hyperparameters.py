"""Ways to choose the hyperparameter, the ratio of the noise to the expected signal.

Each evaluates one-step images over a range of hyperparameters, through the eigenvectors U and eigenvalues w of
``J R^-1 J^T`` (`methods` has the symbols): ``x = R^-1 J^T U (w + l^2)^-1 U^T y``.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import verb
from ..linalg.lapack import eigh
from ..registry import AbstractChoice, Registry, limited
from .inputs import InverseError, require_real
from .methods import Problem

# Takes frames, (..., readings) V, to whitened ones, (..., k).
Whiten = Callable[[Array], Array]

_RANGE = np.logspace(-4, 2, 241)


class HyperparameterError(InverseError):
    """No hyperparameter can be chosen in this way; the message says why.

    Example:
        try:
            je.prepare(model, basis=je.Pixels(2), noise=noise, hyperparameter=je.imaging.Discrepancy(dv))
        except je.imaging.HyperparameterError as error:
            print(error)
    """


class Spectrum(eqx.Module):
    """A problem in its own coordinates.

    | meaning                                             | shape      |
    |-----------------------------------------------------|------------|
    | squares: w over the scale of ``l^2``                | (k,)       |
    | vectors: U                                          | (k, k)     |
    | gained: ``R^-1 J^T U`` over that scale              | (basis, k) |
    | problem                                             |            |
    """

    squares: Float[Array, " k"]
    vectors: Float[Array, "k k"]
    gained: Float[Array, "basis k"]
    problem: Problem

    def filters(self) -> tuple[np.ndarray, Float[Array, "h k"]]:
        """The hyperparameters that are tried, (h,), and ``1 / (w + l^2)`` for each, (h, k)."""
        return _RANGE, 1 / (self.squares + jnp.asarray(_RANGE, self.squares.dtype)[:, None] ** 2)


@verb
def spectrum(problem: Problem) -> Spectrum:
    """The eigenvectors and eigenvalues that all choices use."""
    gained = problem.precision().solve(problem.jacobian.T)
    scale = jnp.sum(problem.jacobian.T * gained) / problem.readings
    squares, vectors = eigh(problem.jacobian @ gained / scale)
    return Spectrum(jnp.maximum(squares, 0), vectors, gained @ vectors / scale, problem)


class AbstractHyperparameter(AbstractChoice):
    """A way to choose the hyperparameter, given to `prepare` in place of a number.

    ``needs_noise``: whether it compares with the noise, which then has to be given to `prepare`.
    """

    needs_noise: ClassVar[bool] = False

    def on(self, frames: Float[ArrayLike, "... readings"]) -> "AbstractHyperparameter":
        """The same choice, made on these frames, V; one that has frames of its own or needs none stays as it is."""
        del frames
        return self

    @abstractmethod
    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        """The hyperparameter.

        Args:
            whiten: takes frames, (..., readings) V, to whitened ones, (..., k).

        Raises:
            HyperparameterError: if no hyperparameter from 1e-4 to 100 meets the condition, or the frames hold no change
                or a used reading that is not finite.
        """


class AbstractFrameChoice(AbstractHyperparameter):
    """A way to choose that looks at frames: differences of readings, of which at least one shows a touch.

    | meaning                                                                        | shape           | unit |
    |--------------------------------------------------------------------------------|-----------------|------|
    | frames; None: those of the recording that is imaged, see `Imaging.prepare`      | (..., readings) | V    |
    """

    frames: eqx.AbstractVar[Float[ArrayLike, "... readings"] | None]

    def on(self, frames: Float[ArrayLike, "... readings"]) -> "AbstractFrameChoice":
        if self.frames is not None:
            return self
        require_real(frames=frames)
        return replace(self, frames=jnp.asarray(frames))

    def whitened(self, whiten: Whiten) -> Float[Array, "... k"]:
        """The frames, whitened.

        Raises:
            HyperparameterError: if there are no frames, they hold no change, or a reading that is not finite.
        """
        if self.frames is None:
            name = type(self).__name__
            raise HyperparameterError(f"{name} looks at frames of a touch and has none; give {name}(frames)")
        require_real(frames=self.frames)
        return _changes(jnp.asarray(self.frames), whiten)


class GeneralisedCrossValidation(AbstractFrameChoice):
    """The hyperparameter with the least ``m |y - J x|^2 / tr(I - J Q)^2`` (Golub et al. 1979).

    Each reading is then best predicted from the others. m is the number of independent numbers in a frame, here and
    below.
    """

    name: ClassVar[str] = "gcv"
    frames: Float[ArrayLike, "... readings"] | None = None

    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        tried, filters = spectrum.filters()
        residual = _residuals(spectrum, filters, self.whitened(whiten))
        m = len(spectrum.squares)
        freedom = m - jnp.sum(spectrum.squares * filters, 1)  # J Q has the eigenvalues w / (w + l^2)
        return _within("cross-validation", tried, int(jnp.argmin(m * residual / freedom**2)))


class LCurve(AbstractFrameChoice):
    """The hyperparameter at the corner of log |y - J x| against log x^T R x (Hansen 1992): of the largest curvature."""

    frames: Float[ArrayLike, "... readings"] | None = None

    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        tried, filters = spectrum.filters()
        y = self.whitened(whiten)
        # x^T R x but for a constant factor, which moves the curve and leaves its curvature as it is.
        size = jnp.einsum("hk,...k->h", spectrum.squares * filters**2, (y @ spectrum.vectors) ** 2)
        x, z = (np.log(np.asarray(v)) for v in (_residuals(spectrum, filters, y), size))
        (x1, z1), (x2, z2) = _slopes(x, z), _slopes(*_slopes(x, z))
        curvature = (x1 * z2 - x2 * z1) / np.maximum(x1**2 + z1**2, 1e-30) ** 1.5
        inner = slice(4, -4)  # the ends of the range have one-sided slopes
        return _within("L-curve", tried[inner], int(np.argmax(curvature[inner])))


def _within(name: str, tried: np.ndarray, best: int) -> float:
    """The best hyperparameter; refuses an end of the range, beyond which a better one may lie."""
    if 0 < best < len(tried) - 1:
        return float(tried[best])
    why = "show no touch above their noise" if best else "hold no noise that the model does not explain"
    raise HyperparameterError(
        f"{name}: the best hyperparameter is the end of the range, {tried[best]:.2g}: the frames to choose by {why}; "
        "give other frames, or a number such as 0.1"
    )


def _slopes(*curves: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.gradient(curve, np.log(_RANGE)) for curve in curves)


class Discrepancy(AbstractFrameChoice):
    """The largest hyperparameter with ``|y - J x|^2 <= factor^2 m``: the misfit is that of the noise (Morozov 1966).

    Needs ``noise`` in `prepare`. ``factor`` multiplies the standard deviations; default 1.

    Example:
        fitted = je.prepare(
            model, basis=je.Pixels(20), noise=noise, hyperparameter=je.imaging.Discrepancy(dv)
        )
        print(fitted.provenance["hyperparameter"], "by one of", list(je.imaging.HYPERPARAMETERS))
    """

    needs_noise: ClassVar[bool] = True
    frames: Float[ArrayLike, "... readings"] | None = None
    factor: float = limited(1.0, above=0)

    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        tried, filters = spectrum.filters()
        y = self.whitened(whiten)
        frames = y.size // y.shape[-1]
        residual = _residuals(spectrum, filters, y) / (frames * len(spectrum.squares))
        within = np.flatnonzero(np.asarray(residual) <= self.factor**2)
        if not within.size:
            raise HyperparameterError(
                f"discrepancy: the readings stay {float(residual[0]) ** 0.5:.3g} standard deviations from any image; "
                "the noise given is too small, or the model does not fit"
            )
        return float(tried[within[-1]])


class NoiseFigure(AbstractHyperparameter):
    """The smallest hyperparameter whose noise figure is at most ``target``, for a small contact in mid-sheet.

    Signal to noise of the readings over that of the image, root mean squares over readings and area:
    ``NF = (|y| / sqrt(m)) / (|x|_A / sqrt(E |Q e|_A^2))`` with e white.  (0.5 is EIDORS' usual target; there it is
    defined by means of absolute values, Adler and Guardo 1996.)
    """

    target: float = limited(0.5, above=0)

    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        tried, filters = spectrum.filters()
        picture, areas = spectrum.problem.picture, spectrum.problem.picture.areas
        middle = jnp.sum(picture.centres * areas[:, None], 0) / jnp.sum(areas)
        square = jnp.sum((picture.centres - middle) ** 2, 1)
        y = spectrum.problem.jacobian[:, jnp.argmin(jnp.where(areas > 0, square, jnp.inf))]
        image = spectrum.gained @ (filters * (y @ spectrum.vectors)).T
        noise = jnp.sqrt(filters**2 @ (areas @ spectrum.gained**2))
        signal = jnp.sqrt(areas @ image**2)
        figure = np.asarray(jnp.sqrt(jnp.sum(y**2) / spectrum.problem.readings) * noise / signal)
        within = np.flatnonzero(figure <= self.target)
        if not within.size:
            raise HyperparameterError(f"noise figure: none as low as {self.target}; the least is {figure.min():.3g}")
        return float(tried[within[0]])


class PriorDeviation(AbstractHyperparameter):
    """The hyperparameter with which images have this standard deviation before a frame is seen: root mean square over
    the area, S.

    Then the image of `OneStep` is the mean, and its variance that of the posterior of a Gaussian prior ``N(0, C)`` and
    Gaussian noise, with C the inverse of the prior's R times one number. Needs ``noise`` in `prepare`, in V.

    Example:
        strength = je.imaging.PriorDeviation(0.1 * float(model.background.mean()))  # S
        recon = je.prepare(model, basis=coarse, noise=noise, hyperparameter=strength)
        print(recon.provenance["hyperparameter"])
    """

    needs_noise: ClassVar[bool] = True

    deviation: float | None = limited(None, above=0)

    def choose(self, spectrum: Spectrum, whiten: Whiten) -> float:
        del whiten
        if self.deviation is None:
            raise HyperparameterError("PriorDeviation has no deviation; give it in S, such as PriorDeviation(1e-4)")
        problem = replace(spectrum.problem, hyperparameter=jnp.ones_like(spectrum.problem.hyperparameter))
        precision, areas = problem.precision(), problem.picture.areas
        unscaled = jnp.sum(areas * precision.variance()) / jnp.sum(areas)  # of x, for noise and R as they are
        return float(jnp.sqrt(unscaled / problem.strength(precision.solve(problem.jacobian.T))) / self.deviation)


def _changes(frames: Float[Array, "... readings"], whiten: Whiten) -> Float[Array, "... k"]:
    """Whitened frames, (..., k); refuses frames without change and readings that are not finite."""
    y = whiten(frames)
    bad = np.flatnonzero(~np.isfinite(y).all(-1))
    if bad.size:
        todo = "leave it out, or the channel by prepare(..., channels=...)"
        raise HyperparameterError(f"frame {bad[0]} of those to choose by holds a reading that is not finite; {todo}")
    if not np.any(y):
        raise HyperparameterError("the frames to choose by hold no change; give differences, at least one of a touch")
    return y


def _residuals(spectrum: Spectrum, filters: Float[Array, "h k"], y: Float[Array, "... k"]) -> Float[Array, " h"]:
    """``|y - J x|^2`` summed over the frames, for each hyperparameter tried."""
    left = 1 - spectrum.squares * filters
    return jnp.einsum("hk,...k->h", left**2, (y @ spectrum.vectors) ** 2)


HYPERPARAMETERS = Registry(AbstractHyperparameter, "hyperparameter", "jaxeit.hyperparameters")
"""Ways to choose the hyperparameter, by the names that the command line and recipes use."""
