"""Contacts followed through time, by frames and pad forces together.

Example:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxeit as je
    from jaxeit import tracking

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    effects = (je.effects.LoadSpreading(), je.effects.ContactPiezoresistance())
    model = je.discretise(je.Scene(skin, effects), je.Fidelity.draft())
    v0 = je.forward(model)  # V
    noise = jnp.full(len(v0), 1e-3 * jnp.sqrt(jnp.mean(v0**2)))  # V
    settings = tracking.TrackerSettings(most=1, unknowns=64, modes=8, pixels=250, columns=40)
    tracker = tracking.prepare_tracker(model, skin, settings, noise=noise, sigma=model.background)

    slide = [np.array([0.06 + 0.001 * k, 0.13]) for k in range(6)]  # m: a finger that slides, 5 N
    spread = [je.model.load_spread(model, place, 0.02) for place in slide]  # 1/m^2
    frames = [je.forward(model, je.conductivity(model, 5.0 * each)) - v0 for each in spread]
    now, smoother = tracker.start(), tracking.Smoother(tracker, lag=4)
    for k, dv in enumerate(frames):
        now = tracker.step(
            now, dv, seconds=0.01, pad_forces=np.array([0, 0, 5.0, 0]), pad_errors=np.full(4, 0.2)
        )
        for track in now.tracks:
            print(f"contact {track.number} at {1e3 * track.position} mm, {track.force:.1f} N")
        # TimedTracks, better known and some frames late
        later = list(smoother.add(10_000_000 * k, now, 0.01))
    later += smoother.end()
"""

from .belief.layer import GainField, LearnedLayer
from .compilation import compile_tracker
from .contact_law import ContactLaw
from .load_depth import fit_depth
from .model_error import fit_model_error, press_evidence
from .settings import TrackerSettings
from .smoothing import Smoother, TimedTracks
from .tracker import Tracker, prepare_tracker
from .tracks import Track, Tracking

__all__ = [
    "ContactLaw",
    "GainField",
    "LearnedLayer",
    "Smoother",
    "TimedTracks",
    "Track",
    "Tracker",
    "TrackerSettings",
    "Tracking",
    "compile_tracker",
    "fit_depth",
    "fit_model_error",
    "prepare_tracker",
    "press_evidence",
]
