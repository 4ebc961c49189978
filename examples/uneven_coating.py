"""What does an uneven coating cost, and how is it taken into account? It is fitted to a frame without contact."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
x, y = model.centroids.T
coating = model.background * jnp.exp(0.2 * jnp.sin(40 * x) * jnp.cos(30 * y))  # uneven by 15 %, which nobody knows
v0 = je.forward(model, coating)

places = jnp.array([[0.05, 0.05], [0.15, 0.06], [0.10, 0.10], [0.06, 0.15], [0.14, 0.14]])  # m
bumps = jnp.exp(-jnp.sum((model.centroids - places[:, None]) ** 2, -1) / (2 * 0.006**2))
dv = jax.jit(jax.vmap(lambda bump: je.forward(model, coating * (1 + 0.5 * bump))))(bumps) - v0

noise = jnp.full(len(v0), 1e-4 * float(jnp.abs(v0).max()))  # V
errors = {}
for name, untouched in (("assumed even", None), ("fitted to the frame without contact", v0)):
    find = je.prepare_contacts(model, noise=noise, untouched=untouched)
    found = jnp.stack([je.contacts.strongest(find(change))[:2] for change in dv])
    errors[name] = float(jnp.linalg.norm(found - places, axis=1).mean())
    print(f"coating {name}: mean error of the place {1e3 * errors[name]:.2f} mm")
