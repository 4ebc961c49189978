"""The depth of the sheet, told by presses of tips of unknown size on it."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bench_learning import DEPTH, GAUSSIAN, HALF_SPACE, Session, Skin
from benchmarks.problems import fit_model
from jaxeit.contacts import LoadSettings
from jaxeit.imaging import InverseError
from jaxeit.tracking import LearnedLayer, TrackerSettings, fit_depth

PRESSES = 12
SEED = 9600


@pytest.fixture(scope="module")
def pressed():
    """Trackers of Gaussian loads, and frames of presses with what pads tell of them, by the shape of the loads."""
    model, found = fit_model(), {}
    for shape in (GAUSSIAN, HALF_SPACE):
        skin = Skin(SEED)
        presses = skin.pressed(shape, PRESSES)
        session = Session(model, skin, presses, SEED, 0)
        shown = [session.shown(presses, number) for number in range(PRESSES)]
        found[shape] = session, presses, [np.array(part) for part in zip(*shown, strict=True)]
    return found


def test_the_depth_of_the_sheet_is_found(pressed):
    session, _, frames = pressed[HALF_SPACE]
    assert fit_depth(session.tracker, *frames) == pytest.approx(DEPTH, rel=0.1)


def test_gaussian_loads_have_no_depth(pressed):
    session, _, frames = pressed[GAUSSIAN]
    assert fit_depth(session.tracker, *frames) == 0


def test_at_its_depth_contacts_are_nearer_to_where_they_are(pressed):
    """Half as far on this skin, at least."""
    session, presses, frames = pressed[HALF_SPACE]
    deep = session.prepare(TrackerSettings(loads=LoadSettings(depth=DEPTH)))
    far, near = (
        np.mean([
            np.linalg.norm(tracker.press(*one).tracks[0].position - place)
            for *one, place in zip(*frames, presses.places, strict=True)
        ])
        for tracker in (session.tracker, deep)
    )  # fmt: skip
    assert near < 0.5 * far


def test_what_was_learned_at_another_depth_is_refused(tracker):
    deep = replace(tracker.field, depth=0.01)
    with pytest.raises(InverseError, match="learned on another sheet or under other settings"):
        tracker.start(LearnedLayer.unknown(deep))


def test_frames_of_another_shape_are_refused(tracker):
    with pytest.raises(InverseError, match="give one frame or more"):
        fit_depth(tracker, np.zeros(3))
