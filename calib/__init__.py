"""calib: from what a bench or a robot recorded to newtons.

The names used every day are here; each room holds the rest, such as `calib.fitting.Huber`.
Rooms and names are imported on first use, so that the command line answers at once.

Example:
    import jax

    import calib
    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    images = je.Imaging(je.Pixels(20))  # coarse, as the fidelity is: seconds in place of a minute
    recipe = calib.Recipe(
        calib.PowerLaw(), calib.PadEdge(), imaging=images, fidelity=je.Fidelity.draft()
    )
    with calib.open_session("session.h5") as session:
        print("fit for a calibration:", calib.check_session(session).ok)
        calibration = calib.calibrate([session], recipe=recipe)
    calibration.save("calibration.h5")

    with calib.open_session("other.h5") as other:  # presses that were not fitted
        found = calib.evaluate(calibration, other).summary()
        print(f"force within {found['force_rmse']:.2f} N (RMSE)")
        print(f"place within {1e3 * found['localisation_fitted_mean']:.1f} mm (mean)")
        calib.apply(calibration, other, "forcemap.h5")  # the force map of every frame
"""

from importlib import import_module
from typing import Any

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _attribute(name)
    except AttributeError:
        if name.startswith("_"):
            raise
        hints = import_module("jaxeit.messages.missing_names")  # on an error only
        raise AttributeError(hints.message(__file__, name, __all__), name=name) from None
