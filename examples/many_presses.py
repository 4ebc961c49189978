"""How do I simulate many presses in one call? jax.vmap over places; the frames are a data set for any learner."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
places = jax.random.uniform(jax.random.key(0), (200, 2), minval=0.02, maxval=0.18)  # m


def frame(place):
    """The change of the readings, V, by a press at (2,) m."""
    bump = jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.006**2))
    return je.forward(model, model.background * (1 + 0.5 * bump)) - je.forward(model)


frames = jax.jit(lambda places: jax.lax.map(frame, places, batch_size=50))(places)  # (200, readings)

# The simplest learner: a press is where the known press with the most similar frame was.
shapes = frames / jnp.linalg.norm(frames, axis=1, keepdims=True)
nearest = jnp.argmax(shapes[150:] @ shapes[:150].T, axis=1)
error = float(jnp.linalg.norm(places[:150][nearest] - places[150:], axis=1).mean())
print(f"{len(frames)} frames of {frames.shape[1]} readings; the nearest of 150 presses is {1e3 * error:.0f} mm away")
