"""How do I describe a tank with electrodes on its rim? A skin without pads is a tank."""

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

radius, count = 0.14, 16  # m, electrodes
electrodes = je.skin.rim_electrodes(je.Disc(radius), count, contact=1e-3)  # ohm m; half of the rim is covered
protocol = je.Protocol(je.skin.adjacent(count), 1e-3)  # A
tank = je.Skin("tank", je.Disc(radius), 1.0, electrodes, protocol)  # sheet resistance: 1 ohm

model = je.discretise(je.Scene(tank), je.Fidelity.draft())
middle = jnp.array([0.05, 0.03])  # of an insulating rod, m from the centre of the tank
rod = jnp.linalg.norm(model.centroids - middle, axis=1) < 0.02
dv = je.forward(model, jnp.where(rod, 0.05, 1.0) * model.background) - je.forward(model)

recon = je.prepare(model, prior=je.Noser(), basis=je.Pixels(32), hyperparameter=0.05)
found = je.LevelCentroid(0.5)(-recon(dv), recon)  # the rod conducts less
print(f"{tank.protocol.readings} readings; rod at {1e3 * found[0]:.0f}, {1e3 * found[1]:.0f} mm (true 50, 30)")
