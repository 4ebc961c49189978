"""How strong should the prior be? A number, or a rule that finds one from the noise or from a frame."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
v0, place = je.forward(model), jnp.array([0.06, 0.13])
distance = jnp.linalg.norm(model.centroids - place, axis=1)
noise = 1e-4 * jnp.abs(v0).max()  # V
dv = je.forward(model, model.background * jnp.where(distance < 0.01, 1.5, 1.0)) - v0
dv = dv + noise * jax.random.normal(jax.random.key(0), dv.shape)

rules = {
    "weak, 0.001": 0.001,
    "0.1": 0.1,
    "strong, 10": 10.0,
    "noise figure 0.5": je.NoiseFigure(0.5),
    "L-curve": je.imaging.LCurve(dv),
    "cross-validation": je.imaging.GeneralisedCrossValidation(dv),
}
figures, images = {}, {}
for name, rule in rules.items():
    recon = je.prepare(model, basis=je.Pixels(20), noise=jnp.full(len(v0), noise), hyperparameter=rule)
    images[name] = recon(dv).reshape(recon.shape)
    found = je.metrics.greit_figures(recon(dv), recon, place, [0.1, 0.1])
    figures[name] = (float(found.resolution), float(found.ringing))
    print(f"{name}: the touch covers {100 * found.resolution**2:.0f} % of the sheet, ringing {found.ringing:.2f}")
