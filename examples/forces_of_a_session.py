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
found = verdict.summary()
print(f"{found['presses']:.0f} presses that were not fitted: force within {found['force_rmse']:.2f} N (RMSE)")
print(f"place of the contact within {1e3 * found['localisation_fitted_mean']:.2f} mm (mean)")
