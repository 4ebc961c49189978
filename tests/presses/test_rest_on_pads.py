"""Presses beside all pads: no pad tells their force."""

from dataclasses import replace

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.presses.skins import rests_on_pads
from calib.presses.table import measure

SMALL = np.array([[0.11, 0.11], [0.15, 0.11], [0.15, 0.14], [0.11, 0.14]])


@pytest.fixture(scope="module")
def one_pad(skin):
    """The testbed with one pad of 40 x 30 mm."""
    return replace(skin, pads=(je.Pad("small", SMALL),))


def test_a_press_rests_on_a_pad_by_its_middle_or_by_a_third_of_its_area(one_pad):
    places = np.array(
        [[0.13, 0.12], [0.1501, 0.125], [0.154, 0.125], [0.17, 0.125], [0.03, 0.03], [np.nan, 0.0], [0.3, 0.1]]
    )
    found = rests_on_pads(one_pad, places, np.zeros(7))
    assert found.tolist() == [True, True, False, False, False, True, True]
    assert rests_on_pads(one_pad, places[2:3], np.array([0.06])).tolist() == [False]


def test_a_press_at_the_rim_counts_by_its_part_on_the_sheet(skin):
    corners = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.1, 0.1]])
    assert rests_on_pads(skin, corners, np.full(4, 0.02)).all()


def test_a_pad_smaller_than_a_tip_is_pressed_by_its_middle(skin):
    tiny = replace(skin, pads=(je.Pad("tiny", 0.1 + 0.1 * (SMALL - SMALL[0])),))
    assert rests_on_pads(tiny, np.array([[0.102, 0.1015], [0.11, 0.1015]]), np.zeros(2)).tolist() == [True, False]


def test_presses_beside_all_pads_are_set_aside(root, skin):
    with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as session:
        whole = measure(session, skin)
        *kept, last = skin.pads
        shrunk = replace(skin, pads=(*kept, je.Pad(last.name, last.outline.mean(0) + 0.1 * (last.outline - 0.15))))
        found = measure(session, shrunk)
    away = (whole.position > 0.1).all(1) & (np.abs(whole.position - 0.15).max(1) > 0.005)
    assert away.any()
    assert len(found.position) == len(whole.position) - away.sum()
    assert any("it rests on no pad" in note for note in found.notes)
