"""How much does noise move each pixel of an image? An image is a matrix times a frame, so that the noise is known."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
v0 = je.forward(model)
noise = 1e-4 * float(jnp.abs(v0).max())  # V, the standard deviation of every reading
recon = je.prepare(model, basis=je.Pixels(20), hyperparameter=0.1)

expected = noise * jnp.linalg.norm(recon.matrix, axis=1)  # S, of each pixel
frames = noise * jax.random.normal(jax.random.key(0), (2000, len(v0)))  # nobody touches the skin
measured = jnp.std(recon(frames), axis=0)

apart = float(jnp.abs(measured / expected - 1).max())
print(f"noise of a pixel: {1e6 * expected.min():.2g} to {1e6 * expected.max():.2g} uS")
print(f"2,000 frames of noise agree with the matrix within {100 * apart:.0f} %")
