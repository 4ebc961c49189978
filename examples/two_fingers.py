"""When do two fingers become one? In a linear image, when no valley is left between the two peaks."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
middle, distances = jnp.array([0.08, 0.1]), jnp.array([0.02, 0.03, 0.04, 0.05, 0.06, 0.08])  # m


def bump(place):
    return jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.006**2))


def frame(distance):
    """The change of the readings by two equal touches at a distance, one on each side of the middle."""
    half = jnp.array([0.5, 0.0]) * distance
    touched = model.background * (1 + 0.5 * bump(middle - half) + 0.5 * bump(middle + half))
    return je.forward(model, touched) - je.forward(model)


recon = je.prepare(model, basis=je.Pixels(40), hyperparameter=0.03)
images = recon(jax.lax.map(frame, distances)).reshape(-1, 40, 40)

valleys = {}
for distance, image in zip(distances, images, strict=True):
    line = image[20]  # through both touches, 5 mm a pixel
    left, right = jnp.argmax(line[:16]), 16 + jnp.argmax(line[16:])
    peaks = jnp.minimum(line[left], line[right])
    valleys[round(1e3 * float(distance))] = float(line[left : right + 1].min() / peaks)
    print(
        f"{1e3 * distance:.0f} mm apart: the valley is {100 * valleys[round(1e3 * float(distance))]:.0f} % of the peaks"
    )
