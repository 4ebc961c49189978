"""What is left out at a time, and intervals over places."""

import numpy as np
import pytest

from calib.calibration.evaluation import _cv, _mean, _rms
from calib.fitting.cross_validation.held_out import bootstrap_interval, leave_groups_out, place_draws
from calib.fitting.curves import Linear
from calib.fitting.fields import PadEdge, geometry_of, single_places
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses

from .test_location import owner, session_data


def test_presses_of_a_place_are_drawn_together():
    place = np.array([7, 7, 3, 3, 3, 9])
    drawn = place_draws(place)
    assert drawn.shape[1] == 6
    assert (drawn[:, 0] == drawn[:, 1]).all()
    assert (drawn[:, 2] == drawn[:, 4]).all()
    assert (drawn[:, [0, 2, 5]].sum(1) == 3).all()
    np.testing.assert_array_equal(place_draws(place), drawn)


def test_statistics_of_draws_are_those_of_the_presses_drawn():
    values = np.random.default_rng(0).normal(10, 1, 6)
    drawn = place_draws(np.array([0, 0, 1, 1, 2, 3]))[:50]
    for weight in drawn:
        again = np.repeat(values, weight)
        row = weight[None]
        np.testing.assert_allclose(_mean(values, row)[0], again.mean())
        np.testing.assert_allclose(_rms(values, row)[0], np.sqrt(np.mean(again**2)))
        np.testing.assert_allclose(_cv(values, row)[0], again.std(ddof=1) / again.mean(), atol=1e-12)


def test_intervals_of_a_mean_over_places_cover_it():
    """Presses of a place share most of their error: drawn one by one, the interval would be far too short."""
    rng, hits, naive = np.random.default_rng(1), 0, 0
    place = np.repeat(np.arange(30), 6)
    drawn = place_draws(place)
    for _ in range(300):
        values = rng.normal(0, 1, 30)[place] + rng.normal(0, 0.2, 180)
        low, high = bootstrap_interval(_mean(values, drawn))
        hits += low <= 0 <= high
        naive += abs(values.mean()) < 1.645 * values.std() / np.sqrt(180)
    assert 0.84 < hits / 300 < 0.94
    assert naive / 300 < 0.65


@pytest.fixture(scope="module")
def splits(skin):
    place, data = session_data(skin)
    groups = {
        "pad": owner(place),
        "indenter": np.zeros(len(place), int),
        "session": np.arange(len(place)) % 2,
    }
    found = leave_groups_out(
        Linear(), PadEdge(), LocatedPresses(data, geometry_of(skin), single_places(place, 4)), SoftL1(), groups
    )
    return {split.by: split for split in found}


def test_a_pad_that_was_never_pressed_is_told_by_the_others(splits):
    pad = splits["pad"]
    assert (pad.parts, pad.presses) == (4, 64)
    assert pad.note == ""
    assert pad.low < pad.rmse < pad.high < 1.2  # of 20 N, on pads that are alike
    assert pad.rmse < pad.worst


def test_parts_that_there_are_several_of_are_left_out_and_others_said(splits):
    assert splits["session"].rmse < 1.0
    assert splits["session"].parts == 2
    assert "one indenter only" in splits["indenter"].note
    assert np.isnan(splits["indenter"].rmse)


def test_too_few_parts_to_fit_from_are_said(skin):
    place, data = session_data(skin)
    one = np.where(np.arange(len(place)) < 3, 0, 1)
    found = leave_groups_out(Linear(), None, LocatedPresses(data, geometry_of(skin)), SoftL1(), {"session": one})
    assert "does not determine the fit" in found[0].note
