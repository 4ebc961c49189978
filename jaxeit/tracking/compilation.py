"""Compilation of a tracker's programs before the first frame."""

import jax.numpy as jnp
import numpy as np

from .belief.state import Pads
from .tracker import Tracker
from .tracks import Tracking

# Level of a frame over that of noise, with which it is unexpected whatever the contacts; seconds between frames.
FRAME_LEVEL = 30.0
FRAME_PERIOD = 0.01


def compile_tracker(tracker: Tracker) -> None:
    """Compile whatever the following of up to `TrackerSettings.most` contacts may need, so that no frame waits for it.

    Each number of contacts has programs of its own: for an ordinary frame, and for the events that explain an
    unexpected one. A frame that no contact explains is shown to each number of contacts, so that all of them run.

    Example:
        tracking.compile_tracker(tracker)  # before frames arrive
    """
    finder, start = tracker.filter.finder, tracker.start()
    places, belief = np.asarray(finder.starts)[:, :2], start.belief
    frame = np.random.default_rng(0).normal(size=finder.readings)
    whitened = np.asarray(tracker.filter.compress) @ frame
    frame *= FRAME_LEVEL / np.sqrt(np.mean(whitened**2))
    most, pads = tracker.settings.most, tracker.filter.sheet.pad_area.shape[1]
    tracker.step(start, 0 * frame, FRAME_PERIOD)  # without forces on pads
    for count in range(most + 1):
        numbers = tuple(range(1, count + 1))
        now = Tracking(belief, start.layer, numbers, (False,) * count, (0,) * count, count, taught=count)
        tracker.step(now, frame, FRAME_PERIOD, np.zeros(pads), np.ones(pads))
        tracker.programs.predict(belief, FRAME_PERIOD)
        if count:
            tracker.programs.consider_covariance(belief, Pads(jnp.zeros(pads), jnp.ones(pads)), 0.0)
        belief = tracker.events.with_contact(belief, places[count * len(places) // (most + 1)])
