"""How do I use a mesh of my own? Nodes and triangles are two arrays that follow the electrodes."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

places = [(0.02 + 0.04 * column, 0.02 + 0.04 * row) for row in range(3) for column in range(3)]  # m
electrodes = tuple(je.PointElectrode(place) for place in places)
sheet = je.Rectangle(0.12, 0.12)
skin = je.Skin("patch", sheet, 150.0, electrodes, je.Protocol(je.skin.adjacent(9), 1e-3))

readings = {}
for cells in (12, 24):
    steps = np.linspace(0, 0.12, cells + 1)
    nodes = np.stack([axis.ravel() for axis in np.meshgrid(steps, steps)], 1)
    mesh = je.meshing.Mesh(nodes, Delaunay(nodes).simplices)  # triangles are counter-clockwise
    readings[cells] = je.forward(je.discretise(je.Scene(skin), je.Fidelity.draft(), mesh=mesh))

change = float(jnp.linalg.norm(readings[24] - readings[12]) / jnp.linalg.norm(readings[24]))
print(f"from 12 to 24 cells a side the readings change by {100 * change:.2f} %")
