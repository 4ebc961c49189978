from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.contacts.loads.spreading import Spreading
from jaxeit.tracking import Tracker, TrackerSettings, prepare_tracker
from jaxeit.tracking.belief.response import load_pressure

SECONDS = 0.01
GAUSSIAN = Spreading.at_depth(0.0, float)
SETTINGS = TrackerSettings(most=2, unknowns=64, modes=8, pixels=250, columns=40)


@pytest.fixture(scope="session")
def blank(model):
    """Readings of the untouched testbed, V, and the noise of one, V."""
    v0 = np.asarray(je.forward(model))
    return v0, np.full(v0.size, 1e-3 * np.sqrt(np.mean(v0**2)))


@pytest.fixture(scope="session")
def tracker(model, skin, blank):
    """Of the testbed at draft fidelity, whose sheet is known, for two contacts at most."""
    return prepare_tracker(model, skin, SETTINGS, noise=blank[1], sigma=model.background)


@pytest.fixture(scope="module")
def frame_of(model, blank):
    """Frames (readings,) V of loads (K, 6), from the full forward map."""

    @jax.jit
    def change(loads, gain):
        pressure = sum(load_pressure(load, model.centroids, GAUSSIAN) for load in loads)
        return je.forward(model, model.background * (1 + gain * pressure / (20e3 + gain * pressure)))

    v0, noise = blank
    rng = np.random.default_rng(5)
    return lambda loads, gain=1.0: (
        np.asarray(change(jnp.asarray(loads), gain)) - v0 + noise * rng.normal(size=noise.size)
    )


@pytest.fixture(scope="module")
def cornered():
    """Tracker of an L-shaped sheet, whose pads meet at the inner corner."""
    outline = np.array([(0.0, 0.0), (0.16, 0.0), (0.16, 0.08), (0.08, 0.08), (0.08, 0.16), (0.0, 0.16)])
    places = [(x, y) for y in (0.02, 0.06, 0.1, 0.14) for x in (0.02, 0.06, 0.1, 0.14) if min(x, y) < 0.08]
    electrodes = tuple(je.AreaPatch(place, 0.003, 1e-6) for place in places)
    pads = (je.Pad("right", outline[[0, 1, 2, 3]]), je.Pad("up", outline[[0, 3, 4, 5]]))
    protocol = je.Protocol(je.skin.adjacent(len(places)), 1e-3)
    skin = je.Skin("corner", je.Polygon(outline), 150.0, electrodes, protocol, pads)
    model = je.discretise(je.Scene(skin, effects=()), je.Fidelity.draft())
    return prepare_tracker(model, skin, SETTINGS, noise=np.full(protocol.readings, 1e-5), sigma=model.background)


def load(x, y, force, width=0.012):
    return [x, y, np.log(width), np.log(force), 0.0, 0.0]


def with_filter(tracker, **settings):
    """The tracker whose filters hold other numbers."""
    given = {name: jnp.asarray(value) for name, value in settings.items()}
    of_frames, press_filter = (replace(one, **given) for one in (tracker.filter, tracker.press_filter))
    return Tracker(of_frames, press_filter, tracker.settings, tracker.area, tracker.field)


def with_settings(tracker, **settings):
    """The tracker under other settings, of those that its filters do not hold."""
    given = replace(tracker.settings, **settings)
    return Tracker(tracker.filter, tracker.press_filter, given, tracker.area, tracker.field)


def in_double_precision(tree):
    """The same, with its numbers in float64."""
    return jax.tree.map(lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, tree)
