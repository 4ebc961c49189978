"""Is it one touch, two or an edge, and where? A network that was trained in simulation says so, without a fit."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

# Presses on an uneven skin that nobody knows: each is a row of tips that share 20 N.
effects = (
    je.effects.LoadSpreading(0.01),
    je.effects.CoatingNonUniformity(0.15, seed=7),
    je.effects.ContactGain(0.12, seed=8),
    je.effects.ContactPiezoresistance(),
)
model = je.discretise(je.Scene(je.load_skin("testbed"), effects), je.Fidelity.draft())
touches = {
    "one": np.array([[0.065, 0.13]]),
    "two": np.array([[0.1, 0.05], [0.14, 0.08]]),
    "edge": np.linspace([0.05, 0.06], [0.1, 0.1], 9),
}


def readings(places):
    pressure = sum(20 / len(places) * je.model.load_spread(model, place, 0.01) for place in jnp.asarray(places))
    return je.forward(model, je.conductivity(model, pressure))


v0 = readings(np.array([[-1.0, -1.0]]))  # nothing on the sheet
noise = 1e-3 * np.sqrt(np.mean(v0**2))
rng = np.random.default_rng(1)

# The shipped network of this skin; `jaxeit train SKIN -o proposal.npz` makes one for another skin.
proposal = je.contacts.shipped_proposal(je.load_skin("testbed"))
probabilities, errors = {}, {}
for name, places in touches.items():
    found = proposal(readings(places) - v0 + noise * rng.normal(size=len(v0)))
    probabilities[name] = dict(zip(("none", "one", "two", "edge", "more"), found.probability, strict=True))
    middle = found.of(found.kind)[:, :2].mean(0)
    errors[name] = 1e3 * np.linalg.norm(middle - places.mean(0))
    stated = ", ".join(f"{kind} {p:.0%}" for kind, p in probabilities[name].items() if p > 0.005)
    print(f"{name}: {stated}; its middle is off by {errors[name]:.1f} mm; outside of the training: {found.outside}")
