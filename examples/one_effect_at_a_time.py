"""What does each physical effect do to the readings? A scene simulates only the effects that it lists."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin, tip = je.load_skin("testbed"), (jnp.array([0.06, 0.13]), 0.01)  # centre and diameter, m
effects = [
    (),
    (je.effects.ContactPiezoresistance(),),
    (je.effects.ContactPiezoresistance(), je.effects.LoadSpreading()),
    (je.effects.ContactPiezoresistance(), je.effects.LoadSpreading(), je.effects.CoatingNonUniformity()),
]

largest = {}
for chosen in effects:
    model = je.discretise(je.Scene(skin, effects=chosen), je.Fidelity.draft())
    pressure = 10.0 * je.model.load_spread(model, *tip)  # Pa: 10 N under the tip
    dv = je.forward(model, je.conductivity(model, pressure)) - je.forward(model)
    name = " + ".join(type(effect).__name__ for effect in chosen) or "ideal sensor"
    largest[name] = float(jnp.abs(dv).max())
    print(f"{name}: largest change of a reading {1e3 * largest[name]:.3f} mV")
