"""Is a recording sound? Drive and sense exchanged give the same voltage, whatever touches the skin."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin = je.load_skin("testbed")
model = je.discretise(je.Scene(skin), je.Fidelity.draft())
partner = je.skin.reciprocal_rows(skin.protocol.pattern)  # -1 where a reading has no partner
rows = jnp.flatnonzero(jnp.asarray(partner) >= 0)

x, y = model.centroids.T
touched = model.background * (1 + 0.8 * jnp.exp(-((x - 0.07) ** 2 + (y - 0.12) ** 2) / (2 * 0.01**2)))
v = je.forward(model, touched)


def mismatch(v):
    """The largest difference of two readings that must be equal, as a fraction of the largest reading."""
    return float(jnp.abs(v[rows] - v[partner[rows]]).max() / jnp.abs(v).max())


swapped = v.at[jnp.array([100, 101])].set(v[jnp.array([101, 100])])  # two readings have changed places
found = {"sound": mismatch(v), "two readings swapped": mismatch(swapped)}
for name, value in found.items():
    print(f"{name}: {len(rows)} readings differ from their partner by at most {value:.1e} of the largest reading")
