"""How sharp is an image, and where? The GREIT figures of merit for touches from the middle of the sheet to its rim."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
places = jnp.stack([jnp.linspace(0.1, 0.19, 7), jnp.full(7, 0.1)], 1)  # m


def frame(place):
    bump = jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.006**2))
    return je.forward(model, model.background * (1 + 0.5 * bump)) - je.forward(model)


recon = je.prepare(model, basis=je.Pixels(40), hyperparameter=0.1)
images = recon(jax.lax.map(frame, places))
figures = je.metrics.greit_figures(images, recon, places, [0.1, 0.1])
errors = je.localisation_error(je.LevelCentroid(0.5)(images, recon), places)  # m
for place, radius, error in zip(places, 0.2 - places[:, 0], errors, strict=True):
    print(f"touch at x = {1e3 * place[0]:.0f} mm, {1e3 * radius:.0f} mm from the rim: error {1e3 * error:.1f} mm")
print(
    f"radius of the blob: {100 * figures.resolution.min():.0f} to {100 * figures.resolution.max():.0f} % of the sheet's"
)
