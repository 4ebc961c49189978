"""How much does a misplaced electrode matter? Readings as a differentiable function of where the electrodes sit."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin = je.load_skin("testbed")
model = je.discretise(je.Scene(skin, effects=()), je.Fidelity.draft())
motion = je.model.electrode_motion(model)  # how the mesh follows each electrode; once, outside of jit


@jax.jit
def readings(shift):
    """Voltages, (550,) V, with the electrodes shifted by (25, 2) m."""
    return je.forward(je.model.moved(model, motion, shift))


def unevenness(shift):
    """Spread of the readings of neighbouring bolts: some loss of your own."""
    return jnp.std(jnp.log(jnp.abs(readings(shift))))


placed = 1e-3 * jax.random.normal(jax.random.key(0), (25, 2))  # bolts drilled 1 mm off, in x and in y
change = readings(placed) / readings(jnp.zeros((25, 2))) - 1
slopes = je.model.shift_jacobian(model, motion)  # V/m, (550, 25, 2): one factorisation
linear = jnp.einsum("res,es->r", slopes, placed) / je.forward(model)
gradient = jax.grad(unevenness)(jnp.zeros((25, 2)))  # 1/m, for a design of your own

print(f"bolts 1 mm off change readings by {100 * jnp.median(jnp.abs(change)):.1f} % (median)")
print(f"the derivative leaves {100 * jnp.linalg.norm(change - linear) / jnp.linalg.norm(change):.0f} % of the change")
print(f"steepest for the spread of readings: bolt {int(jnp.argmax(jnp.linalg.norm(gradient, axis=1)))}")
