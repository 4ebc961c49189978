"""Methods of reconstruction: how data and prior are weighed against each other.

All work on whitened readings y (`whitening`), of independent noise of one size, with the Jacobian J of y:

    x = argmin |J x - y|^2 + l^2 x^T R x,        l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings.

The scale makes the hyperparameter a number without unit that means the same on every skin: the standard deviation of
the noise over that of the data which the prior expects.
"""

from abc import abstractmethod
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .basis import Picture
from .lapack import cho_factor, cho_solve, cholesky, solve_triangular
from .priors import AbstractPrecision, AbstractPrior, Diagonal
from .verbs import one_by_one


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

    def level(self, seen: Float[Array, "k n"]) -> Float[Array, ""]:
        """``l``, given ``J Gamma^-1``; no square of the hyperparameter is formed."""
        return self.hyperparameter * jnp.sqrt(jnp.sum(seen**2) / self.readings)


class AbstractMethod(eqx.Module):
    """A choice of method: an `AbstractLinearMethod` or an `AbstractIterativeMethod`."""


class AbstractLinearMethod(AbstractMethod):
    """A method whose image is a matrix Q times the readings."""

    @abstractmethod
    def image(self, problem: Problem, y: Float[Array, "k m"]) -> Float[Array, "basis m"]:
        """``Q y``, the images of whitened frames: a frame a column."""

    def variance(self, problem: Problem) -> Float[Array, " basis"]:
        """What noise and prior leave uncertain in each coefficient, for noise of unit variance; infinite: not known."""
        return jnp.full_like(problem.picture.areas, jnp.inf)


class AbstractIterativeMethod(AbstractMethod):
    """A method that works on each frame anew, in a fixed number of steps."""

    @abstractmethod
    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        """The image of one whitened frame."""


class OneStep(AbstractLinearMethod):
    """One regularised Gauss-Newton step, ``Q = (J^T J + l^2 R)^-1 J^T``  (the paper's equation 2).

    Solved by an orthogonal factor in the smaller of the two spaces, which agree to rounding:
    ``Q = R^-1 J^T (J R^-1 J^T + l^2 I)^-1``.
    """

    def image(self, problem, y):
        return one_step(problem, problem.precision(), y)[0]

    def variance(self, problem):
        """The diagonal of ``(J^T J + l^2 R)^-1``, the posterior of a Gaussian image."""
        precision = problem.precision()
        b = precision.seen(problem.jacobian)
        (k, n), level = b.shape, problem.level(b)
        q, r = _stacked(b, level)
        if k > n:
            return jnp.sum(precision.image(solve_triangular(r, jnp.eye(n, dtype=b.dtype))) ** 2, 1)
        return (precision.variance() - jnp.sum(precision.image(q[:n]) ** 2, 1)) / level**2


def one_step(
    problem: Problem, precision: AbstractPrecision, y: Float[Array, "k ..."]
) -> tuple[Float[Array, "basis ..."], Float[Array, "k ..."]]:
    """``x = Q y`` of `OneStep`, and ``J x``, what the image predicts for the readings."""
    b = precision.seen(problem.jacobian)
    z, left = _damped(b, problem.level(b), y)
    return precision.image(z), y - left


def _damped(b: Float[Array, "k n"], level, y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    """``z = argmin |b z - y|^2 + level^2 |z|^2``, and ``y - b z``.

    From the Cholesky factor of ``b b^T + level^2 I``, in the smaller space, while that keeps three quarters of the
    digits: its errors grow as one over level squared.  Below that from Q and R of b stacked on level I,
    which takes four times as long and whose errors grow as one over level.
    """
    enough = level**2 > jnp.finfo(b.dtype).eps ** 0.25 * jnp.max(jnp.sum(b**2, 0))
    return jax.lax.cond(enough, _squared, _orthogonal, b, level, y)


def _squared(b: Float[Array, "k n"], level, y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    k, n = b.shape
    eye = jnp.eye(min(k, n), dtype=b.dtype)
    if k > n:
        z = cho_solve(cho_factor(b.T @ b + level**2 * eye), b.T @ y)
        return z, y - b @ z
    solved = cho_solve(cho_factor(b @ b.T + level**2 * eye), y)
    return b.T @ solved, level**2 * solved


def _orthogonal(b: Float[Array, "k n"], level, y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    k, n = b.shape
    q, r = _stacked(b, level)
    if k > n:
        z = solve_triangular(r, q[:k].T @ y)
        return z, y - b @ z
    z = q @ solve_triangular(r, y, trans=1)
    return z[:n], level * z[n:]


def _stacked(b: Float[Array, "k n"], level) -> tuple[Array, Array]:
    """Q and R of ``[b; level I]``, of ``[b^T; level I]`` where b is wide."""
    tall = b if len(b) > b.shape[1] else b.T
    return jnp.linalg.qr(jnp.concatenate([tall, level * jnp.eye(tall.shape[1], dtype=b.dtype)]))


def _by_squares(problem: Problem, precision: AbstractPrecision, y: Float[Array, " k"]) -> Float[Array, " basis"]:
    """``Q y`` by Cholesky: for a precision that serves one frame, where a hyperparameter near zero makes no sense."""
    j = problem.jacobian
    gained = precision.solve(j.T)
    return gained @ cho_solve(cho_factor(j @ gained + problem.strength(gained) * jnp.eye(len(j), dtype=j.dtype)), y)


class TruncatedSvd(AbstractLinearMethod):
    """The pseudo-inverse on the singular values of ``J R^-1/2`` above l, the others left out.

    l as for `OneStep`, which halves what lies there; what is but rounding is left out in any case.
    """

    def image(self, problem, y):
        precision = problem.precision()
        b = precision.seen(problem.jacobian)
        u, s, vt = jnp.linalg.svd(b, full_matrices=False)
        kept = s > jnp.maximum(problem.level(b), max(b.shape) * jnp.finfo(b.dtype).eps * s[0])
        inverse = jnp.where(kept, 1 / s, 0)
        return precision.image((vt.T * inverse) @ (u.T @ y))


class BackProjection(AbstractLinearMethod):
    """Each pixel the mean of the readings weighed by its sensitivity, ``x_j = J_j . y / (|J_j|^2 + floor)``.

    The oldest method, for comparison; it knows neither prior nor hyperparameter, and its images are blurred.
    """

    floor: float = 1e-3

    def image(self, problem, y):
        power = jnp.sum(problem.jacobian**2, 0)
        return (y.T @ problem.jacobian / (power + self.floor * jnp.max(power))).T


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

    def image(self, problem, y):
        areas, centres = problem.picture.areas, problem.picture.centres
        square = jnp.sum((centres[:, None] - centres) ** 2, -1)
        distance = jnp.sqrt(square)
        contacts = jnp.exp(-0.5 * square / self.width**2) * (areas > 0)
        disc = jax.nn.sigmoid((self.radius - distance) / self.edge)
        mass, whole = areas @ contacts, areas @ disc
        desired = disc * jnp.where(whole > 0, mass / jnp.where(whole > 0, whole, 1), 0)
        trained = problem.jacobian @ contacts
        return desired @ _damped(trained, problem.level(trained), y)[0]


class NonNegative(AbstractIterativeMethod):
    """`OneStep` under the constraint x >= 0: a touch only adds conductivity.

    With a diagonal prior by Newton's method in the data space: what is left of the data, ``a = y - J x``, is the
    minimum of ``|a|^2 / 2 - y a + sum (J^T a)_+^2 / (2 l^2 R)``, and ``x = (J^T a)_+ / (l^2 R)``; pieces of a parabola,
    so that it ends exactly, after 5 to 20 steps at hyperparameters from 0.1, of which all but the first are cheap.
    Where it has not ended, below about 0.03, and with another prior throughout, by a primal-dual interior-point method
    (Nocedal and Wright 2006, section 16.6), each of whose steps divides the duality gap by about ten, whatever the
    hyperparameter.

    ``steps`` is the most of the former and the number of the latter.
    """

    steps: int = eqx.field(static=True, default=40)

    def image(self, problem, y):
        j, precision = problem.jacobian, problem.precision()
        square = problem.strength(precision.solve(j.T))
        if isinstance(precision, Diagonal):
            weight = square * precision.values
            above = _pixels_above_zero(self.steps)(*jax.lax.stop_gradient((j, weight, y)))
            return _positive_part(above, j, weight, y)
        return _interior(j.T @ j + square * precision.matrix(), j.T @ y, self.steps)[0]


def _positive_part(above, j, weight, y):
    """argmin of ``|J x - y|^2 + x^T diag(weight) x`` over these pixels, the others zero, without what is negative."""
    return jnp.maximum(j.T @ _left_by_many(above, j, weight, y) / weight, 0) * above


def _pixels_above_zero(steps: int):
    """A function of j, weight, y: the pixels above zero in argmin over x >= 0 of ``|J x - y|^2 + x^T diag(weight) x``.

    Of many frames one after the other, so that each pays only for the way it takes.
    """

    @one_by_one
    def found(j, weight, y):
        def going(state):
            step, _, above, before, length = state
            return (step < steps) & _moves(above, before, length)

        def again(state):
            step, a, above, *_ = state
            towards = _left(above, j, weight, y) - a
            length = _step_length(a, towards, y, j.T @ a, j.T @ towards, weight)
            a = a + length * towards
            return step + 1, a, j.T @ a > 0, above, length

        everywhere, none = jnp.ones(j.shape[1], bool), jnp.zeros(j.shape[1], bool)
        start = (0, jnp.zeros_like(y), everywhere, none, jnp.ones((), y.dtype))
        _, _, above, before, length = jax.lax.while_loop(going, again, start)
        otherwise = partial(_by_interior, steps=steps)
        return jax.lax.cond(_moves(above, before, length), otherwise, lambda *_: above, j, weight, y)

    return found


def _moves(above, before, length):
    """Whether Newton's method has not ended: a whole step to the same pixels is the last."""
    return (length < 1) | jnp.any(above != before)


def _by_interior(j, weight, y, steps: int):
    """The same pixels by the interior-point method."""
    j, weight = jax.lax.optimization_barrier((j, weight))  # XLA takes minutes to multiply constants
    return _interior(j.T @ j + jnp.diag(weight), j.T @ y, steps)[1]


def _interior(hessian, b, steps: int):
    """argmin over x >= 0 of ``x^T H x / 2 - b x``, and where it is above zero."""
    top, curved = jnp.max(jnp.abs(b)), jnp.mean(jnp.diagonal(hessian))
    top = jnp.where(top > 0, top, 1)  # all below is of the size of one, whatever the units
    start = jnp.ones_like(b), jnp.ones_like(b)
    x, z = jax.lax.fori_loop(0, steps, lambda _, state: _inwards(hessian / curved, b / top, *state), start)
    return x * (top / curved), x > z


def _left(above, j, weight, y):
    """``y - J x`` if x were free in these pixels and zero elsewhere; solved among the pixels if they are few."""
    size = min(len(above), len(j) // 2)

    def few(j, weight, y):
        at, there = jnp.flatnonzero(above, size=size, fill_value=0), jnp.arange(size) < jnp.sum(above)
        part = jnp.where(there, j[:, at], 0)
        small = part.T @ part + jnp.diag(jnp.where(there, weight[at], 1))
        return y - part @ cho_solve(cho_factor(small), part.T @ y)

    many = partial(_left_by_many, above)
    return jax.lax.cond(jnp.sum(above) <= size, few, many, j, weight, y)


def _left_by_many(above, j, weight, y):
    """`_left` among the data."""
    return cho_solve(cho_factor(jnp.eye(len(j), dtype=j.dtype) + (j * (above / weight)) @ j.T), y)


def _step_length(a, towards, y, here, ahead, weight):
    """The best of 1, 1/2, 1/4 ... of a step, for the function of `NonNegative`."""
    length = 0.5 ** jnp.arange(12, dtype=a.dtype)
    moved = a + length[:, None] * towards
    image = jnp.maximum(here + length[:, None] * ahead, 0)
    return length[jnp.argmin(0.5 * jnp.sum(moved**2, 1) - moved @ y + 0.5 * jnp.sum(image**2 / weight, 1))]


def _inwards(hessian, b, x, z):
    """One step towards ``H x - b = z``, ``x z = 0``, staying inside x, z > 0."""
    target = jnp.maximum(0.1 * jnp.mean(x * z), jnp.finfo(x.dtype).eps ** 2)  # to zero, z / x would lose its sense
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
            return _by_squares(problem, problem.precision(x), y)

        return jax.lax.fori_loop(0, self.steps, again, _by_squares(problem, problem.precision(), y))


class SparseBayes(AbstractIterativeMethod):
    """Sparse Bayesian learning (Tipping 2001): each pixel has a variance of its own, found from the frame.

    With ``x ~ N(0, diag g)`` and noise of variance s,

        C = s I + J diag(g) J^T,    x = g J^T C^-1 y,    g_i <- x_i^2 / q_i,    q_i = g_i (J^T C^-1 J)_ii,
        s <- (|y - J x|^2 + s sum(q)) / k.

    The first g follows the prior (a diagonal one), the first s is hyperparameter^2 of the data's variance.  The rule
    for g is MacKay's, which Tipping takes; it needs a fraction of the steps of ``g_i <- x_i^2 + g_i (1 - q_i)``.
    """

    steps: int = eqx.field(static=True, default=15)

    def image(self, problem, y):
        j, precision = problem.jacobian, problem.precision()
        if not isinstance(precision, Diagonal):
            raise ValueError("SparseBayes needs a diagonal prior: Noser() or Tikhonov()")
        top = jnp.max(jnp.abs(y))
        top = jnp.where(top > 0, top, 1)
        y = y / top
        power = jnp.sum(y**2) / len(j)
        power = jnp.where(power > 0, power, 1)
        g = 1 / precision.values
        g = g * power / (jnp.sum(j**2 * g) / len(j))
        least = max(1e-12, 4 * len(j) * float(jnp.finfo(j.dtype).eps)) * power  # C keeps a Cholesky factor

        def lower(g, s):
            return cholesky(s * jnp.eye(len(j), dtype=j.dtype) + (j * g) @ j.T, lower=True)

        def again(_, state):
            g, s = state
            factor = lower(g, s)
            half = solve_triangular(factor, j, lower=True)
            seen, own = half.T @ solve_triangular(factor, y, lower=True), jnp.sum(half**2, 0)
            left = jnp.sum((y - j @ (g * seen)) ** 2) + s * jnp.sum(g * own)
            return g * seen**2 / jnp.where(own > 0, own, 1), jnp.maximum(left / len(j), least)

        g, s = jax.lax.fori_loop(0, self.steps, again, (g, problem.hyperparameter**2 * power))
        return top * g * (j.T @ cho_solve((lower(g, s), True), y))
