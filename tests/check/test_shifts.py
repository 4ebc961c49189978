"""Columns that change places from a row on, and streams of few channels that stand still."""

from datetime import UTC, datetime

import numpy as np
import pytest

from calib.check import Severity, check_session
from calib.check.streams.shifts import column_shift
from calib.session import SessionFacts, StreamFacts, open_session

from .recording import SECOND, Recording, Samples

ROWS = 800
RATE = 50.0


def table(seed=0):
    """Force in N and two pressures in Pa, with presses of 20 N every 4 s from second 3 on: (rows, 3)."""
    rng, seconds = np.random.default_rng(seed), np.arange(ROWS) / RATE
    load = np.clip(np.minimum((seconds - 3) % 4, 2 - (seconds - 3) % 4) / 0.4, 0, 1) * (seconds > 3)
    noise = rng.normal(size=(ROWS, 3)) * [0.01, 5.0, 5.0]
    return load[:, None] * [20.0, 1500.0, 40.0] + noise


def shifted(values, at):
    """Every column one further right from a row on."""
    return np.concatenate([values[:at], np.roll(values[at:], 1, axis=1)])


@pytest.mark.parametrize("at", [10, 13, 150, 400, 555, ROWS - 13, ROWS - 10])
def test_the_row_of_a_shift_is_found(at):
    for seed in range(5):
        found = column_shift(shifted(table(seed), at))
        assert found is not None
        row, up, down = found
        assert abs(row - at) <= 12
        assert (up, down) == (0, 1)


@pytest.mark.parametrize("change", ["none", "one column louder", "one column stands still", "both louder", "moves"])
def test_honest_changes_of_noise_are_no_shift(change):
    values = table()
    rng = np.random.default_rng(1)
    if change == "one column louder":
        values[400:, 0] += rng.normal(0, 5.0, 400)
    elif change == "one column stands still":
        values[400:, 1] = values[400, 1]
    elif change == "both louder":
        values[400:] += rng.normal(0, 100.0, (400, 3))
    elif change == "moves":  # a stage that stops as the press begins
        values = np.concatenate([values, np.where(np.arange(ROWS) < 150, rng.normal(0, 1e-3, ROWS), 0.1)[:, None]], 1)
    assert column_shift(values) is None


def test_a_table_too_short_to_tell_is_left_alone():
    assert column_shift(shifted(table(), 10)[:15]) is None


@pytest.fixture
def findings(tmp_path):
    """Warnings about a log of force and pressure."""

    def of(force, pressure, pressure_time=None):
        time = (np.arange(ROWS) * SECOND / RATE).astype(np.int64)
        streams = {
            "force": Samples(StreamFacts("force", units="N", channels=1, rate_hz=RATE), time, force[:, None]),
            "pressure": Samples(
                StreamFacts("pressure", units="Pa", channels=2, rate_hz=RATE),
                time if pressure_time is None else pressure_time,
                pressure,
            ),
        }
        facts = SessionFacts(epoch=datetime(2026, 1, 1, tzinfo=UTC))
        with open_session(Recording(facts, streams, None).write(tmp_path / "s.h5")) as session:
            return [f"{f.where}: {f.what}" for f in check_session(session).findings if f.severity > Severity.OK]

    return of


def test_an_honest_log_has_no_finding(findings):
    values = table()
    assert findings(values[:, 0], values[:, 1:]) == []


def test_a_shift_is_a_finding(findings):
    values = shifted(table(), 400)
    (found,) = (text for text in findings(values[:, 0], values[:, 1:]) if "columns look exchanged" in text)
    assert "the noise of force rises and that of pressure[0] falls" in found
    assert "from 8." in found or "from 7.9" in found


def test_a_device_that_repeats_its_last_values_stands_still(findings):
    values = table()
    values[600:, 1:] = values[600, 1:]
    found = findings(values[:, 0], values[:, 1:])
    assert any("/streams/pressure: stands still for 3.98 s, 12.00 s after" in text for text in found), found
    values = table()
    values[500:560, 0] = values[500, 0]
    found = findings(values[:, 0], values[:, 1:])
    assert any("/streams/force: stands still for 1.18 s, 10.00 s after" in text for text in found), found


def test_noise_that_stops_at_its_own_extreme_stands_still(findings):
    """No signal could have driven the sensor to an end of its range: it does not clip."""
    noise = np.round(np.random.default_rng(3).normal(0.0, 1.0, (ROWS, 2)))
    noise[200:] = noise[:200].min(0) - 1
    assert any("/streams/pressure: stands still" in text for text in findings(table()[:, 0], noise))


@pytest.mark.parametrize("step", [0.05, 0.5])
def test_a_coarse_load_cell_rests_and_does_not_stand_still(step, findings):
    values = table()
    force = np.round(values[:, 0] / step) * step
    assert not any("stands still" in text for text in findings(force, values[:, 1:]))


def test_sensors_that_clip_do_not_stand_still(findings):
    values = table()
    pressure = np.clip(values[:, 1:] - 30.0, 0.0, None)
    assert not any("stands still" in text for text in findings(values[:, 0], pressure))


@pytest.mark.parametrize("every", [2, 3, 8, 100])
def test_frames_of_zeros_in_place_of_readings_are_named(every, findings):
    values = table()
    values[5::every, 1:] = 0.0
    values[:, 1:] += 3000.0 * (values[:, 1:] != 0)
    found = findings(values[:, 0], values[:, 1:])
    assert any("/streams/pressure" in text and "one and the same, all 0, between" in text for text in found), found


def test_taps_and_missing_frames_are_no_zeros_of_the_device(findings):
    values = table()
    values[5::20, 1:] += 2000.0 * np.random.default_rng(2).uniform(0.5, 1, (40, 1))
    assert not any("one and the same" in text for text in findings(values[:, 0], values[:, 1:]))
    values[5::20, 1:] = np.nan
    assert not any("one and the same" in text for text in findings(values[:, 0], values[:, 1:]))
