"""Live says what cannot be true in its streams, and keeps silent about an honest skin."""

import numpy as np
import pytest

import jaxeit as je
from calib.check.eit.model import SkinModel
from calib.check.eit.reading_order import transfer_matrix
from calib.check.eit.untouched import UntouchedCheck
from calib.check.report import Severity
from calib.live.loop import LiveControl, LiveSettings, run_live
from calib.live.plausibility import NO_FAULT, SILENT_PADS, PadWatch, RestFault, inside_pads, rest_fault
from calib.session import open_session

from .test_live import CENTRES, READINGS, FakePrograms, S, arrival, calibration, rested, small_device, sources_of  # noqa: F401

WRONG = RestFault("EIT at rest: the order looks wrong; forces are marked as not valid", refused=True)


@pytest.fixture(scope="module")
def untouched(skin):
    return UntouchedCheck(skin)


@pytest.fixture(scope="module")
def honest(skin):
    """A frame of the testbed with an uneven coat, about."""
    frame = SkinModel.of(skin, transfer_matrix(skin)).predict(skin.protocol)
    return frame * (1 + 0.1 * np.random.default_rng(0).normal(size=len(frame)))


LIES = {
    "reversed order": (lambda v: v[::-1], "readings of a frame come in reversed order", True),
    "signs": (lambda v: -v, "every sign is reversed", True),
    "a thousand": (lambda v: 1000 * v, "the amplitude is", False),
    "differences": (lambda v: 1e-4 * v, "about zero", False),
}


@pytest.mark.parametrize("lie", LIES)
def test_frames_at_rest_that_are_not_of_the_skin_are_named(lie, untouched, honest):
    tell, words, refused = LIES[lie]
    found = rest_fault(untouched(np.ascontiguousarray(tell(honest)), np.ones(len(honest), bool)))
    assert words in found.words
    assert "\n" not in found.words
    assert found.refused is refused
    assert ("not valid" in found.words) is refused


def test_nothing_is_said_of_honest_frames_at_rest(untouched, honest, bundled):
    used = np.ones(len(honest), bool)
    assert rest_fault(untouched(honest, used)) == NO_FAULT
    dead = np.where(np.arange(len(honest)) % 7 == 0, np.nan, honest)
    assert rest_fault(untouched(dead, used)) == NO_FAULT
    assert rest_fault(untouched(np.full(len(honest), np.nan), used)) == NO_FAULT
    for path in bundled:
        with open_session(path) as session:
            skin = je.skin.parse_skin(session.skin_toml, path.name)
            frame = session.stream("eit").read(0, 10).mean(0)
        assert not [f for f in UntouchedCheck(skin)(frame, np.ones(len(frame), bool)) if f.severity > Severity.OK]


def test_forces_of_a_wrong_order_are_not_valid_until_the_rest_levels_are_right(calibration):  # noqa: F811
    answers = [WRONG, NO_FAULT]
    engine = rested(calibration, check=lambda untouched: answers.pop(0))
    result = engine.step(arrival([15.0, 20.0]))
    assert engine.faults == result.faults == (WRONG.words,)
    assert not result.valid.any()
    assert "order looks wrong" in result.to_json()
    engine.tare()
    engine.step(arrival([11.0, 20.0], 2 * S))
    assert engine.faults == (WRONG.words,)  # until it is known better
    engine.step(arrival([11.0, 20.0], 3 * S))
    assert engine.step(arrival([15.0, 20.0])).valid.all()
    assert engine.faults == ()


def test_the_rest_levels_are_checked_once_and_the_operator_is_told_once(calibration, monkeypatch):  # noqa: F811
    asked, told, show = [], [], LiveControl()
    show.warn = told.append

    def check(untouched):
        asked.append(untouched)
        return WRONG

    def publish(result):
        if result.number > 20:
            show.stop.set()

    monkeypatch.setattr("calib.live.loop.rest_check", lambda calibration: check)
    with small_device() as device:
        run_live(calibration, *sources_of(device, calibration), [publish], show, LiveSettings(0.2, proposal=None))
    assert len(asked) == 1
    assert asked[0].shape == (READINGS,)
    assert told.count(WRONG.words) == 1
    assert show.faults == (WRONG.words,)


# --- pads that stay silent -----------------------------------------------------------------------


def watch():
    """Of pixels in a row, the last two of which lie beside the pads or near them."""
    return PadWatch(1e-3, np.array([True, True, False, False]))


def image(at, size=1e-3):
    return np.where(np.arange(4) == at, size, 0.0)


def seen(watched, picture, frames=50, moved=False, start=S):
    for k in range(frames):
        watched.add(picture, moved, start + k * S // 10)
    return watched.silent


def test_pads_that_stay_silent_under_contacts_are_noticed_until_one_moves():
    watched = watch()
    assert not seen(watched, image(1), frames=10)
    assert seen(watched, image(0), start=2 * S)
    watched.add(image(1), True, 10 * S)
    assert not watched.silent


@pytest.mark.parametrize("picture", [image(1, 1e-4), image(2), np.zeros(4)])
def test_weak_changes_and_contacts_beside_the_pads_accuse_no_pad(picture):
    assert not seen(watch(), picture, frames=500)


def test_noise_of_the_image_at_rest_is_no_contact():
    watched = watch()
    watched.begin(0.8e-3)
    assert not seen(watched, image(1), frames=500)
    assert seen(watched, image(1, 2e-3), start=100 * S)


def test_a_stream_that_pauses_gives_no_long_contact():
    watched = watch()
    watched.add(image(0), False, S)
    watched.add(image(0), False, 60 * S)
    assert not watched.silent


def test_pixels_near_the_rim_of_the_pads_are_beside_them():
    covered, areas = np.array([True, True, True, False]), np.ones(4)
    assert inside_pads(0.1 * CENTRES, areas, covered).tolist() == [True, True, True, False]
    assert not inside_pads(0.01 * CENTRES, areas, covered).any()
    assert inside_pads(CENTRES, np.array([1.0, 1.0, 1.0, 0.0]), covered).tolist() == covered.tolist()


class SeeingPrograms(FakePrograms):
    """With an image of a contact as strong as the first reading has changed."""

    def map(self, frame, pressure, places, before):
        return super().map(frame, pressure, places, before)._replace(image=image(0, abs(frame[0])))


def test_live_marks_forces_under_silent_pads(calibration, monkeypatch):  # noqa: F811
    monkeypatch.setattr(PadWatch, "of", lambda calibration: watch())
    engine = rested(calibration, SeeingPrograms)
    for k in range(50):
        result = engine.step(arrival([11.0, 20.0], 2 * S + k * S // 10, voltage=2e-3))
    assert result.faults == (SILENT_PADS,)
    assert not result.valid.any()
    result = engine.step(arrival([15.0, 20.0], 8 * S, voltage=2e-3))
    assert result.faults == ()
    assert result.valid.all()
