"""GREIT: the linear map that is trained on contacts and the images that they should have."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...registry import limited
from ...registry.limits import LONGEST
from .base import AbstractLinearMethod, Problem
from .one_step import damped_solution


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

    width: float = limited(0.012, above=0, most=LONGEST)
    radius: float = limited(0.02, above=0, most=LONGEST)
    edge: float = limited(0.004, above=0, most=LONGEST)

    def image(self, problem: Problem, y: Float[Array, "k ..."]) -> Float[Array, "basis ..."]:
        areas, centres = problem.picture.areas, problem.picture.centres
        square = jnp.sum((centres[:, None] - centres) ** 2, -1)
        distance = jnp.sqrt(square)
        contacts = jnp.where(areas > 0, jnp.exp(-0.5 * square / self.width**2), 0)
        disc = jax.nn.sigmoid((self.radius - distance) / self.edge)
        mass, whole = areas @ contacts, areas @ disc
        desired = disc * jnp.where(whole > 0, mass / jnp.where(whole > 0, whole, 1), 0)
        trained = problem.jacobian @ contacts
        # Y^T (Y Y^T + l^2)^-1 y is the z of least |Y z - y|^2 + l^2 |z|^2.
        return desired @ damped_solution(trained, problem.level(trained), y)[0]
