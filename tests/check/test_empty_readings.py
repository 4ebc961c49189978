"""Readings that hold no voltage by the model of the skin are no dead wires: a thin strip read by neighbours."""

from datetime import UTC, datetime

import numpy as np
import pytest

import jaxeit as je
from calib.check import Severity, check_session, transfer_matrix
from calib.check.eit.reading_order import predict_readings
from calib.check.skin import voltage_findings
from calib.session import SessionFacts, StreamFacts, open_session

from .recording import SECOND, Recording, Samples

LENGTH, WIDTH, ELECTRODES, FRAMES = 0.5, 0.012, 11, 200
STEP = 3e-5  # V, of a converter of 16 bits over a volt
PLACES = [[0.02 + 0.046 * i, 0.003 if i % 2 else 0.009] for i in range(ELECTRODES)]
TEXT = f"""format = "jaxeit-skin"
version = 1
name = "strip"
[sheet]
shape = "rectangle"
size = [{LENGTH}, {WIDTH}]
sheet_resistance = 150.0
[electrodes]
kind = "bolt"
radius = 0.002
contact = 1e-6
positions = {PLACES}
[protocol]
pattern = "adjacent"
current = 1e-3
[[pads]]
name = "all"
rectangle = [0.0, 0.0, {LENGTH}, {WIDTH}]
"""


@pytest.fixture(scope="module")
def strip():
    return je.skin.parse_skin(TEXT, "strip")


@pytest.fixture(scope="module")
def transfer(strip):
    return transfer_matrix(strip)


@pytest.fixture
def report(strip, transfer, tmp_path):
    """Check frames of the untouched strip, with noise, in steps of a converter; some readings are zero."""

    def of(lost=(), noise=2e-6, step=STEP, rows=None):
        frame = strip.protocol.current * predict_readings(transfer, strip.protocol.pattern)
        rng = np.random.default_rng(0)
        relative, added = (size * rng.normal(size=(FRAMES, frame.size)) for size in (50 * noise, noise))
        frame = frame * (1 + relative) + added
        frame[:, list(lost)] = 0.0
        time = np.arange(FRAMES) * SECOND // 20
        own = strip.protocol.pattern if rows is None else strip.protocol.pattern[rows]
        frame = frame if rows is None else frame[:, rows]
        facts = SessionFacts(
            epoch=datetime(2026, 1, 1, tzinfo=UTC), skin_name="strip", skin_toml=strip.toml,
            pattern=own, current=strip.protocol.current,
        )  # fmt: skip
        about = StreamFacts("voltage", units="V", channels=frame.shape[1], rate_hz=20.0)
        values = np.round(frame / step) * step
        path = Recording(facts, {"eit": Samples(about, time, values)}, None).write(tmp_path / "s.h5")
        with open_session(path) as session:
            return check_session(session, transfer=transfer)

    return of


@pytest.mark.parametrize("step", [STEP, 1e-9], ids=["zeros", "noise"])
def test_readings_that_are_empty_by_the_model_are_not_dead(step, report):
    found = report(step=step)
    assert [f for f in found.findings if f.severity > Severity.OK] == []
    assert not found.channels.bad.any()
    assert found.channels.empty.sum() > 60
    (note,) = [f.what for f in found.findings if "as the model expects" in f.what]
    assert note.startswith(f"{found.channels.empty.sum()} of 88 readings hold no voltage above the noise")


def test_a_reading_that_should_hold_a_voltage_is_still_dead(strip, transfer, report):
    expected = np.abs(predict_readings(transfer, strip.protocol.pattern))
    row = int(expected.argmax())
    found = report([row])
    assert np.flatnonzero(found.channels.dead).tolist() == [row]
    (error,) = [f.what for f in found.findings if f.severity is Severity.ERROR]
    assert error.startswith(f"1 of 88 readings are always zero (dead): {row}")


def test_a_dead_electrode_is_named_by_the_readings_that_should_hold_a_voltage(strip, transfer, report):
    expected = np.abs(predict_readings(transfer, strip.protocol.pattern))
    of_five = (strip.protocol.pattern == 5).any(1)
    found = report(np.flatnonzero(of_five))
    (error,) = [f for f in found.findings if "(dead)" in f.what]
    assert np.array_equal(found.channels.dead, of_five & (expected > 1))
    assert "all of them use electrode 5" in error.what


def test_if_all_readings_are_constant_all_are_dead(report):
    found = report(noise=0.0)
    assert found.channels.dead.all()


def test_a_skin_most_of_whose_readings_are_empty_is_named(strip, transfer):
    readings = np.abs(predict_readings(transfer, strip.protocol.pattern))
    (finding,) = voltage_findings(readings * strip.protocol.current)
    assert finding.severity is Severity.WARNING
    assert "of 88 readings of the untouched skin hold less than 0.001 % of the voltage of the largest" in finding.what
    testbed = je.load_skin("testbed").protocol
    assert list(voltage_findings(np.geomspace(1e-4, 1, len(testbed.pattern)))) == []


def test_a_scan_of_few_readings_is_not_said_to_have_wrong_ones(report):
    found = report(rows=[15, 36, 43, 57])
    assert not any("sound" in f.what for f in found.findings)
    (note,) = [f for f in found.findings if "a frame has only 4 readings" in f.what]
    assert (note.severity, note.remedy) == (Severity.OK, "scan 10 readings or more")
