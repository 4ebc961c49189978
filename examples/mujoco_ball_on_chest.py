"""What does a robot's chest feel when a ball rolls over it and a finger presses? MuJoCo's contacts as force maps."""

import tempfile
from dataclasses import replace

import jax
import mujoco
import numpy as np

import calib
import jaxeit as je
from calib import simulators
from calib.simulators.mujoco import ContactReader

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

ROBOT = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <geom name="chest" type="cylinder" size="0.3 0.14" euler="90 0 0"/>
    <site name="sheet" pos="0 -0.14 0"/>
    <body name="ball" pos="-0.003 -0.11 0.34"><freejoint/><geom type="sphere" size="0.04" mass="1"/></body>
    <body pos="0.072 0.06 0.3015"><joint name="press" type="slide" axis="0.23 0 0.973"/>
      <geom type="capsule" fromto="0 0 0 0.023 0 0.097" size="0.008" mass="0.01"/></body>
  </worldbody>
  <actuator><motor name="finger" joint="press" gear="-1"/></actuator>
</mujoco>""")
bench = calib.load_bench("chest_bench")  # the chest's skin, and effects as in the paper
fine, coarse = je.Fidelity.draft(edge_length=0.05), je.Fidelity.draft()  # of the world, and of the calibration

with tempfile.TemporaryDirectory() as folder:  # the same sheet, calibrated on a bench before
    lines = np.linspace(0.02, 0.26, 7)
    sites = np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
    short = replace(bench, sites=sites, blank=10.0, eit_rate=5.0, pad_rate=20.0)
    with calib.open_session(calib.simulate(short, f"{folder}/session.h5", fidelity=fine)) as session:
        recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(28)), fidelity=coarse, location=calib.PadEdge())
        calibration = calib.calibrate([session], recipe=recipe)

data = mujoco.MjData(ROBOT)
data.qvel[:6] = [0, 0.2, 0, -0.2 / 0.04, 0, 0]  # the ball rolls along the chest, and down to its side
reader = ContactReader(ROBOT, bench.scene.skin, geoms=["chest"], site="sheet")
skin = simulators.prepare_skin(bench.scene, 50.0, fine)
step, state, touched, felt = je.bind(simulators.step, skin), skin.start(), [], []
for k in range(48):
    data.ctrl[0] = 8.0 * np.clip((k - 10) / 15, 0, 1)  # N
    mujoco.mj_step(ROBOT, data, 10)
    touched.append(reader(data).contacts)
    state, readings = step(state, touched[-1])
    felt.append(readings)

frames, pressures = (np.array([getattr(one, part) for one in felt]) for part in ("frame", "pressure"))
found = calib.force_map(calibration, frames - skin.resting, pressures)
true, total = np.array([one.force.sum() for one in touched]), np.asarray(found.map.force).sum(1)
ball = np.array([one.position[0] for one in touched])
away = np.linalg.norm(found.position - ball[:, None], axis=2)  # of each contact found, NaN where there is none
place, finger = np.nanmin(away, 1).max(), found.contact_force[-1][np.nanargmax(away[-1])]
rms = np.sqrt(np.mean((total - true) ** 2))
print(f"forces up to {true.max():.1f} N; sum of the force map within {rms:.2f} N (RMS)")
print(f"the ball within {1e3 * place:.1f} mm; the finger's {touched[-1].force[1]:.1f} N found as {finger:.1f} N")
