"""Methods of reconstruction: how data and prior are weighed against each other.

All work on whitened readings y (`whitening`), of independent noise of one size, with the Jacobian J of y:

    x = argmin |J x - y|^2 + l^2 x^T R x,        l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings.

The scale makes the hyperparameter a number without unit that means the same on every skin: the standard deviation of
the noise over that of the data which the prior expects.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._compile import one_by_one
from ..linalg.lapack import cho_factor, cho_solve, cholesky, qr, solve_triangular, svd
from ..model.bases import Picture
from ..registry import Registry
from .priors import AbstractPrecision, AbstractPrior, Diagonal

# Where Newton's method for `NonNegative` stands: steps, what is left of the data (k,), the pixels above zero (basis,)
# now and before, length of the last step.
_NewtonState = tuple[
    Int[Array, ""] | int, Float[Array, " k"], Bool[Array, " basis"], Bool[Array, " basis"], Float[Array, ""]
]


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
    """A choice of method: an `AbstractLinearMethod` or an `AbstractIterativeMethod`.

    ``follows_prior``: whether the method asks for the prior anew at each image, as `TotalVariation` needs.
    """

    follows_prior: ClassVar[bool] = False


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

    def image(self, problem: Problem, y: Float[Array, "k m"]) -> Float[Array, "basis m"]:
        return one_step(problem, problem.precision(), y)[0]

    def variance(self, problem: Problem) -> Float[Array, " basis"]:
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


def _damped(b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    """``z = argmin |b z - y|^2 + level^2 |z|^2``, and ``y - b z``.

    From the Cholesky factor of ``b b^T + level^2 I``, in the smaller space, while that keeps three quarters of the
    digits: its errors grow as one over level squared.  Below that from Q and R of b stacked on level I,
    which takes four times as long and whose errors grow as one over level.
    """
    least = jnp.finfo(b.dtype).eps ** 0.25 * jnp.max(jnp.sum(b**2, 0))
    found: tuple[Array, Array] = jax.lax.cond(level**2 > least, partial(_squared, least), _orthogonal, b, level, y)
    return found


def _squared(
    least: Float[Array, ""], b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]
) -> tuple[Array, Array]:
    k, n = b.shape
    level = jnp.where(level**2 > least, level, jnp.sqrt(least))  # a vmap computes this where it is not used too
    eye = jnp.eye(min(k, n), dtype=b.dtype)
    if k > n:
        z = cho_solve(cho_factor(b.T @ b + level**2 * eye), b.T @ y)
        return z, y - b @ z
    solved = cho_solve(cho_factor(b @ b.T + level**2 * eye), y)
    return b.T @ solved, level**2 * solved


def _orthogonal(b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    k, n = b.shape
    q, r = _stacked(b, level)
    if k > n:
        z = solve_triangular(r, q[:k].T @ y)
        return z, y - b @ z
    z = q @ solve_triangular(r, y, trans=1)
    return z[:n], level * z[n:]


def _stacked(b: Float[Array, "k n"], level: Float[Array, ""]) -> tuple[Array, Array]:
    """Q and R of ``[b; level I]``, of ``[b^T; level I]`` where b is wide."""
    tall = b if len(b) > b.shape[1] else b.T
    return qr(jnp.concatenate([tall, level * jnp.eye(tall.shape[1], dtype=b.dtype)]))


def _by_squares(problem: Problem, precision: AbstractPrecision, y: Float[Array, " k"]) -> Float[Array, " basis"]:
    """``Q y`` by Cholesky: for a precision that serves one frame, where a hyperparameter near zero makes no sense."""
    j = problem.jacobian
    gained = precision.solve(j.T)
    return gained @ cho_solve(cho_factor(j @ gained + problem.strength(gained) * jnp.eye(len(j), dtype=j.dtype)), y)


class TruncatedSvd(AbstractLinearMethod):
    """The pseudo-inverse on the singular values of ``J R^-1/2`` above l, the others left out.

    l as for `OneStep`, which halves what lies there; values that are only rounding are left out in any case. The image
    jumps where the hyperparameter passes a singular value and is constant between: its derivative with respect to the
    hyperparameter is zero.
    """

    def image(self, problem: Problem, y: Float[Array, "k m"]) -> Float[Array, "basis m"]:
        precision = problem.precision()
        b = precision.seen(problem.jacobian)
        return precision.image(_truncated(b, problem.level(b), y))


@jax.custom_jvp
def _truncated(b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """``V f(S) U^T y`` with ``f(s) = 1/s`` for the singular values of b above ``level``, else 0."""
    u, s, v = _thin_svd(b)
    return v @ (_inverse_above(level, b, s) * (u.T @ y).T).T


@_truncated.defjvp
def _(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """The derivative of a generalised matrix function (Noferini 2017), which no pair of equal singular values upsets.

    Which values are kept is constant but for jumps, so the level has no derivative.
    """
    (b, level, y), (db, _, dy) = primals, tangents
    u, s, v = _thin_svd(b)
    f = _inverse_above(level, b, s)
    kept = f > 0
    both, sums, apart = kept[:, None] & kept, s[:, None] + s, s[:, None] - s
    mixed = kept[:, None] != kept  # one is kept, the other not: their values differ
    safe = jnp.where(sums > 0, sums, 1)
    plus = jnp.where(sums > 0, (f[:, None] + f) / safe, 0)
    minus = jnp.where(both, -f[:, None] * f, jnp.where(mixed, (f[:, None] - f) / jnp.where(mixed, apart, 1), 0))
    turned, data, slopes = u.T @ db @ v, u.T @ y, db.T @ y
    inside = 0.5 * (minus * (turned + turned.T) + plus * (turned.T - turned)) @ data
    beyond_data = v.T @ slopes - turned.T @ data  # V^T dB^T (1 - U U^T) y
    beyond_image = db.T @ (u @ (f**2 * data.T).T)
    beyond_image = beyond_image - v @ (v.T @ beyond_image)
    change = v @ (inside + (f**2 * beyond_data.T + f * (u.T @ dy).T).T) + beyond_image
    return v @ (f * data.T).T, change


def _inverse_above(level: Float[Array, ""], b: Float[Array, "k n"], s: Float[Array, " r"]) -> Float[Array, " r"]:
    """``1/s`` above the level and above rounding, else 0."""
    kept = s > jnp.maximum(level, max(b.shape) * jnp.finfo(b.dtype).eps * s[0])
    return jnp.where(kept, 1 / jnp.where(kept, s, 1), 0)


def _thin_svd(b: Float[Array, "k n"]) -> tuple[Float[Array, "k r"], Float[Array, " r"], Float[Array, "n r"]]:
    """U, S and V of ``b = U S V^T``, through Q and R, as `svd` is for square matrices."""
    wide = b.shape[0] < b.shape[1]
    q, r = qr(b.T if wide else b)
    u, s, vt = svd(r)
    return (vt.T, s, q @ u) if wide else (q @ u, s, vt.T)


class BackProjection(AbstractLinearMethod):
    """Each pixel the mean of the readings weighed by its sensitivity, ``x_j = J_j . y / (|J_j|^2 + floor)``.

    The oldest method, for comparison; it knows neither prior nor hyperparameter, and its images are blurred.
    """

    floor: float = 1e-3

    def image(self, problem: Problem, y: Float[Array, "k m"]) -> Float[Array, "basis m"]:
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

    def image(self, problem: Problem, y: Float[Array, "k m"]) -> Float[Array, "basis m"]:
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

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        j, precision = problem.jacobian, problem.precision()
        square = problem.strength(precision.solve(j.T))
        if isinstance(precision, Diagonal):
            weight = square * precision.values
            above = _pixels_above_zero(self.steps)(*jax.lax.stop_gradient((j, weight, y)))
            return _positive_part(above, j, weight, y)
        return _interior(j.T @ j + square * precision.matrix(), j.T @ y, self.steps)[0]


def _positive_part(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " basis"]:
    """argmin of ``|J x - y|^2 + x^T diag(weight) x`` over these pixels, the others zero, without what is negative."""
    return jnp.maximum(j.T @ _left_by_many(above, j, weight, y) / weight, 0) * above


def _pixels_above_zero(steps: int) -> Callable[[Array, Array, Array], Array]:
    """A function of j, weight, y: the pixels above zero in argmin over x >= 0 of ``|J x - y|^2 + x^T diag(weight) x``.

    Of many frames one after the other, so that each pays only for the way it takes.
    """

    @one_by_one
    def found(
        j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
    ) -> Bool[Array, " basis"]:
        def going(state: _NewtonState) -> Bool[Array, ""]:
            step, _, above, before, length = state
            return (step < steps) & _moves(above, before, length)

        def again(state: _NewtonState) -> _NewtonState:
            step, a, above, *_ = state
            towards = _left(above, j, weight, y) - a
            length = _step_length(a, towards, y, j.T @ a, j.T @ towards, weight)
            a = a + length * towards
            return step + 1, a, j.T @ a > 0, above, length

        everywhere, none = jnp.ones(j.shape[1], bool), jnp.zeros(j.shape[1], bool)
        start: _NewtonState = (0, jnp.zeros_like(y), everywhere, none, jnp.ones((), y.dtype))
        _, _, above, before, length = jax.lax.while_loop(going, again, start)
        otherwise = partial(_by_interior, steps=steps)
        pixels: Array = jax.lax.cond(_moves(above, before, length), otherwise, lambda *_: above, j, weight, y)
        return pixels

    return found


def _moves(above: Bool[Array, " basis"], before: Bool[Array, " basis"], length: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether Newton's method has not ended: a whole step to the same pixels is the last."""
    return (length < 1) | jnp.any(above != before)


def _by_interior(
    j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"], steps: int
) -> Bool[Array, " basis"]:
    """The same pixels by the interior-point method."""
    j, weight = jax.lax.optimization_barrier((j, weight))  # XLA takes minutes to multiply constants
    return _interior(j.T @ j + jnp.diag(weight), j.T @ y, steps)[1]


def _interior(
    hessian: Float[Array, "basis basis"], b: Float[Array, " basis"], steps: int
) -> tuple[Float[Array, " basis"], Bool[Array, " basis"]]:
    """argmin over x >= 0 of ``x^T H x / 2 - b x``, and where it is above zero."""
    top, curved = jnp.max(jnp.abs(b)), jnp.mean(jnp.diagonal(hessian))
    top = jnp.where(top > 0, top, 1)  # all below is of the size of one, whatever the units
    start = jnp.ones_like(b), jnp.ones_like(b)
    x, z = jax.lax.fori_loop(0, steps, lambda _, state: _inwards(hessian / curved, b / top, *state), start)
    return x * (top / curved), x > z


def _left(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " k"]:
    """``y - J x`` if x were free in these pixels and zero elsewhere; solved among the pixels if they are few."""
    size = min(len(above), len(j) // 2)

    def few(j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        at, there = jnp.flatnonzero(above, size=size, fill_value=0), jnp.arange(size) < jnp.sum(above)
        part = jnp.where(there, j[:, at], 0)
        small = part.T @ part + jnp.diag(jnp.where(there, weight[at], 1))
        return y - part @ cho_solve(cho_factor(small), part.T @ y)

    many = partial(_left_by_many, above)
    left: Array = jax.lax.cond(jnp.sum(above) <= size, few, many, j, weight, y)
    return left


def _left_by_many(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " k"]:
    """`_left` among the data."""
    return cho_solve(cho_factor(jnp.eye(len(j), dtype=j.dtype) + (j * (above / weight)) @ j.T), y)


def _step_length(
    a: Float[Array, " k"],
    towards: Float[Array, " k"],
    y: Float[Array, " k"],
    here: Float[Array, " basis"],
    ahead: Float[Array, " basis"],
    weight: Float[Array, " basis"],
) -> Float[Array, ""]:
    """The best of 1, 1/2, 1/4 ... of a step, for the function of `NonNegative`."""
    length = 0.5 ** jnp.arange(12, dtype=a.dtype)
    moved = a + length[:, None] * towards
    image = jnp.maximum(here + length[:, None] * ahead, 0)
    return length[jnp.argmin(0.5 * jnp.sum(moved**2, 1) - moved @ y + 0.5 * jnp.sum(image**2 / weight, 1))]


def _inwards(
    hessian: Float[Array, "basis basis"],
    b: Float[Array, " basis"],
    x: Float[Array, " basis"],
    z: Float[Array, " basis"],
) -> tuple[Float[Array, " basis"], Float[Array, " basis"]]:
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

    follows_prior: ClassVar[bool] = True
    steps: int = eqx.field(static=True, default=8)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        def again(_: Int[Array, ""], x: Float[Array, " basis"]) -> Float[Array, " basis"]:
            return _by_squares(problem, problem.precision(x), y)

        image: Array = jax.lax.fori_loop(0, self.steps, again, _by_squares(problem, problem.precision(), y))
        return image


class SparseBayes(AbstractIterativeMethod):
    """Sparse Bayesian learning (Tipping 2001): each pixel has a variance of its own, found from the frame.

    With ``x ~ N(0, diag g)`` and noise of variance s,

        C = s I + J diag(g) J^T,    x = g J^T C^-1 y,    g_i <- x_i^2 / q_i,    q_i = g_i (J^T C^-1 J)_ii,
        s <- (|y - J x|^2 + s sum(q)) / k.

    The first g follows the prior (a diagonal one), the first s is hyperparameter^2 of the data's variance.  The rule
    for g is MacKay's, which Tipping takes; it needs a fraction of the steps of ``g_i <- x_i^2 + g_i (1 - q_i)``.
    """

    steps: int = eqx.field(static=True, default=15)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
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

        def lower(g: Float[Array, " basis"], s: Float[Array, ""]) -> Float[Array, "k k"]:
            return cholesky(s * jnp.eye(len(j), dtype=j.dtype) + (j * g) @ j.T, lower=True)

        def again(
            _: Int[Array, ""], state: tuple[Float[Array, " basis"], Float[Array, ""]]
        ) -> tuple[Float[Array, " basis"], Float[Array, ""]]:
            g, s = state
            factor = lower(g, s)
            half = solve_triangular(factor, j, lower=True)
            seen, own = half.T @ solve_triangular(factor, y, lower=True), jnp.sum(half**2, 0)
            left = jnp.sum((y - j @ (g * seen)) ** 2) + s * jnp.sum(g * own)
            return g * seen**2 / jnp.where(own > 0, own, 1), jnp.maximum(left / len(j), least)

        g, s = jax.lax.fori_loop(0, self.steps, again, (g, problem.hyperparameter**2 * power))
        image: Array = top * g * (j.T @ cho_solve((lower(g, s), True), y))
        return image


METHODS = Registry(AbstractMethod, "method", "jaxeit.methods")
"""Methods by the names that the command line and recipes use."""
