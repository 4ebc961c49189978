"""Pulls of simulated calibrations: the error of a predicted force over its stated error has mean 0 and deviation 1.

Every curve that can be chosen is fitted without a field, and every field beside a straight line. The truth is of the
same kind as what is fitted, so that a pull tells whether the stated error is true, and not how well the kind fits.
"""

import numpy as np
import pytest

from benchmarks.bench_pulls import SHARED, TRIALS, judged, pulls, pulls_across_walls
from calib.fitting.curves import CURVES, Linear
from calib.fitting.fields import FIELDS


def judge(found, bias):
    """`bias` is the largest mean at one sample: 4 standard errors, and more where a prior or memory leaves some."""
    error = 1 / np.sqrt(2 * TRIALS)
    assert abs(found.mean()) < 0.2  # samples of one fit err together, so that it is hardly less than that of one
    assert np.abs(found.mean(0)).max() < bias
    assert 0.9 < found.std() < 1 + 2 * error


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVES)
def test_pulls_of_every_curve(name, skin):
    judge(pulls(skin, CURVES.make(name), None), 0.7 if CURVES.make(name).path else 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_pulls_of_every_field(name, skin):
    """A prior draws a field to zero: the truth is fixed here, so that the mean errs, and the deviation is less."""
    judge(pulls(skin, Linear(), FIELDS.make(name)), 0.8)


@pytest.mark.slow
def test_pulls_of_a_curve_that_bends_with_a_field(skin):
    judge(pulls(skin, CURVES.make("polynomial"), FIELDS.make("edge")), 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARED)
def test_pulls_of_the_total_of_presses_across_walls(name, skin):
    """Of pads that share a field, independent errors had pulls of 1.2; of pads with fields of their own, errors that
    add up had pulls of 0.65."""
    assert 0.75 < np.std(pulls_across_walls(skin, FIELDS.make(name))) < 1.1


def test_errors_of_pulls_are_over_fits():
    """Samples of one fit that err alike count as one: 200 fits, whatever the number of samples."""
    drawn = np.random.default_rng(0).normal(0, 1, (200, 1))
    alike = judged("alike", np.repeat(drawn, 50, 1))
    one = judged("one", drawn)
    assert {**alike, "what": ""} == {**one, "what": ""}
    np.testing.assert_allclose(one["mean_error"], drawn.std(ddof=1) / np.sqrt(200), atol=1e-4)
    np.testing.assert_allclose(one["deviation_error"], 1 / np.sqrt(400), rtol=0.15)
