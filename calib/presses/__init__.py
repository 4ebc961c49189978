"""Presses of a recording: streams on one clock, corrections, detection, windows and the table of presses.

Example:
    import jax
    import numpy as np

    import calib
    import jaxeit as je
    from calib import presses

    jax.config.update("jax_enable_x64", True)

    print(list(presses.CORRECTIONS), list(presses.BASELINES))  # names for recipes
    with calib.open_session("session.h5") as session:
        skin = je.skin.parse_skin(session.skin_toml)
        processing = presses.Processing(
            corrections=(presses.LowPass(cutoff=2.0),),  # Hz
            baseline=presses.TwoSided(),  # the default; as in real time: PreOnly()
            windows=presses.WindowLengths(hold=0.8, rest=0.4),
        )
        found = presses.measure(session, skin, processing)
        pooled = presses.pool_presses([session], skin)  # of several sessions as one table
        force = session.stream("force")
        times = presses.find_presses(
            force.time, force.read()[:, 0], limits=presses.DetectionLimits(min_hold=0.8)
        )
    print(f"{len(found.force)} presses of {found.force.mean():.1f} N; {len(times)} in the force alone")
    print(f"readings change by up to {1e3 * np.abs(found.dv).max():.1f} mV")
    print(pooled.data.pressure.shape, "presses and pads")
"""

from .corrections import (
    BASELINES,
    CORRECTIONS,
    AbstractBaseline,
    AbstractCorrection,
    CorrectionError,
    LowPass,
    PreOnly,
    TwoSided,
)
from .pooled import PooledPresses, PressData, pool_presses
from .streams import PressError
from .table import PressMeasurements, Processing, measure
from .timing.detection import DetectionLimits, find_presses
from .timing.windows import WindowLengths

__all__ = [
    "BASELINES",
    "CORRECTIONS",
    "AbstractBaseline",
    "AbstractCorrection",
    "CorrectionError",
    "DetectionLimits",
    "LowPass",
    "PooledPresses",
    "PreOnly",
    "PressData",
    "PressError",
    "PressMeasurements",
    "Processing",
    "TwoSided",
    "WindowLengths",
    "find_presses",
    "measure",
    "pool_presses",
]
