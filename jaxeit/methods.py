"""Methods of reconstruction: how data and prior are weighed against each other.

All work on whitened readings y (`whitening`), of independent noise of one size, with the Jacobian J of y:

    x = argmin |J x - y|^2 + l^2 x^T R x,        l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings.

The scale makes the hyperparameter a number without unit that means the same on every skin: the standard deviation of
the noise over that of the data which the prior expects.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from .basis import Picture
from .priors import AbstractPrecision, AbstractPrior, Diagonal


class Problem(eqx.Module):
    """A linearised problem, whitened.

    | meaning                                            | shape      | unit |
    |----------------------------------------------------|------------|------|
    | jacobian                                           | (k, basis) | 1/S  |
    | readings: how many of them the k numbers stand for | ()         |      |
    | hyperparameter                                     | ()         |      |
    | prior, and the picture it is for                   |            |      |
    """

    jacobian: Float[Array, "k basis"]
    readings: Float[Array, ""]
    hyperparameter: Float[Array, ""]
    prior: AbstractPrior
    picture: Picture

    def precision(self, at: Float[Array, " basis"] | None = None) -> AbstractPrecision:
        """R; see `AbstractPrior.precision`."""
        return self.prior.precision(self.jacobian, self.picture, at)

    def strength(self, gained: Float[Array, "basis k"]) -> Float[Array, ""]:
        """``l^2``, given ``R^-1 J^T``."""
        return self.hyperparameter**2 * jnp.sum(self.jacobian.T * gained) / self.readings


class AbstractMethod(eqx.Module):
    """A choice of method: an `AbstractLinearMethod` or an `AbstractIterativeMethod`."""


class AbstractLinearMethod(AbstractMethod):
    """A method whose image is a matrix times the readings."""

    @abstractmethod
    def matrix(self, problem: Problem) -> Float[Array, "basis k"]:
        """Q, from whitened readings to the image."""

    def variance(self, problem: Problem, q: Float[Array, "basis k"]) -> Float[Array, " basis"]:
        """What noise and prior leave uncertain in each coefficient, for noise of unit variance; infinite: not known."""
        return jnp.full(len(q), jnp.inf, q.dtype)


class AbstractIterativeMethod(AbstractMethod):
    """A method that works on each frame anew, in a fixed number of steps."""

    @abstractmethod
    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        """The image of one whitened frame."""


class OneStep(AbstractLinearMethod):
    """One regularised Gauss-Newton step, ``Q = (J^T J + l^2 R)^-1 J^T``  (the paper's equation 2).

    Solved by Cholesky in the smaller of the two spaces, which agree to rounding:
    ``Q = R^-1 J^T (J R^-1 J^T + l^2 I)^-1``.
    """

    def matrix(self, problem):
        return _one_step(problem, problem.precision())

    def variance(self, problem, q):
        """The diagonal of ``(J^T J + l^2 R)^-1 = (R^-1 - Q J R^-1) / l^2``, the posterior of a Gaussian image."""
        precision = problem.precision()
        gained = precision.solve(problem.jacobian.T)
        return (precision.variance() - jnp.sum(q * gained, 1)) / problem.strength(gained)


def _one_step(problem: Problem, precision: AbstractPrecision) -> Float[Array, "basis k"]:
    j = problem.jacobian
    gained = precision.solve(j.T)
    square = problem.strength(gained)
    if isinstance(precision, Diagonal) and len(j) > j.shape[1]:
        small = j.T @ j + square * precision.matrix()
        return cho_solve(cho_factor(small), j.T)
    small = j @ gained + square * jnp.eye(len(j), dtype=j.dtype)
    return cho_solve(cho_factor(small), gained.T).T


def predicted(problem: Problem) -> Float[Array, "k k"]:
    """``J Q`` of `OneStep`: what its image predicts for each whitened reading, from all of them."""
    gained = problem.precision().solve(problem.jacobian.T)
    a = problem.jacobian @ gained
    return cho_solve(cho_factor(a + problem.strength(gained) * jnp.eye(len(a), dtype=a.dtype)), a)


class TruncatedSvd(AbstractLinearMethod):
    """The pseudo-inverse on the singular values of ``J R^-1/2`` above l, the others left out.

    l as for `OneStep`, which halves what lies there.  Taken from the eigenvectors of ``J R^-1 J^T``.
    """

    def matrix(self, problem):
        gained = problem.precision().solve(problem.jacobian.T)
        squares, vectors = jnp.linalg.eigh(problem.jacobian @ gained)
        kept = squares > problem.strength(gained)
        inverse = jnp.where(kept, 1 / jnp.where(kept, squares, 1), 0)
        return gained @ (vectors * inverse) @ vectors.T


class BackProjection(AbstractLinearMethod):
    """Each pixel the mean of the readings weighed by its sensitivity, ``x_j = J_j . y / (|J_j|^2 + floor)``.

    The oldest method, for comparison; it knows neither prior nor hyperparameter, and its images are blurred.
    """

    floor: float = 1e-3

    def matrix(self, problem):
        power = jnp.sum(problem.jacobian**2, 0)
        return problem.jacobian.T / (power + self.floor * jnp.max(power))[:, None]


class Greit(AbstractLinearMethod):
    """The linear map that, over a training set, comes nearest to desired images (Adler et al. 2009):

        Q = X Y^T (Y Y^T + l^2 I)^-1,        l^2 = hyperparameter^2 tr(Y Y^T) / readings.

    One training contact in every pixel: a Gaussian bump of ``width``, whose desired image X is a blurred disc of
    ``radius`` and the same integral; Y are its readings to first order.

    | meaning                                        | default | unit |
    |------------------------------------------------|---------|------|
    | width: standard deviation of a training contact | 0.012  | m    |
    | radius of the desired disc                      | 0.02   | m    |
    | edge: over which the disc falls off             | 0.004  | m    |
    """

    width: float = 0.012
    radius: float = 0.02
    edge: float = 0.004

    def matrix(self, problem):
        areas, centres = problem.picture.areas, problem.picture.centres
        square = jnp.sum((centres[:, None] - centres) ** 2, -1)
        distance = jnp.sqrt(jnp.where(square > 0, square, 1)) * (square > 0)
        contacts = jnp.exp(-0.5 * square / self.width**2) * (areas > 0)
        disc = jax.nn.sigmoid((self.radius - distance) / self.edge)
        mass, whole = areas @ contacts, areas @ disc
        desired = disc * jnp.where(whole > 0, mass / jnp.where(whole > 0, whole, 1), 0)
        y = problem.jacobian @ contacts
        square_sum = problem.hyperparameter**2 * jnp.sum(y**2) / problem.readings
        small = y @ y.T + square_sum * jnp.eye(len(y), dtype=y.dtype)
        return cho_solve(cho_factor(small), y @ desired.T).T


class NonNegative(AbstractIterativeMethod):
    """`OneStep` under the constraint x >= 0: a touch only adds conductivity.

    A primal-dual interior-point method (Nocedal and Wright 2006, section 16.6) in a fixed number of steps; each
    divides the duality gap by about ten.
    """

    steps: int = eqx.field(static=True, default=20)

    def image(self, problem, y):
        j, precision = problem.jacobian, problem.precision()
        square = problem.strength(precision.solve(j.T))
        b = j.T @ y
        hessian = j.T @ j + square * precision.matrix()
        scale = jnp.max(jnp.abs(b))
        scale = jnp.where(scale > 0, scale, 1)
        x = jnp.full_like(b, scale / jnp.mean(jnp.diagonal(hessian)))
        x, _ = jax.lax.fori_loop(
            0, self.steps, lambda _, state: _inwards(hessian, b, *state), (x, jnp.full_like(b, scale))
        )
        return x


def _inwards(hessian, b, x, z):
    """One step towards ``H x - b = z``, ``x z = 0``, staying inside x, z > 0."""
    target = 0.1 * jnp.mean(x * z)
    dx = cho_solve(cho_factor(hessian + jnp.diag(z / x)), b - hessian @ x + target / x)
    dz = (target - z * dx) / x - z
    x_step, z_step = (jnp.min(jnp.where(d < 0, -0.99 * v / jnp.where(d < 0, d, 1), 1)) for v, d in ((x, dx), (z, dz)))
    return x + jnp.minimum(x_step, 1) * dx, z + jnp.minimum(z_step, 1) * dz


class Reweighted(AbstractIterativeMethod):
    """`OneStep` again and again, the prior taken at the last image: for `TotalVariation`.

    Iteratively reweighted least squares; the scale of the hyperparameter is taken anew in each step.
    """

    steps: int = eqx.field(static=True, default=8)

    def image(self, problem, y):
        def again(_, x):
            return _one_step(problem, problem.precision(x)) @ y

        return jax.lax.fori_loop(0, self.steps, again, _one_step(problem, problem.precision()) @ y)


class SparseBayes(AbstractIterativeMethod):
    """Sparse Bayesian learning (Tipping 2001): each pixel has a variance of its own, found from the frame.

    With ``x ~ N(0, diag g)`` and noise of variance s,

        C = s I + J diag(g) J^T,    x = g J^T C^-1 y,    g_i <- x_i^2 + g_i (1 - q_i),    q_i = g_i (J^T C^-1 J)_ii,
        s <- (|y - J x|^2 + s sum(q)) / k.

    The first g follows the prior (a diagonal one), the first s is hyperparameter^2 of the data's variance.
    """

    steps: int = eqx.field(static=True, default=40)

    def image(self, problem, y):
        j, precision = problem.jacobian, problem.precision()
        if not isinstance(precision, Diagonal):
            raise ValueError("SparseBayes needs a diagonal prior: Noser() or Tikhonov()")
        power = jnp.sum(y**2) / len(j)
        power = jnp.where(power > 0, power, 1)
        g = 1 / precision.values
        g = g * power / (jnp.sum(j**2 * g) / len(j))

        def solved(g, s):
            return cho_factor(s * jnp.eye(len(j), dtype=j.dtype) + (j * g) @ j.T)

        def again(_, state):
            g, s = state
            factor = solved(g, s)
            x = g * (j.T @ cho_solve(factor, y))
            q = g * jnp.sum(j * cho_solve(factor, j), 0)
            left = jnp.sum((y - j @ x) ** 2) + s * jnp.sum(q)
            return x**2 + g * jnp.maximum(1 - q, 0), jnp.maximum(left / len(j), 1e-12 * power)

        g, s = jax.lax.fori_loop(0, self.steps, again, (g, problem.hyperparameter**2 * power))
        return g * (j.T @ cho_solve(solved(g, s), y))
