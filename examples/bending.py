"""Does bending a skin change its readings? Rolling does not stretch the sheet; a ball does. (The rest is the mesh.)"""

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

flat = je.load_skin("testbed")
shapes = {
    "flat": flat,
    "rolled, radius 50 mm": replace(flat, surface=je.Cylinder(0.05, middle=0.1)),
    "on a ball, radius 200 mm": replace(flat, surface=je.Sphere(0.2, centre=(0.1, 0.1))),
}

readings = {name: je.forward(je.discretise(je.Scene(skin), je.Fidelity.draft())) for name, skin in shapes.items()}
changes = {}
for name, v in readings.items():
    changes[name] = float(jnp.linalg.norm(v - readings["flat"]) / jnp.linalg.norm(readings["flat"]))
    print(f"{name}: the readings change by {100 * changes[name]:.2f} %")
