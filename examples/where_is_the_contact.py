"""Where does a finger touch the sheet, and how surely? Contacts are fitted to one frame, with their covariance."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
v0 = je.forward(model)

place = jnp.array([0.06, 0.13])  # m
touched = model.background * (1 + 0.5 * jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.006**2)))
noise = 1e-4 * jnp.abs(v0).max()  # V, the standard deviation of every reading
frame = je.forward(model, touched) + noise * np.random.default_rng(1).normal(size=len(v0))

find = je.prepare_contacts(model, noise=jnp.full(len(v0), noise))
contacts = find(frame - v0)

found = je.contacts.strongest(contacts)
spread = jnp.sqrt(jnp.diag(contacts.covariance[0][:2, :2]))
print(f"contacts: {int(contacts.present.sum())}")
print(f"place: {1e3 * found[0]:.2f}, {1e3 * found[1]:.2f} mm (true 60, 130)")
print(f"standard errors: {1e3 * spread[0]:.2f}, {1e3 * spread[1]:.2f} mm")
