"""How do I use gradients of readings in my own loss? Readings are differentiable, under your own jax.jit too."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())


def readings(place, strength):
    """Of a soft bump at (2,) m that multiplies the conductivity by 1 + strength in its middle."""
    bump = jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.008**2))
    return je.forward(model, model.background * (1 + strength * bump))


truth = jnp.array([0.07, 0.12])
measured = readings(truth, 0.5)
scale = jnp.std(measured - je.forward(model))


@jax.jit
def loss(guess):
    return jnp.mean(((readings(guess[:2], guess[2]) - measured) / scale) ** 2)


value_and_slope = jax.jit(jax.value_and_grad(loss))
guess, rate = jnp.array([0.08, 0.11, 0.3]), jnp.array([2e-5, 2e-5, 5e-2])  # m, m, 1
for _ in range(100):
    value, slope = value_and_slope(guess)
    guess = guess - rate * slope
print(f"loss {value:.1e}")
print(f"place {1e3 * guess[0]:.2f}, {1e3 * guess[1]:.2f} mm (true 70, 120); strength {guess[2]:.3f} (true 0.5)")
