"""How do I get newtons from a recorded session? Calibrate on one session, read forces of another."""

from pathlib import Path

import jax

import calib
import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

sessions = Path(__file__).parents[1] / "data" / "sessions"
recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft(), location=calib.PadEdge())
with calib.open_session(sessions / "testbed_grid.h5") as session:
    calibration = calib.calibrate([session], recipe=recipe)  # seconds; calibration.save("calibration.h5") keeps it

with calib.open_session(sessions / "testbed_presses.h5") as other:
    verdict = calib.evaluate(calibration, other)
for name, value in verdict.summary().items():
    print(f"{name}: {value:.3g}")
