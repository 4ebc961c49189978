"""What happens to an image when readings are missing? A missing reading is left out exactly, not taken for zero."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
offset = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1)  # m
touched = model.background * jnp.where(offset < 0.01, 1.5, 1.0)
dv = je.forward(model, touched) - je.forward(model)

recon = je.prepare(model, basis=je.Pixels(20))
broken = dv.at[::10].set(jnp.nan)  # one reading in ten
zeros = jnp.where(jnp.isfinite(broken), broken, 0.0)  # what must not be done
whole = recon(dv)
changes = {}
for name, given in (("left out", broken), ("taken for zero", zeros)):
    changes[name] = float(jnp.linalg.norm(recon(given) - whole) / jnp.linalg.norm(whole))
    print(f"a tenth of the readings {name}: the image changes by {100 * changes[name]:.0f} %")
