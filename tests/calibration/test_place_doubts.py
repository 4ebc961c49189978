"""What is said of places by which forces are corrected, where they are off the sheet, a guess, or of no use."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calib
from calib.calibration.evaluation import Evaluation
from calib.calibration.localisation.locators import LOCATORS
from calib.calibration.localisation.place_doubts import (
    correction_that_harms,
    require_on_sheet,
    worse_than_baseline_note,
)
from calib.fitting.fields import FIELDS, single_places

from .quick_bench import QUICK

OWN = """
import jax.numpy as jnp

import jaxeit as je


class Millimetres(je.metrics.AbstractEstimator):
    def __call__(self, image, recon):
        return 1000 * je.LevelCentroid(0.5)(image, recon)


class OneForAll(je.metrics.AbstractEstimator):
    def __call__(self, image, recon):
        return jnp.zeros(3)


class Plain(je.metrics.AbstractEstimator):
    def __call__(self, image, recon):
        return [0.1, 0.1]


class Half(je.metrics.AbstractEstimator):
    def __call__(self, image, recon):
        return je.LevelCentroid(0.5)(image, recon)
"""


@pytest.fixture
def calibrated_by(grid, tmp_path, monkeypatch):
    """Calibrates with an estimator of the module above; with a correction by location."""
    (tmp_path / "estimators_of_ones_own.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)

    def calibrated(name):
        word = f"image-centroid:estimator=estimators_of_ones_own:{name}"
        recipe = replace(QUICK, location=FIELDS.make("edge"), locator=LOCATORS.make(word, allow_import=True))
        with calib.open_session(grid) as session:
            return calib.calibrate([session], recipe=recipe)

    return calibrated


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "Millimetres",
            r"^locator image-centroid:estimator=estimators_of_ones_own:Millimetres: the places of 16 of 16 presses lie "
            r"off the sheet, about \(\d+\.?\d*, \d+\.?\d*\) m; return x and y in m, here 0 to 0.2 m and 0 to 0.2 m$",
        ),
        (
            "OneForAll",
            r"^OneForAll.__call__ returns a result of shape \(3,\) for images of shape \(\d+, \d+\); return \(\d+, 2\)",
        ),
        ("Plain", "^Plain.__call__ returns a result of type list for images"),
    ],
)
def test_an_estimator_that_returns_what_no_place_can_be_is_refused(calibrated_by, name, said):
    with pytest.raises(calib.fitting.FitError, match=said):
        calibrated_by(name)


def test_a_sound_estimator_of_ones_own_gets_a_note_that_its_file_needs_it(calibrated_by):
    (note,) = (line for line in calibrated_by("Half").notes if "imported" in line)
    assert note.startswith(
        "the file opens only where estimators_of_ones_own has been imported, as it names estimators_of_ones_own:Half; "
    )


def test_a_few_presses_off_the_sheet_are_not_refused(skin):
    place = np.full((10, 2), 0.1)
    place[:5] = 5.0
    require_on_sheet(skin, single_places(jnp.asarray(place), 4), calib.calibration.ImageCentroid())
    place[5] = np.nan
    with pytest.raises(calib.fitting.FitError, match="the places of 5 of 9 presses"):
        require_on_sheet(skin, single_places(jnp.asarray(place), 4), calib.calibration.ImageCentroid())


@pytest.fixture
def places():
    """Of the stage, 40 presses."""
    return np.random.default_rng(2).uniform(0.0, 0.12, (40, 2))


def test_places_that_follow_nothing_are_no_better_than_a_guess(places):
    rng = np.random.default_rng(3)
    wild = rng.uniform(0.0, 0.12, (40, 2))
    wild[4] = np.nan
    assert worse_than_baseline_note(places, wild).startswith(
        "localisation is no better than guessing: contacts that EIT"
    )


@pytest.mark.parametrize(
    "seen",
    [
        lambda p: p,
        lambda p: 0.06 + 0.3 * (p - 0.06),  # centroids lie inwards
        lambda p: p[:, ::-1],  # a stage of swapped axes
        lambda p: p + 0.2,  # or of another origin
        lambda p: np.full_like(p, np.nan),
        lambda p: None,
    ],
    ids=["right", "inward", "swapped", "shifted", "nowhere", "none"],
)
def test_places_that_follow_the_stage_are_better(places, seen):
    noise = 2e-3 * np.random.default_rng(4).normal(size=(40, 2))
    assert worse_than_baseline_note(places + noise, seen(places)) == ""


def test_presses_at_one_place_tell_nothing():
    one = np.full((20, 2), 0.05)
    assert worse_than_baseline_note(one, one + 0.01 * np.random.default_rng(5).normal(size=(20, 2))) == ""


@pytest.mark.parametrize(("factor", "told"), [(0.2, False), (1.1, False), (3.6, True)])
def test_a_correction_that_makes_errors_larger_is_told(factor, told):
    error = np.random.default_rng(6).normal(size=30)
    force = np.full(30, 10.0)
    error[3] = np.nan  # no held-out force
    found = Evaluation(
        position=np.zeros((30, 2)),
        estimated={},
        force=force,
        pressure=np.ones((30, 1)),
        pad_force=(force + factor * error)[:, None],
        image_sum=np.ones(30),
        centre=np.zeros(2),
        held_out_by="location",
        others={"hybrid": force + error},
    )
    note = correction_that_harms(found)
    assert bool(note) is told
    if told:
        assert note.startswith("the correction by location makes errors held out by location larger (")
        assert note.endswith("of the paper's recipe): calibrate without --location")
    assert correction_that_harms(replace(found, others={})) == ""
