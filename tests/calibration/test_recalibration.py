"""A week later: gains and offsets of pads have moved, and the calibration follows with honest errors."""

import json
import threading
from copy import copy
from dataclasses import replace
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest

import calib
from calib.calibration import KnownForces, OrdinaryUse, assess
from calib.calibration.fitted_sessions import SAME_NOTE, is_fitted
from calib.calibration.recalibration.agreement import covariance_of_moves
from calib.calibration.recalibration.changes import Advice, Evidence, render
from calib.calibration.recalibration.image_reference import fit_reference
from calib.calibration.recalibration.loads import LoadedPads, ObservedContacts, contact_loads
from calib.calibration.recalibration.ordinary_use import distinct, loaded_pressures, quiet_range, zero_and_loads
from calib.calibration.recalibration.press_noise import press_noise
from calib.calibration.recalibration.records import recorded, rest_levels
from calib.cli import main
from calib.fitting.gain_update import GainDrift, GainPrior, GainUpdate, relative_covariance, update_gains
from calib.fitting.intervals import NORMAL_MULTIPLE
from calib.fitting.pad_gains import PadGains
from calib.fitting.pads import PadModel
from calib.live.engine import Engine, ReceivedFrame
from calib.live.recalibrator import LiveRecalibrator
from calib.presses.table import measure
from calib.session import read_archive

from .weeks import SLOPE, S, rough_sensitivity

LATER = "2026-11-23T09:00:00+00:00"
GAINS = np.array([1.08, 0.95, 1.0, 1.04])
OFFSET = np.array([40.0, -25.0, 0.0, 10.0])
TEN = np.array(
    [[0.04, 0.05], [0.07, 0.06], [0.05, 0.08], [0.15, 0.05], [0.13, 0.04], [0.04, 0.15], [0.06, 0.13], [0.15, 0.15],
     [0.13, 0.17], [0.16, 0.07]]
)  # fmt: skip
FORCE = np.array([8.0, 15.0, 12.0, 10.0, 18.0, 9.0, 14.0, 7.0, 16.0, 11.0])


@pytest.fixture(scope="module")
def ten(later, tmp_path_factory):
    """Ten presses a week later."""
    path = tmp_path_factory.mktemp("week") / "ten.h5"
    return later.record(path, TEN, FORCE, gains=GAINS, offset=OFFSET, load_cell=FORCE)


@pytest.fixture(scope="module")
def moved(calibration, ten):
    with calib.open_session(ten) as session:
        return calib.recalibrate(calibration, session)


@pytest.fixture(scope="module")
def use(later, tmp_path_factory):
    """Ordinary use: 100 contacts of unknown force, the image and all pads 20 % stronger than at the calibration."""
    rng = np.random.default_rng(5)
    place, force = rng.uniform(0.02, 0.18, (100, 2)), rng.uniform(5, 15, 100)
    path = tmp_path_factory.mktemp("use") / "use.h5"
    return later.record(path, place, force, gains=GAINS, offset=OFFSET, image_gain=1.2, table=False, drift=300.0)


def force_error(calibration, later, seed=9):
    """Relative errors (n,) of forces on new places, and their stated standard errors."""
    rng = np.random.default_rng(seed)
    place, force = rng.uniform(0.02, 0.18, (200, 2)), rng.uniform(5, 18, 200)
    found, error, _ = calibration.pad_forces(later.pressures(place, force, GAINS))
    return found.sum(1) / force - 1, np.sqrt((error**2).sum(1)) / force


def test_ten_presses_of_known_force_restore_the_forces(calibration, moved, later):
    found = moved.recalibration
    error = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.log_gain - np.log(GAINS)) < 3 * error).all()
    assert (error < 0.02).all()
    assert found.determined.all()
    assert found.significant.tolist() == [True, True, False, True]
    before, after = (np.sqrt(np.mean(force_error(c, later)[0] ** 2)) for c in (calibration, moved))
    assert before > 0.045
    assert after < 0.02  # the misfit of places is 0.0075, that of ten places 0.0075 / sqrt(2.5)


@pytest.mark.parametrize("unit", [9.80665, 9.80665e-3], ids=["kg", "g"])
def test_forces_of_another_unit_move_no_calibration(unit, calibration, later, tmp_path):
    """A move that no drift explains is refused, unless so much drift is expected, or it is forced."""
    path = later.record(tmp_path / "ten.h5", TEN, FORCE, gains=GAINS, offset=OFFSET, load_cell=FORCE / unit)
    with calib.open_session(path) as session:
        with pytest.raises(calib.SessionError, match="check the units and gains of force"):
            calib.recalibrate(calibration, session)
        assert calib.recalibrate(calibration, session, ignore_errors=True).recalibration.determined.any()


def test_a_large_drift_that_is_expected_is_no_wrong_unit(calibration, later, tmp_path):
    path = later.record(tmp_path / "ten.h5", TEN, FORCE, gains=1.8 * GAINS, load_cell=FORCE)
    with calib.open_session(path) as session:
        with pytest.raises(calib.SessionError, match="beyond the drift of 14 %"):
            calib.recalibrate(calibration, session)
        found = calib.recalibrate(calibration, session, KnownForces(GainDrift(0.3, 0.3))).recalibration
    np.testing.assert_allclose(found.log_gain, np.log(1.8 * GAINS), atol=0.06)


def test_names_of_pads_split_no_row_of_the_table(moved):
    odd = replace(moved.recalibration, pads=("line\nbreak", "tab\tx", "a\x1b[31m", "b"))
    usual = render(replace(moved.recalibration, pads=("line?break", "tab?x", "a?[31m", "b")))
    assert render(odd) == usual
    assert len(odd.summary().splitlines()) == 1


def test_levels_at_rest_are_told_and_taken_off(moved):
    found = moved.recalibration
    np.testing.assert_allclose(found.offset_change, OFFSET, atol=2)
    np.testing.assert_array_equal(moved.rest, found.offset)
    assert np.isfinite(found.drift_error).all()


def test_the_record_says_what_was_changed_and_from_what(calibration, moved, ten, tmp_path):
    found = moved.recalibration
    assert found.days == pytest.approx(7.0)
    assert found.advice is Advice.RECALIBRATE
    assert "7.0 days" in found.health
    assert "lower left" in found.health
    assert found.health.endswith("recalibrate")
    assert "ten.h5" in moved.provenance["recalibrations"]
    assert found.session.split()[0] in moved.provenance["recalibrations"]
    body = json.loads(found.to_json())
    assert [row["significant"] for row in body["pads"]] == found.significant.tolist()
    assert all(len(line) < 110 for line in render(found).splitlines()[:6])
    moved.save(tmp_path / "new.h5")
    loaded = calib.load_calibration(tmp_path / "new.h5")
    pressures = np.array([[1000.0, 500.0, 20.0, 0.0], [0.0, 0.0, 0.0, 1500.0]])
    for mine, theirs in zip(moved.pad_forces(pressures), loaded.pad_forces(pressures), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert loaded.recalibration.to_json() == found.to_json()
    with calib.open_session(ten) as session:
        again = assess(loaded, session)
    assert np.abs(again.change).max() < 0.005
    assert again.advice is Advice.KEEP


def test_force_maps_use_the_gains_and_their_errors(calibration, moved):
    pressures = np.array([[1000.0, 0.0, 0.0, 0.0], [2200.0, 0.0, 0.0, 0.0]])
    frames = np.zeros((2, calibration.recon.readings))
    old, new = (calib.force_map(c, frames, pressures) for c in (calibration, moved))
    gain = np.exp(moved.recalibration.log_gain[0])
    np.testing.assert_allclose(new.force[:, 0], old.force[:, 0] / gain, rtol=1e-9)
    added = new.force[0, 0] * np.sqrt(moved.recalibration.covariance[0, 0])
    curve = (old.standard_error[0, 0] ** 2 - 0.1**2) / gain**2
    assert new.standard_error[0, 0] == pytest.approx(np.sqrt(curve + 0.1**2 + added**2), rel=1e-6)
    wide = replace(moved, recalibration=replace(moved.recalibration, log_gain=np.full(4, np.log(1.2))))
    assert not calib.force_map(calibration, frames, pressures * 1.1).valid[1, 0]
    assert calib.force_map(wide, frames, pressures * 1.1).valid[1, 0]  # within what was calibrated, by the gain


def loads_of(later, place, force, told):
    """Presses as the update takes them."""
    rest = np.zeros((1, 4))
    return LoadedPads(later.pressures(place, force, GAINS), np.log(told), place, None, rest, np.zeros(1))


def test_one_press_in_five_of_wrong_force_does_little(calibration, later):
    told = FORCE * np.where(np.isin(np.arange(10), (3, 8)), 1.4, 1.0)
    loads = loads_of(later, TEN, FORCE, told)
    found = KnownForces().update(calibration, loads, press_noise(calibration.evaluation))
    assert np.abs(found.mean - np.log(GAINS)).max() < 0.03
    assert (found.weight < 0.3).tolist() == (told != FORCE).tolist()


def test_a_pad_that_is_not_pressed_stays_as_it_is(calibration, later):
    lower = loads_of(later, TEN, FORCE, FORCE).rows(np.arange(10) < 5)
    found = KnownForces().update(calibration, lower, press_noise(calibration.evaluation))
    assert found.determined.tolist() == [True, True, False, False]
    assert np.abs(found.mean[2:]).max() < 1e-3
    assert np.sqrt(np.diag(found.covariance))[2:] == pytest.approx(np.hypot(0.1, 0.1), rel=1e-3)
    levels = rest_levels(lower.rest, lower.time)
    record = recorded(calibration, KnownForces().kind, found, np.ones(4), levels, (LATER, "x"))
    assert any("upper left" in note for note in record.notes)


@pytest.mark.parametrize(
    ("scatter", "advice"), [(0.01, Advice.KEEP), (0.05, Advice.CALIBRATE), (np.nan, Advice.CALIBRATE)]
)
def test_what_gains_leave_must_be_worth_a_calibration(calibration, scatter, advice):
    """A calibration that states errors of 0.3 % is not told to start again for 1 %."""
    levels = rest_levels(np.zeros((1, 4)), np.zeros(1))
    found = GainUpdate(np.full(4, 0.005), 1e-6 * np.eye(4), np.ones(4, bool), 4.0, scatter, np.ones(9))
    assert recorded(calibration, Evidence.KNOWN_FORCE, found, np.ones(4), levels, (LATER, "x")).advice is advice


def test_a_session_moves_a_calibration_once(moved, ten):
    """Counted twice, ten presses would seem as sure as twenty, and they are no test of what they moved."""
    with calib.open_session(ten) as session:
        with pytest.raises(calib.SessionError, match=r"ten\.h5: has moved this calibration before; .* that is new"):
            calib.recalibrate(moved, session)
        assert is_fitted(moved.provenance, session)


@pytest.mark.parametrize("listed", [True, False], ids=["file", "presses"])
def test_a_session_that_a_calibration_was_fitted_to_is_named(calibration, ten, listed):
    """By its file, or written again under another identity by the presses it holds."""
    with calib.open_session(ten) as session:
        assert SAME_NOTE not in calib.recalibrate(calibration, session).notes
        if listed:
            fitted = replace(calibration, provenance=calibration.provenance | {"sessions": f"{session.hash}  ten.h5"})
        else:
            found = measure(session, calibration.skin, calibration.processing)
            own, known, pressure = calibration.evaluation, found.force, calibration.own_pressures(found.pressure)
            share = pressure / pressure.sum(1, keepdims=True)
            first = {"force": known, "pressure": pressure, "pad_force": share * known[:, None]}
            own = replace(own, **{name: np.r_[rows, getattr(own, name)[10:]] for name, rows in first.items()})
            fitted = replace(calibration, evaluation=own)
        assert SAME_NOTE in calib.recalibrate(fitted, session).notes


# --- ordinary use ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def used(calibration, use):
    with calib.open_session(use) as session:
        return calib.recalibrate(calibration, session)


def test_ordinary_use_tells_gains_relative_to_each_other(used):
    found = used.recalibration
    true = np.log(GAINS) - np.log(GAINS).mean()
    error = np.sqrt(np.diag(relative_covariance(found.covariance)))
    assert (np.abs(found.log_gain - true) < 3 * error).all()
    assert (error < 0.05).all()
    assert found.determined.all()
    assert "relative to each other" in found.health


def test_a_common_gain_stays_with_a_wider_error(used):
    """The image is 20 % stronger and the pads 1.7 %: neither moves the mean of the gains."""
    found = used.recalibration
    assert found.log_gain.mean() == pytest.approx(0, abs=1e-6)
    common = np.full(4, 0.25)
    drift = GainDrift().covariance(4, together=True)
    assert common @ found.covariance @ common == pytest.approx(common @ drift @ common, rel=1e-6)
    assert any("common to all pads" in note for note in found.notes)


def test_levels_follow_the_drift_between_contacts(used):
    found = used.recalibration
    middle = OFFSET + 300 * 100 * 3.5 / 3600 / 2
    np.testing.assert_allclose(found.offset_change, middle, atol=2)
    assert (np.abs(found.drift - 300) < 4 * found.drift_error + 20).all()


def test_contacts_on_one_pad_say_nothing(calibration, later):
    place, force = np.random.default_rng(0).uniform(0.03, 0.07, (8, 2)), np.full(8, 10.0)
    loads = contact_loads(calibration, later.readings(place, force), later.pressures(place, force, GAINS))
    found = OrdinaryUse().update(calibration, loads, press_noise(calibration.evaluation))
    assert not found.determined.any()
    assert np.abs(found.mean).max() < 0.01
    assert (np.sqrt(np.diag(found.covariance)) > 0.13).all()
    levels = rest_levels(np.zeros((1, 4)), np.zeros(1))
    record = recorded(calibration, OrdinaryUse().kind, found, np.ones(4), levels, (LATER, "x"))
    assert record.advice is Advice.UNKNOWN


def test_only_a_pad_that_moved_raises_an_alarm(later):
    """Sheets of rough sensitivity, whose long variations differ from pad to pad."""
    unmoved, moved, pulls = [], [], []
    skin, levels = copy(later), rest_levels(np.zeros((1, 4)), np.zeros(1))
    for seed in range(8):
        skin.sensitivity = rough_sensitivity([31, seed])
        calibration, rng = skin.calibration(), np.random.default_rng([32, seed])
        place, force = rng.uniform(0.02, 0.18, (150, 2)), rng.uniform(5, 18, 150)
        for gains, records in ((np.ones(4), unmoved), (np.array([1.3, 0.8, 1.0, 1.0]), moved)):
            dv = skin.readings(place, force, 1.1) + rng.normal(0, 1e-7, (150, len(skin.v0)))
            loads = contact_loads(calibration, dv, skin.pressures(place, force, gains))
            found = OrdinaryUse().update(calibration, loads, press_noise(calibration.evaluation))
            true = np.log(gains) - np.log(gains).mean()
            pulls.append((found.mean - true) / np.sqrt(np.diag(relative_covariance(found.covariance))))
            records.append(recorded(calibration, Evidence.ORDINARY_USE, found, np.ones(4), levels, (LATER, "x")))
    assert not [one.health for one in unmoved if one.significant.any()]
    assert sum(one.advice is Advice.RECALIBRATE for one in moved) >= 7
    assert (np.abs(pulls) < 1.645).mean() > 0.85


def test_blocks_of_one_contact_at_one_place_count_once():
    contact, place = np.array([1, 1, 1, 2, 2]), np.array([[0, 0], [1e-3, 0], [0.03, 0], [0, 0], [2e-3, 0]])
    kept = distinct(contact, place, np.array([3.0, 5.0, 4.0, 2.0, 1.0]), 5e-3)
    assert kept.tolist() == [False, True, True, True, False]


def test_the_zero_is_frozen_under_load_and_follows_drift():
    time = np.arange(3000) / 10  # s
    held = (time > 60) & (time < 200)
    drift = 0.2 * time  # Pa
    mean = np.stack([drift + 800 * held, drift], 1) + np.random.default_rng(0).normal(0, 0.5, (3000, 2))
    threshold = np.array([100.0, 100.0])
    loaded, zero = zero_and_loads(mean, threshold, quiet_range(mean, threshold))
    np.testing.assert_array_equal(loaded, held)
    assert (zero[held] == zero[np.argmax(held)]).all()
    np.testing.assert_allclose(zero[-1], drift[-1], atol=1)
    np.testing.assert_allclose(zero[590], drift[590], atol=1)


# --- while live ------------------------------------------------------------------------------------------------------


def live_frames(later, place, force, *, gains, offset, rate=10.0, touch=2.0, rest=2.0):
    """Frames of contacts one after the other: arrivals and the true force, at `rate` Hz."""
    rng = np.random.default_rng(4)
    held, pressures, on = later.readings(place, force), later.pressures(place, force, gains), touch + rest
    for i in range(int((1 + len(force) * on) * rate)):
        t = i / rate
        k, phase = divmod(t - 1, on)
        loaded = t >= 1 and phase >= rest
        load = loaded * np.eye(len(force))[int(k)] if loaded else np.zeros(len(force))
        voltage = later.v0 + load @ held + rng.normal(0, 1e-7, held.shape[1])
        pressure = load @ pressures + offset(t) + rng.normal(0, 0.5, 4)
        yield ReceivedFrame(voltage, pressure, int(t * S) + 1), load @ force


@pytest.mark.slow
def test_live_follows_zero_and_gains_and_is_frozen_under_load(calibration, later, tmp_path):
    rng = np.random.default_rng(6)
    place, force = rng.uniform(0.03, 0.17, (40, 2)), rng.uniform(6, 15, 40)
    told = []
    follower = LiveRecalibrator(calibration, tmp_path / "live.h5", tell=told.append)
    engine = Engine(calibration, 0.5, recalibrator=follower)
    errors, frozen = [], True
    for arrival, true in live_frames(later, place, force, gains=GAINS, offset=lambda t: 0.1 * t * np.ones(4)):
        before = follower.offset.copy(), follower.gains
        result = engine.step(arrival)
        if result is not None:
            if true > 0:
                errors.append(result.force.sum() / true - 1)
                frozen &= (follower.offset == before[0]).all() and follower.gains is before[1]
            engine.use_spare_time(1.0)
            if follower._worker is not None:
                follower._worker.join()
    assert frozen
    np.testing.assert_allclose(follower.offset, 0.1 * 160, atol=2.5)  # it lags by 10 s, and by the contacts
    gain = follower.record.log_gain
    error = follower.record.change_error
    assert (np.abs(gain - (np.log(GAINS) - np.log(GAINS).mean())) < 3 * error).all()
    assert gain.mean() == pytest.approx(0, abs=1e-6)
    assert np.std(errors[-200:]) < 0.6 * np.std(errors[:100])
    assert told
    assert engine.health == follower.health
    follower.save()
    assert calib.load_calibration(tmp_path / "live.h5").recalibration.evidence is Evidence.ORDINARY_USE


def test_live_gains_and_zero_are_bounded(calibration):
    follower = LiveRecalibrator(calibration)
    dv = np.zeros(calibration.recon.readings)
    for i in range(3000):
        follower.add(dv, np.full(4, 50.0), False, (i + 1) * S)
    np.testing.assert_allclose(follower.offset, loaded_pressures(calibration))
    assert "not known" in follower.health
    follower._found = GainUpdate(np.array([2.0, -2.0, 0.0, 0.0]), np.eye(4), np.ones(4, bool), 1.0, 0.0, np.ones(1))
    follower._contacts.add(
        1, ObservedContacts(np.zeros(1), np.zeros((1, 2)), np.ones((1, 4)), np.ones((1, 4)), np.zeros(4))
    )
    follower._worker = threading.Thread()
    follower.add(dv, np.zeros(4), False, 3001 * S)
    np.testing.assert_allclose(follower.gains.log_gain, [0.3, -0.3, 0, 0])
    assert any("bound" in note for note in follower.record.notes)


def test_an_update_that_fails_leaves_the_one_before_and_says_so(calibration, monkeypatch):
    """The update before it was recorded again, as if it were new."""
    told = []
    follower = LiveRecalibrator(calibration, tell=told.append)
    for number in range(8):
        seen = ObservedContacts(np.zeros(1), np.zeros((1, 2)), np.ones((1, 4)), np.ones((1, 4)), np.zeros(4))
        follower._contacts.add(number, seen)

    def update(raised=None):
        good = GainUpdate(np.array([0.1, -0.1, 0.0, 0.0]), 1e-4 * np.eye(4), np.ones(4, bool), 1.0, 0.0, np.ones(1))
        made = Mock(return_value=good, side_effect=raised)
        monkeypatch.setattr("calib.live.recalibrator.update_from_use", made)
        follower._fresh = 1
        follower.use_spare_time()
        follower._worker.join()
        follower.add(np.zeros(calibration.recon.readings), np.zeros(4), False, S)
        return follower.record, follower.gains

    before = update()
    assert told == [before[0].health]
    for _ in range(2):  # it is said once
        after = update(np.linalg.LinAlgError("no factor"))
        assert all(one is other for one, other in zip(before, after, strict=True))
    assert told[1:] == [follower.health]
    assert "no factor" in follower.health
    after = update()
    assert after[0] is not before[0]
    assert told[2:] == [follower.health] == [after[0].health]


# --- refusals --------------------------------------------------------------------------------------------------------


def test_what_does_not_determine_the_gains_is_refused(calibration, later, tmp_path):
    cases = {
        "other": ({"name": "palm"}, r"other\.h5: recorded on the skin 'palm'"),
        "strong": ({"force": FORCE + 60}, r"strong\.h5: only 0 presses can be used \(10 of 10 left out: outside"),
    }
    for name, (changes, message) in cases.items():
        given = {"place": TEN, "force": FORCE} | changes
        path = later.record(tmp_path / f"{name}.h5", **given, load_cell=given["force"])
        with calib.open_session(path) as session, pytest.raises(calib.SessionError, match=message):
            calib.recalibrate(calibration, session)


def test_the_command_writes_the_moved_calibration(calibration, ten, tmp_path, capsys):
    old, new = str(tmp_path / "old.h5"), str(tmp_path / "new.h5")
    calibration.save(old)
    assert main(["recalibrate", old, str(ten), "-o", new, "--json"]) == 0
    body = json.loads(capsys.readouterr().out)
    assert body["advice"] == "recalibrate"
    assert calib.load_calibration(new).recalibration.rows() == body["pads"]


@pytest.mark.slow
def test_check_tells_the_health_of_a_calibration(calibration, ten, tmp_path, capsys):
    calibration.save(tmp_path / "old.h5")
    main(["check", str(ten), "--calibration", str(tmp_path / "old.h5")])
    text = " ".join(capsys.readouterr().out.split())
    assert "calibration health, 2026-11-23 against 2026-11-16 (7.0 days)" in text
    assert "recalibrate" in text


# --- the update itself -----------------------------------------------------------------------------------------------


def simulated_updates(rng, *, use, count=200, n=12):
    """Pulls (count, pads) of updates with gains drawn from the prior; of `use`, relative to their mean."""
    drift = GainDrift(0.06, 0.05)
    prior = GainPrior(np.zeros(4), drift.covariance(4, together=use))
    pulls = []
    for _ in range(count):
        gain = rng.multivariate_normal(prior.mean, prior.covariance)
        share = np.eye(4)[rng.integers(4, size=n)] * 0.9 + 0.025
        near = np.exp(-0.5 * (np.subtract.outer(*[rng.uniform(0, 10, n)] * 2)) ** 2)
        covariance = 0.03**2 * (0.7 * near + 0.3 * np.eye(n))
        observed = share @ gain + rng.multivariate_normal(np.zeros(n), covariance) + use * rng.normal(0, 1.0)
        found = update_gains(
            prior, lambda g, s=share, o=observed: (o - s @ g, s), covariance, np.ones((n, 1)) if use else None
        )
        away, spread = found.mean - gain, found.covariance
        if use:
            away, spread = away - away.mean(), relative_covariance(spread)
        pulls.append(away / np.sqrt(np.diag(spread)))
    return np.array(pulls)


@pytest.mark.parametrize("use", [False, True], ids=["known force", "ordinary use"])
def test_pulls_of_updated_gains(use):
    pulls = simulated_updates(np.random.default_rng(1), use=use)
    assert np.abs(pulls.mean(0)).max() < 3.5 / np.sqrt(len(pulls))
    assert pulls.std() == pytest.approx(1, abs=3 / np.sqrt(2 * pulls.size) + 0.04)


def test_without_observations_the_result_is_the_prior():
    prior = GainPrior(np.array([0.01, 0.02]), np.diag([0.01, 0.02]))
    found = update_gains(prior, lambda g: (np.zeros(0), np.zeros((0, 2))), np.zeros((0, 0)))
    np.testing.assert_allclose(found.mean, prior.mean)
    np.testing.assert_allclose(found.covariance, prior.covariance)
    assert not found.determined.any()


def test_readings_that_a_gain_does_not_explain_widen_the_errors():
    rng = np.random.default_rng(2)
    share, covariance = np.eye(4)[np.arange(40) % 4], 0.01**2 * np.eye(40)
    sound, odd = (
        update_gains(
            GainPrior(np.zeros(4), 0.02 * np.eye(4)), lambda g, o=noise: (o - share @ g, share), covariance
        )
        for noise in (rng.normal(0, 0.01, 40), rng.normal(0, 0.05, 40))
    )  # fmt: skip
    assert odd.misfit > 3.5
    assert odd.scatter == pytest.approx(0.05, rel=0.3)
    assert (np.diag(odd.covariance) > 9 * np.diag(sound.covariance)).all()


def test_standard_errors_of_forces_are_those_of_drawn_gains(calibration):
    covariance = np.diag([0.02, 0.01, 0.03, 0.02]) ** 2 + 0.01**2
    gains = PadGains(jnp.asarray(np.log(GAINS)), jnp.asarray(covariance))
    exact = replace(calibration.curves, covariance=jnp.zeros((4, 1, 1)))
    pressures = jnp.array([[1000.0, 200.0, jnp.nan, 50.0]])
    found = PadModel(exact, gains=gains).forces(pressures)
    force, error = np.asarray(found.force)[0], np.asarray(found.standard_error)[0]
    drawn = np.random.default_rng(0).multivariate_normal(np.log(GAINS), covariance, 20_000)
    forces = SLOPE * np.asarray(pressures) * np.exp(-drawn)
    np.testing.assert_allclose(np.delete(error, 2), np.delete(forces.std(0), 2), rtol=0.03)
    np.testing.assert_allclose(np.delete(force, 2), np.delete(SLOPE * np.asarray(pressures)[0] / GAINS, 2), rtol=1e-9)
    assert np.isnan(force[2])


def test_the_reference_of_the_image_knows_where_it_was_made():
    rng = np.random.default_rng(3)
    place, force = rng.uniform(0, 0.2, (120, 2)), rng.uniform(4, 20, 120)

    def ratio(x, f):
        return np.exp(0.3 * np.sin(25 * x[:, 0]) - 0.2 * np.log(f))

    fitted = fit_reference(place, force, ratio(place, force) * force * np.exp(rng.normal(0, 0.02, 120)))
    new, load = rng.uniform(0.02, 0.18, (50, 2)), rng.uniform(5, 18, 50)
    mean, covariance, slope = fitted.predict(new, load)
    pull = (mean - np.log(ratio(new, load))) / np.sqrt(np.diag(covariance) + fitted.scatter**2)
    assert np.std(mean - np.log(ratio(new, load))) < 0.04
    assert np.abs(pull).max() < 4
    np.testing.assert_allclose(slope, -0.2, atol=0.06)
    _, outside, _ = fitted.predict(np.array([[0.1, 0.1], [0.6, 0.1], [0.1, 0.1]]), np.array([10.0, 10.0, 200.0]))
    assert outside[1, 1] > 3 * outside[0, 0]
    assert outside[2, 2] > 10 * outside[0, 0]


def press_many(later, path, **how):
    rng = np.random.default_rng(11)
    place, force = rng.uniform(0.02, 0.18, (60, 2)), rng.uniform(5, 18, 60)
    return later.record(path, place, force, load_cell=force, **how)


def test_evaluate_tells_what_has_moved_and_widens_intervals(calibration, later, tmp_path):
    paths = [
        press_many(later, tmp_path / "same.h5"),
        press_many(later, tmp_path / "moved.h5", gains=GAINS, offset=2 * OFFSET),
    ]
    found = []
    for path in paths:
        with calib.open_session(path) as session:
            found.append(calib.evaluate(calibration, session))
    same, moved = found
    assert not [note for note in same.notes if "health" in note or "at rest" in note or "outside" in note]
    assert any("health" in note and note.endswith(": recalibrate") for note in moved.notes)
    assert any("at rest" in note and "+80 Pa (lower left)" in note for note in moved.notes)
    force, plain = calibration.pads.hold_forces(moved.pressure)
    np.testing.assert_allclose(moved.pad_force, force)  # forces stay: to move them is what a recalibration does
    inside = np.abs(force.sum(1) - moved.force) <= plain
    assert inside.mean() < 0.6 < 0.85 <= moved.summary()["coverage"]
    np.testing.assert_allclose(same.half_width, calibration.pads.hold_forces(same.pressure)[1], rtol=0.15)


@pytest.mark.parametrize("pads", [2, 4, 9])
def test_a_move_that_pads_have_in_common_is_in_the_intervals(pads):
    """Which no image tells: of pads that move by 5 % each, nine of ten moves are within what is stated."""
    moves = np.random.default_rng(4).normal(0, 0.05, (2000, pads))
    seen = moves - moves.mean(1, keepdims=True)
    stated = np.array([np.sqrt(np.diag(covariance_of_moves(each, np.zeros(pads)))) for each in seen])
    assert 0.85 < (np.abs(moves) <= NORMAL_MULTIPLE * stated).mean() < 0.95


def test_apply_tells_what_has_moved_in_the_file_too(calibration, later, tmp_path):
    rng, said = np.random.default_rng(12), []
    place, force = rng.uniform(0.02, 0.18, (60, 2)), rng.uniform(5, 15, 60)
    path = later.record(tmp_path / "use.h5", place, force, gains=np.array([1.3, 0.8, 1.0, 1.0]), table=False)
    with calib.open_session(path) as session:
        calib.apply(calibration, session, tmp_path / "map.h5", tell=said.append)
    (line,) = [one for one in said if "health" in one]
    outside = read_archive(tmp_path / "map.h5", "skin-forcemap").attrs["outside"]
    assert line == f"note: {outside}"


def test_presses_beyond_the_calibrated_pressures_are_told(calibration, later, tmp_path):
    place, force = np.full((6, 2), 0.05), np.full(6, 12.0)
    force[2:4] = 30.0
    path = later.record(tmp_path / "far.h5", place, force, load_cell=force)
    with calib.open_session(path) as session:
        notes = calib.evaluate(calibration, session).notes
    assert any("outside the calibrated pressures: 2 of 6 presses" in note for note in notes)
