"""Places of electrodes: slopes against differences, and skins that are better on meshes nothing was searched on."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.model import electrode_motion
from jaxeit.scan import DesignSettings, PlaceError, PlacementLimits, move_electrodes, place_sensitivity
from jaxeit.scan.contact_information import SiteContacts
from jaxeit.scan.placement import _Objective
from jaxeit.skin.protocol import ProtocolError

from ..helpers import square_model

POINTS = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
SKIN = """
format = "jaxeit-skin"
version = 1
name = "mine"

[sheet]
shape = "rectangle"
size = [0.12, 0.08]
sheet_resistance = 150.0

[electrodes]
kind = "point"
positions = [[0.03, 0.03], [0.06, 0.02], [0.09, 0.03], [0.09, 0.05], [0.06, 0.06], [0.03, 0.05]]

[protocol]
pattern = "adjacent"
current = 1e-3

[[pads]]
name = "all"
rectangle = [0.0, 0.0, 0.12, 0.08]
"""
SETTINGS = DesignSettings(columns=4, noise=1e-5)
COARSE = je.Fidelity(edge_length=0.012)


@pytest.fixture(scope="module")
def mine():
    return je.skin.parse_skin(SKIN, "mine.toml")


def test_the_slope_is_that_of_contacts_that_stay_while_electrodes_move():
    model, every = square_model(POINTS, je.skin.all_pairs(6), 16), jnp.asarray(je.skin.all_pairs(6))
    sites = np.array([[0.04, 0.08], [0.12, 0.06], [0.09, 0.17]])
    contacts = SiteContacts.of(model, DesignSettings(noise=1e-5, width=0.04), sites)
    objective = _Objective(PlaceError(2.0), model, electrode_motion(model), contacts, every)
    still = jnp.zeros((6, 2))
    value, slope = objective(still)
    for way in np.eye(12)[:11].reshape(-1, 6, 2):  # the last electrode is on the rim, and moves along it
        ahead, back = (objective(jnp.asarray(by * way))[0] for by in (1e-6, -1e-6))
        assert float(jnp.sum(slope * way)) == pytest.approx(float(ahead - back) / 2e-6, rel=1e-5, abs=1e-9)
    assert float(slope[5, 1]) == 0
    edge = 0.2 / 16
    for number, axis in ((0, 0), (1, 1), (2, 0), (4, 0)):  # against a mesh that has the electrode one node further
        places = np.array(POINTS)
        places[number, axis] += edge
        aside = square_model(list(map(tuple, places)), every, 16)
        errors = contacts.sensitivity(aside, aside.chart).errors(every)
        fresh = float(jnp.mean((errors / contacts.width) ** 2))
        followed = float(objective(still.at[number, axis].set(edge))[0])
        assert followed - float(value) == pytest.approx(fresh - float(value), rel=0.12)


@pytest.mark.slow
def test_moved_electrodes_place_contacts_better_and_keep_the_limits(mine):
    circle = (0.045, 0.014, 0.01)
    limits = PlacementLimits(distance=0.02, margin=0.01, keep_out=(circle,), farthest=0.02)
    found = move_electrodes(mine, PlaceError(4.0), limits, SETTINGS, fidelity=COARSE, meshes=4)
    assert found.after < 0.7 * found.before
    assert 2 <= found.meshes <= 4
    places = found.skin.electrode_positions
    gaps = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(6)
    assert gaps.min() > 0.02 - 1e-6
    assert np.minimum(places, [0.12, 0.08] - places).min() > 0.01 - 1e-6
    assert np.linalg.norm(places - mine.electrode_positions, axis=1).max() < 0.02 + 1e-6
    assert np.linalg.norm(places - circle[:2], axis=1).min() > circle[2] - 1e-6
    for sign in ([-1, 1], [1, -1]):  # the mirror symmetries are kept
        image = [0.06, 0.04] + sign * (places - [0.06, 0.04])
        assert np.linalg.norm(image[:, None] - places, axis=2).min(1).max() < 1e-6
    fine = DesignSettings(columns=6, noise=1e-5)  # other sites
    rms = []
    for skin in (mine, found.skin):
        sensitivity = place_sensitivity(je.discretise(je.Scene(skin), je.Fidelity.draft()), fine)
        rms.append(float(jnp.sqrt(jnp.mean(sensitivity.errors(skin.protocol.pattern) ** 2))))
    assert rms[1] < 0.85 * rms[0]


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"distance": 0.03}, "break the limits where they sit now, by 10 mm"),
        ({"margin": 0.025}, "break the limits where they sit now, by 5 mm"),
        ({"keep_out": ((0.03, 0.03, 0.004),)}, "break the limits where they sit now, by 4 mm"),
    ],
)
def test_limits_that_are_broken_already(mine, limits, said):
    with pytest.raises(ProtocolError, match=said):
        move_electrodes(mine, limits=PlacementLimits(**limits), settings=SETTINGS, fidelity=COARSE)


@pytest.mark.parametrize("wrong", [{"distance": 0.0}, {"margin": -1.0}, {"keep_out": ((0.0, 0.0, 0.0),)}])
def test_limits_out_of_range(wrong):
    with pytest.raises(ProtocolError, match=next(iter(wrong))):
        PlacementLimits(**wrong)
