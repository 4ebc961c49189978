"""How do an image and the forces on the pads become one force map? The image says where, the pads say how much."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin = je.load_skin("testbed")
model = je.discretise(je.Scene(skin), je.Fidelity.draft())
recon = je.prepare(model, basis=je.Pixels(20), hyperparameter=0.1)
masks = je.pad_masks(skin, recon)


def touched(x, y, strength):
    distance = jnp.linalg.norm(model.centroids - jnp.array([x, y]), axis=1)
    return strength * jnp.exp(-(distance**2) / (2 * 0.008**2))


sigma = model.background * (1 + touched(0.05, 0.06, 0.3) + touched(0.15, 0.14, 0.9))
image = recon(je.forward(model, sigma) - je.forward(model))
forces = jnp.array([8.0, 0.0, 0.0, 5.0])  # N: lower left, lower right, upper left, upper right
fmap = je.fuse(image, masks, forces, pad_errors=jnp.array([0.1, 0.05, 0.05, 0.1]))

on_pads = masks.weights @ fmap.force
for pad, force, valid in zip(skin.pads, on_pads, fmap.valid, strict=True):
    print(f"{pad.name}: {force:.2f} N" + (", placed by the image" if valid else ""))
print(f"largest pressure: {fmap.pressure.max() / 1e3:.0f} kPa")
