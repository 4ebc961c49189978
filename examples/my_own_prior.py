"""How do I add a prior of my own? One class with the penalty x^T R x; every method then uses it."""

import jax
import jax.numpy as jnp

import jaxeit as je
from jaxeit.imaging import Diagonal

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you


class Near(je.AbstractPrior):
    """Contacts are expected within a radius of a place, such as a button on the skin."""

    x: float = 0.06  # m
    y: float = 0.13
    radius: float = 0.03

    def precision(self, jacobian, picture, at=None):
        """R is small near the place and large far from it, times that of NOSER."""
        square = jnp.sum((picture.centres - jnp.array([self.x, self.y])) ** 2, 1)
        return Diagonal(je.Noser().precision(jacobian, picture).values * (1 + square / self.radius**2) ** 2)


model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
offset = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1)  # m
touched = model.background * jnp.where(offset < 0.01, 1.5, 1.0)
dv = je.forward(model, touched) - je.forward(model)

far = {}
for prior in (je.Noser(), Near()):
    recon = je.prepare(model, prior=prior, basis=je.Pixels(20))
    image = jnp.abs(recon(dv))
    distance = jnp.linalg.norm(recon.picture.centres - jnp.array([0.06, 0.13]), axis=1)
    far[type(prior).__name__] = float(image[distance > 0.05].max() / image.max())
    print(f"{type(prior).__name__}: largest artefact beyond 50 mm {100 * far[type(prior).__name__]:.1f} % of the peak")
