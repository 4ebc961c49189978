"""Logs without EIT that cannot be true are named with their time, and honest ones are not."""

from datetime import UTC, datetime

import numpy as np
import pytest

from calib.check import RecordingError, Severity, accept, check_session
from calib.check.logs.copies import repeated_stretch
from calib.cli import main
from calib.session import SessionFacts, SessionWriter, StreamFacts, open_session

RATE, SECONDS = 50.0, 60.0  # Hz, s
N = int(RATE * SECONDS)
HALF = N // 2
LATE = np.arange(N) >= HALF
TIME = np.arange(N) / RATE


def presses(seed=0):
    """Presses of 2 to 10 N, one every six seconds with rests between, (n,) N."""
    height = np.random.default_rng(seed).uniform(2, 10, 10).repeat(int(6 * RATE))
    return height * np.clip(1.5 * np.sin(2 * np.pi * TIME / 6), 0, 1)


def channels(force, gains=(100.0,), noise=5.0):
    """Channels (n, channels) Pa that follow the force by a curve, with noise."""
    rng = np.random.default_rng(1)
    return force[:, None] ** 0.8 * np.array(gains) + rng.normal(0, noise, (len(force), len(gains)))


def write(path, force, values, stage=None):
    """A log of a force (n,) N, channels (n, channels) Pa and, if it is given, a stage (n, 2) m."""
    facts = SessionFacts(skin_name="", skin_toml="", epoch=datetime(2026, 1, 1, tzinfo=UTC))
    time = np.rint(np.arange(len(force)) / RATE * 1e9).astype(np.int64)
    streams = {"force": ("N", force[:, None]), "pressure": ("Pa", values)}
    streams |= {} if stage is None else {"stage": ("m", stage)}
    with SessionWriter(path, facts) as writer:
        for name, (unit, columns) in streams.items():
            writer.add_stream(name, StreamFacts(name, units=unit, channels=columns.shape[1], rate_hz=RATE))
            writer.append(name, time, columns)
    return path


def raised(path):
    """Findings above a note about streams; of presses there are few."""
    with open_session(path) as session:
        found = check_session(session).findings
    return [f for f in found if f.severity > Severity.OK and f.where != "/presses"]


@pytest.fixture
def refused(tmp_path):
    """Write a log, see that the only error says these words at this place, and that no calibration takes it."""

    def look(force, values, where, words):
        path = write(tmp_path / "log.h5", force, values)
        errors = [f for f in raised(path) if f.severity is Severity.ERROR]
        assert [f.where for f in errors] == [where]
        assert words in errors[0].what
        assert errors[0].remedy
        with open_session(path) as session, pytest.raises(RecordingError, match=where):
            accept([session], None)

    return look


@pytest.mark.parametrize("gains", [(100.0,), (100.0, -50.0, 70.0)])
@pytest.mark.parametrize("remains", [0.0, 0.01])
def test_a_load_cell_that_was_unplugged_is_refused(remains, gains, refused):
    force, noise = presses(), remains * np.random.default_rng(2).normal(size=N)
    words = "from 30.0 s to 60.0 s after the start while column"
    refused(np.where(LATE, noise, force + noise), channels(force, gains), "/streams/force", words)


@pytest.mark.parametrize("gains", [(100.0,), (100.0, -50.0, 70.0)])
@pytest.mark.parametrize("factor", [9.80665, 1e-3])
def test_a_force_in_another_unit_from_the_middle_on_is_refused(factor, gains, refused):
    force = presses()
    words = "times as much with the pressure as before, from 30.0 s after the start on"
    refused(np.where(LATE, factor * force, force), channels(force, gains), "/streams/force", words)


@pytest.mark.parametrize("gains", [(100.0,), (100.0, -50.0, 70.0)])
def test_a_pressure_in_another_unit_from_the_middle_on_is_refused(gains, refused):
    values = channels(presses(), gains)
    values[LATE] /= 1000
    refused(presses(), values, "/streams/pressure", "the pressure changes 0.00")


@pytest.mark.parametrize("gains", [(100.0,), (100.0, -50.0, 70.0)])
def test_a_pressure_that_is_negated_from_the_middle_on_is_refused(gains, refused):
    values = channels(presses(), gains)
    values[LATE] *= -1
    refused(presses(), values, "/streams/pressure", "the pressure has the opposite sign from 30.0 s after the start on")


def test_a_pressure_of_noise_is_refused(refused):
    noise = np.random.default_rng(3).normal(0, 5, (N, 1))
    refused(presses(), noise, "/streams/pressure", "no channel follows the force: their largest rank corr")


def test_a_log_that_was_pasted_twice_is_refused(refused):
    force, values = presses(), channels(presses())
    words = "from 60.0 s after the start on are exact copies of those 60.0 s earlier, for 60.0 s"
    refused(np.tile(force, 2), np.tile(values, (2, 1)), "/streams/pressure", words)


def test_one_column_for_two_streams_is_refused(refused):
    force = presses() + np.random.default_rng(4).normal(0, 0.01, N)
    refused(force, 1000 * force[:, None], "/streams/pressure", "column 0 is the force times 1000 in every sample")


def test_the_command_line_calibrates_no_such_log(tmp_path, capsys):
    path = write(tmp_path / "log.h5", presses(), np.random.default_rng(3).normal(0, 5, (N, 1)))
    assert main(["calibrate", str(path), "-o", str(tmp_path / "c.h5"), "--curve", "linear"]) == 2
    assert "no channel follows the force" in capsys.readouterr().err
    assert not (tmp_path / "c.h5").exists()


def test_a_tube_that_came_off_and_one_odd_channel_are_warnings(tmp_path):
    """Contacts beside the sensor look like the former; a calibration can leave the latter out."""
    values = channels(presses())
    values[LATE] = 3 * np.random.default_rng(5).normal(size=(HALF, 1))
    found = raised(write(tmp_path / "off.h5", presses(), values))
    assert [(f.severity, f.where) for f in found] == [(Severity.WARNING, "/streams/pressure")]
    assert "no channel changes from 30.0 s to 60.0 s after the start" in found[0].what
    several = channels(presses(), (100.0, 50.0, 70.0))
    several[LATE, 1] *= -1
    found = raised(write(tmp_path / "odd.h5", presses(), several))
    assert [(f.severity, f.what.split(" from")[0]) for f in found] == [
        (Severity.WARNING, "column 1 has the opposite sign")
    ]


def test_another_gain_at_other_places_is_a_warning(tmp_path):
    force, stage = presses(), np.column_stack([0.01 * LATE, np.zeros(N)])
    found = raised(write(tmp_path / "log.h5", force, channels(force) * np.where(LATE, 6.0, 1.0)[:, None], stage))
    assert [f.severity for f in found] == [Severity.WARNING]
    assert "times as much with the force" in found[0].what


def test_pads_that_are_pressed_in_turn_are_not_accused(tmp_path):
    """What a pad shows of presses on the other one follows the force too, with a hundredth of its gain."""
    force = presses()
    values = channels(force, (100.0, 100.0), 0.01) * np.where(LATE[:, None], [0.01, 1.0], [1.0, 0.01])
    assert raised(write(tmp_path / "log.h5", force, values)) == []


HONEST = {
    "curved, light after heavy": (lambda f: (np.where(LATE, 0.1, 1) * f, (np.where(LATE, 0.1, 1) * f) ** 0.4 * 400)),
    "at rest in the second half": (lambda f: (np.where(LATE, 0, f), 100 * np.where(LATE, 0, f))),
    "drift and a gain that falls to a half": (lambda f: (f, 100 * f * (1 - TIME / 120) + 3 * TIME)),
    "filled and emptied once": (lambda _: (10 - np.abs(TIME - 30) / 3, 100 * (10 - np.abs(TIME - 30) / 3) ** 2)),
    "late by two seconds": (lambda f: (f, 100 * np.roll(f, 100))),
    "no press at all": (lambda f: (0 * f, 0 * f)),
    "coarse converter": (lambda f: (np.round(f, 1), np.round(f * 2) * 50)),
}


@pytest.mark.parametrize("name", HONEST)
def test_an_honest_log_is_not_accused(name, tmp_path):
    force, signal = HONEST[name](presses())
    rng = np.random.default_rng(6)
    noise = 0.0 if name == "coarse converter" else 1.0
    path = write(
        tmp_path / "log.h5",
        force + 0.01 * noise * rng.normal(size=N),
        signal[:, None] + 5 * noise * rng.normal(size=(N, 1)),
    )
    assert [f for f in raised(path) if "comes" not in f.what] == []


def test_the_longest_copy_is_found():
    number = np.arange(2000)
    number[1500:1800] = number[300:600]
    assert repeated_stretch(number) == (1500, 300, 1200)
    assert repeated_stretch(np.arange(2000)) is None
    assert repeated_stretch(np.abs(np.arange(-1000, 1000))) is None  # mirrored, not copied
