"""`jaxeit check`: a healthy session has no finding; each thing broken in turn is named."""

import json
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

import calib.check.presses.pads
import jaxeit as je
from calib.check import Severity, check_session, render, to_json, transfer_matrix
from calib.check.eit.reading_order import predict_readings
from calib.session import PressTable, SessionFacts, SessionWriter, Status, StreamFacts, open_session
from jaxeit.linalg import Dense

SECOND = 1_000_000_000
EPOCH = datetime(2026, 1, 1, tzinfo=UTC)
NOISE = 5e-6  # V; 57 dB below the median reading
TIMES = np.array([[4.0, 5.0, 7.0, 8.0], [11.0, 12.0, 14.0, 15.0]])  # s: press, hold, unload, release


def clock(rate, seconds=18.0):
    return np.rint(np.arange(round(seconds * rate)) / rate * SECOND).astype(np.int64)


def table(**changes):
    press, hold0, hold1, release = (np.rint(t * SECOND).astype(np.int64) for t in TIMES.T)
    columns = {"x": [0.05, 0.15], "y": [0.05, 0.15], "tip_diameter": [0.02, 0.02]}
    columns |= {"target_force": [20.0, 10.0], "pad": [0, 3], "accepted": [True, True]}
    times = {"t_press": press, "t_hold0": hold0, "t_hold1": hold1, "t_release": release}
    arrays = {k: np.asarray(v) for k, v in (columns | times | changes).items()}
    return PressTable(**arrays, reason=("", ""))


@dataclass
class Parts:
    """All that goes into a session; a test breaks one part."""

    skin: je.Skin
    toml: str
    pattern: np.ndarray | None
    streams: dict  # name: (variable, units, rate, time, values)
    presses: PressTable | None
    header: dict = field(default_factory=dict)
    status: dict = field(default_factory=dict)
    extras: dict = field(default_factory=dict)

    def values(self, name):
        return self.streams[name][4]

    def change(self, name, values):
        self.streams[name] = (*self.streams[name][:4], values)

    def write(self, path):
        about = {"title": "a test", "skin_name": self.skin.name, "skin_toml": self.toml}
        about |= {"pattern": self.pattern, "current": self.skin.protocol.current, "epoch": EPOCH}
        if self.pattern is None:
            about["current"] = None
        Path(path).unlink(missing_ok=True)  # the writer replaces no recording
        with SessionWriter(path, SessionFacts(**about | self.header)) as writer:
            for name, (variable, units, rate, time, values) in self.streams.items():
                writer.add_stream(name, StreamFacts(variable, units=units, channels=values.shape[1], rate_hz=rate))
                extras = self.extras.get(name, {})
                writer.append(name, time, values, self.status.get(name), **extras)
            if self.presses is not None:
                writer.set_presses(self.presses)
        return path


@pytest.fixture(scope="module")
def transfer(skin):
    return transfer_matrix(skin)


@pytest.fixture(scope="module")
def frame(skin):
    """Voltages of an uneven sheet."""
    model = je.discretise(je.Scene(skin), je.Fidelity.draft(solver=Dense()))
    x, y = np.asarray(model.centroids).T
    return np.asarray(je.forward(model, model.background * (1 + 0.3 * np.sin(25 * x) * np.cos(18 * y))))


def loads(time):
    """Share of the two presses' load, (n, 2)."""
    ends = [0.0, 1.0, 1.0, 0.0]
    return np.stack([np.interp(time / SECOND, t, ends) for t in TIMES], 1)


@pytest.fixture
def parts(skin, frame):
    rng = np.random.default_rng(0)
    slow, fast = clock(10.0), clock(100.0)
    touch = np.outer(loads(slow) @ [20.0, 10.0], 1e-3 * frame)
    eit = frame + touch + NOISE * rng.normal(size=(len(slow), len(frame)))
    force = loads(fast) @ [[20.0], [10.0]] + 0.01 * rng.normal(size=(len(fast), 1))
    pressure = loads(fast) @ [[2000.0, 0, 0, 0], [0, 0, 0, 1000.0]] + 3 * rng.normal(size=(len(fast), 4))
    streams = {
        "eit": ("voltage", "V", 10.0, slow, eit),
        "pressure": ("pressure", "Pa", 100.0, fast, pressure),
        "force": ("force", "N", 100.0, fast, force),
    }
    return Parts(skin, skin.toml, skin.protocol.pattern, streams, table())


@pytest.fixture
def look(tmp_path, transfer):
    """Write the parts, check them, and look at the page as well."""

    def run(parts, skin=None, break_file=lambda file: None):
        path = parts.write(tmp_path / "press.h5")
        with h5py.File(path, "r+") as file:
            break_file(file)
        with open_session(path) as session:
            report = check_session(session, skin, transfer=transfer)
        page = render(report)
        assert max(map(len, page.splitlines())) <= 100
        return report

    return run


def only(report, severity, *words):
    """The report has exactly one finding above a note, of this severity and with these words."""
    serious = [f for f in report.findings if f.severity > Severity.OK]
    assert len(serious) == 1, serious
    assert serious[0].severity is severity
    has(report, severity, *words)


def has(report, severity, *words):
    """Some finding has all these words and a remedy."""
    texts = [f"{f.where}: {f.what}" for f in report.findings if f.severity is severity and f.remedy]
    assert any(all(w in t for w in words) for t in texts), report.findings
    assert report.ok == (report.count(Severity.ERROR) == 0)


# --- healthy -------------------------------------------------------------------------------------


def test_a_healthy_session_has_no_finding(parts, look):
    report = look(parts)
    assert report.findings == ()
    assert report.ok
    assert "Nothing wrong was found." in render(report)
    assert report.order.as_is > 0.97
    assert report.presses.accepted == 2
    assert report.presses.source == "table"
    np.testing.assert_allclose(report.channels.noise, NOISE, rtol=0.5)
    rate = {s.name: (round(s.rate, 6), s.gaps, s.missing) for s in report.streams}
    assert rate == {"eit": (10, 0, 0), "pressure": (100, 0, 0), "force": (100, 0, 0)}
    assert [abs(o.delay) < 0.02 for _, o in report.onsets] == [True, True]


def test_the_page_lists_ten_readings_or_all(parts, look):
    report = look(parts)
    assert len(render(report, verbose=True).splitlines()) - len(render(report).splitlines()) == 540


def test_json_is_the_same_each_time(parts, look):
    first, second = to_json(look(parts)), to_json(look(parts))
    assert first == second
    read = json.loads(first)
    assert read["ok"] is True
    assert len(read["channels"]["snr"]) == 550


def test_a_simulated_session_says_so(parts, look):
    parts.header = {"simulated": True, "scene": "[scene]", "seed": 1}
    report = look(parts)
    assert report.ok
    assert "SIMULATED" in render(report).splitlines()[1]


def test_without_a_table_presses_are_found(parts, look):
    parts.presses = None
    report = look(parts)
    assert report.findings == ()
    assert (report.presses.source, report.presses.accepted) == ("force", 2)


def test_a_log_without_eit_or_skin_is_checked_too(parts, look):
    parts.toml, parts.pattern, parts.presses = "", None, None
    del parts.streams["eit"]
    report = look(parts)
    assert report.ok
    assert report.count(Severity.WARNING) == 0
    assert report.channels is None
    assert report.presses.accepted == 2


def test_a_stream_of_one_sample_does_not_stop_the_check(parts, look):
    parts.presses = None
    parts.streams = {"force": ("force", "N", 10.0, clock(10.0)[:1], np.ones((1, 1)))}
    has(look(parts), Severity.ERROR, "/streams/force", "presses are found in 10 or more")


@pytest.mark.parametrize("part", [0, 1], ids=["before", "rising"])
def test_force_that_is_missing_around_a_press_does_not_stop_the_check(parts, look, part):
    """NaN before the first press, or as its force rises."""
    variable, units, rate, time, values = parts.streams["force"]
    seconds, (begin, full, *_) = time / SECOND, TIMES[0]
    missing = [seconds <= begin, (seconds >= begin) & (seconds <= full)][part]
    parts.streams["force"] = (variable, units, rate, time, np.where(missing[:, None], np.nan, values))
    has(look(parts), Severity.WARNING, "/streams/force", "values are missing")


def test_a_pressure_in_newtons_is_no_pressure(parts, look):
    _, _, rate, time, values = parts.streams["pressure"]
    parts.streams["pressure"] = ("force", "N", rate, time, values)
    has(look(parts), Severity.ERROR, "/streams/pressure", "N is no unit of what a stream of this name measures (Pa, ")


def array_log(parts, faulty):
    """A log of force and twelve channels that follow it, some of them faulty."""
    rng = np.random.default_rng(4)
    time = parts.streams["force"][3]
    slopes = np.linspace(50.0, 150.0, 12)
    values = parts.values("force") * slopes + 2.0 * rng.normal(size=(len(time), 12))
    if faulty:
        values[:, 1] = np.nan
        values[:, 4] = 101.0
        values[:, 7] = 500 + 100 * rng.normal(size=len(time))
        values[::50, 9] += 2000
    parts.toml, parts.pattern, parts.presses = "", None, None
    parts.streams = {"force": parts.streams["force"], "pressure": ("pressure", "Pa", 100.0, time, values)}


def test_faulty_channels_of_an_array_are_named(parts, look):
    array_log(parts, faulty=True)
    report = look(parts)
    assert report.ok  # the calibration of a log leaves the channels out
    has(report, Severity.WARNING, "/streams/pressure", "1 of 12 channels", "(dead): 1")
    has(report, Severity.WARNING, "/streams/pressure", "1 of 12 channels", "(stuck): 4")
    has(report, Severity.WARNING, "/streams/pressure", "1 of 12 channels", "(silent): 7")
    has(report, Severity.WARNING, "/streams/pressure", "1 of 12 channels", "(spiking): 9")
    assert report.count(Severity.WARNING) == 4


def test_a_saturated_channel_of_an_array_is_named(parts, look):
    array_log(parts, faulty=False)
    values = parts.values("pressure")
    values[:, 11] = np.minimum(3 * values[:, 11], 4000.0)  # beyond the range of the others
    only(look(parts), Severity.WARNING, "/streams/pressure", "1 of 12 channels", "(saturated): 11")


def test_a_healthy_array_has_no_finding_above_a_note(parts, look):
    array_log(parts, faulty=False)
    assert all(f.severity is Severity.OK for f in look(parts).findings)


def test_an_array_in_a_long_recording_is_searched_in_pieces(parts, look, monkeypatch):
    monkeypatch.setattr(calib.check.presses.pads, "PIECES", 8)
    monkeypatch.setattr(calib.check.presses.pads, "PIECE_LENGTH", 100)
    array_log(parts, faulty=True)
    report = look(parts)
    for words in ("(dead): 1", "(stuck): 4", "(silent): 7", "(spiking): 9"):
        has(report, Severity.WARNING, words)


# --- order and sign ------------------------------------------------------------------------------


def exchanged(i, j):
    number = np.arange(25)
    number[[i, j]] = j, i
    return number


ROWS = np.arange(25).reshape(5, 5)
ROWS[1::2] = ROWS[1::2, ::-1].copy()
NUMBERINGS = {
    "electrodes 3 and 17 are exchanged": exchanged(3, 17),
    "electrodes 0 and 1 are exchanged": exchanged(0, 1),
    "the recorder's 0 is the skin's 4": (np.arange(25) + 4) % 25,
    "electrodes are numbered row by row, all alike": ROWS.ravel(),
}


@pytest.mark.parametrize("name", NUMBERINGS)
def test_wrong_numbering_is_named(name, parts, look, transfer):
    pattern = parts.pattern
    model, wrong = (predict_readings(transfer, p) for p in (pattern, NUMBERINGS[name][pattern]))
    uneven = parts.values("eit") - 1e-3 * model
    parts.change("eit", uneven + 1e-3 * wrong)
    report = look(parts)
    only(report, Severity.ERROR, "the order looks wrong", name)
    assert report.order.best > 0.95 > report.order.as_is


def test_reversed_signs_are_named(parts, look):
    parts.change("eit", -parts.values("eit"))
    report = look(parts)
    only(report, Severity.ERROR, "every sign is reversed", "-0.99", "as recorded and 0.99")


def test_magnitudes_are_named(parts, look):
    parts.change("eit", np.abs(parts.values("eit")))
    only(look(parts), Severity.ERROR, "magnitudes without sign")


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (lambda p: np.arange(550)[::-1], "come in reversed order"),
        (lambda p: np.lexsort((p[:, 2], p[:, 0])), "within each drive"),
        (lambda p: np.roll(np.arange(550), -7), "starts at reading 7 "),
    ],
)
def test_wrong_order_of_readings_is_named(order, words, parts, look):
    parts.change("eit", parts.values("eit")[:, order(parts.pattern)])
    report = look(parts)
    has(report, Severity.ERROR, "the order looks wrong", words)
    assert report.order.best > 0.95 > report.order.as_is


def test_a_wrong_order_shows_as_reciprocity_error(parts, look):
    parts.change("eit", np.roll(parts.values("eit"), -7, 1))
    has(look(parts), Severity.WARNING, "reciprocity error")


def test_readings_of_something_else_are_not_explained(parts, look):
    other = np.random.default_rng(5).normal(size=550) * 5e-3
    parts.change("eit", parts.values("eit") * 1e-3 + other)
    has(look(parts), Severity.WARNING, "do not look like this skin", "no simple reordering")


def test_millivolts_are_suspected(parts, look):
    parts.change("eit", parts.values("eit") * 1e3)
    only(look(parts), Severity.WARNING, "times the model's")


# --- channels ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "severity", "words"),
    [
        (0.0, Severity.ERROR, "always zero"),
        (0.1, Severity.ERROR, "never change"),
        (np.nan, Severity.WARNING, "no finite"),  # a calibration leaves these out
    ],
)
def test_dead_readings_are_listed(value, severity, words, parts, look):
    parts.values("eit")[:, [7, 300]] = value
    report = look(parts)
    only(report, severity, "2 of 550 readings", words, ": 7, 300")
    assert json.loads(to_json(report))["channels"]["dead"][7] is True
    assert np.flatnonzero(report.channels.dead).tolist() == [7, 300]


def test_readings_without_any_value_are_an_error_if_they_are_many(parts, look):
    parts.values("eit")[:, ::2] = np.nan
    has(look(parts), Severity.ERROR, "275 of 550 readings", "no finite")


def test_a_dead_electrode_is_named(parts, look):
    uses = (parts.pattern == 12).any(1)
    parts.values("eit")[:, uses] = 0.0
    only(look(parts), Severity.ERROR, f"{uses.sum()} of 550 readings", "all of them use electrode 12")


@pytest.mark.parametrize(("count", "severity"), [(20, Severity.WARNING), (80, Severity.ERROR)])
def test_a_converter_at_its_end_is_saturated(count, severity, parts, look):
    eit = parts.values("eit")
    limit = np.sort(np.abs(eit).max(0))[-count]
    parts.change("eit", np.clip(eit, -limit, limit))
    report = look(parts)
    has(report, severity, "saturated")
    assert 0.5 * count <= report.channels.saturated.sum() + report.channels.dead.sum() <= count


def same_readings(parts, header):
    """No noise, four readings of one value, the largest of all: as of a symmetric skin that is simulated."""
    parts.header = header
    time = parts.streams["eit"][3]
    frame = parts.values("eit").mean(0)
    frame[np.argsort(np.abs(frame))[-4:]] = -2 * np.abs(frame).max()
    parts.change("eit", frame * (1 + np.outer(loads(time) @ [2e-3, 1e-3], np.linspace(0, 1, len(frame)))))
    return frame


SIMULATED = {"simulated": True, "scene": "[scene]", "seed": 1}


@pytest.mark.parametrize("header", [{}, SIMULATED], ids=["recorded", "simulated"])
def test_equal_readings_without_noise_are_not_saturated(header, parts, look):
    same_readings(parts, header)
    report = look(parts)
    assert not report.channels.saturated.any()
    assert not any("saturated" in f.what for f in report.findings)


def test_readings_that_never_change_do_not_rise(parts, look):
    frame = same_readings(parts, SIMULATED)
    parts.change("eit", np.tile(frame, (len(parts.values("eit")), 1)))
    report = look(parts)
    has(report, Severity.ERROR, "550 of 550 readings never change (dead)")
    assert {name for name, _ in report.onsets} == {"pressure"}
    assert "eit rises" not in render(report)


def test_the_status_flag_tells_which_reading_is_saturated(parts, look):
    eit = parts.values("eit")
    top = eit.max(0).argmax()
    pressed = eit[:, top] > np.quantile(eit[:, top], 0.9)
    eit[pressed, top] = eit[:, top].max()
    parts.status["eit"] = np.where(pressed, Status.saturated, 0)
    report = look(parts)
    has(report, Severity.WARNING, f"{pressed.sum()} samples beyond the converter's range")
    assert np.flatnonzero(report.channels.saturated).tolist() == [top]


def test_missing_values_are_counted(parts, look):
    parts.values("eit")[::4, 33] = np.nan
    only(look(parts), Severity.WARNING, "in 1 of 550 channels, most in channel 33 (25 %)")


def test_a_noisy_reading_is_named(parts, look):
    eit = parts.values("eit")
    quiet = int(np.argsort(np.abs(eit[0]))[275])
    eit[:, quiet] += 100 * NOISE * np.random.default_rng(1).normal(size=len(eit))
    report = look(parts)
    has(report, Severity.WARNING, "1 of 550 readings", "noisier", f": {quiet}")
    assert report.count(Severity.ERROR) == 0


def test_low_signal_is_a_warning(parts, look):
    eit = parts.values("eit")
    parts.change("eit", eit + 40 * NOISE * np.random.default_rng(2).normal(size=eit.shape))
    has(look(parts), Severity.WARNING, "median SNR")
    assert "It can be calibrated." in render(look(parts))
    del parts.streams["force"]
    assert "It can be used; a calibration needs the force too." in render(look(parts))


def test_what_a_calibration_lacks_is_said(parts, look):
    del parts.streams["force"]
    assert "Nothing wrong was found. A calibration needs the force too." in render(look(parts))


def test_places_of_the_presses_are_missed(parts, look):
    parts.presses = None  # and there is no stream of the stage
    said = " ".join(render(look(parts)).split())
    assert "needs the places of the presses (a stream named stage, or a table of presses) too" in said


def test_presses_are_missed(parts, look):
    parts.presses = None
    parts.change("force", np.zeros_like(parts.values("force")))
    said = " ".join(render(look(parts)).split())
    assert "It can be used; a calibration needs presses and the places of the presses" in said


# --- skin and protocol ---------------------------------------------------------------------------


def test_a_pad_that_lies_beyond_the_sheet_is_named(parts, look):
    parts.toml = parts.toml.replace("rectangle = [0.1, 0.1, 0.2, 0.2]", "rectangle = [0.1, 0.1, 0.3, 0.2]")
    has(look(parts), Severity.WARNING, "50 % of pad 'upper right' lies beyond the sheet")


def test_presses_beside_all_pads_are_told_by_their_places(parts, look):
    for corner, small in (
        ("0.0, 0.0, 0.1, 0.1", "0.0, 0.0, 0.03, 0.03"),
        ("0.1, 0.1, 0.2, 0.2", "0.17, 0.17, 0.2, 0.2"),
    ):
        parts.toml = parts.toml.replace(f"rectangle = [{corner}]", f"rectangle = [{small}]")
    parts.change("pressure", 0 * parts.values("pressure"))
    found = look(parts)
    has(found, Severity.WARNING, "presses rest on no pad")
    assert not any("no pad feels" in one.what and "tubes" in one.remedy for one in found.findings)


@pytest.mark.parametrize("size", ["[0.2, 2.0]", "[20.0, 0.2]"])
def test_a_sheet_that_reaches_far_beyond_its_electrodes_is_named(size, parts, look):
    """The readings alone follow such a sheet nearly as well."""
    parts.toml = parts.toml.replace("size = [0.2, 0.2]", f"size = {size}")
    has(look(parts), Severity.WARNING, "m beyond its electrodes, which are 0.04 m apart")


def test_a_pad_beyond_all_electrodes_is_named(parts, look):
    """A pitch that is half the true one: three of four pads have hardly an electrode."""
    assert "pitch = 0.04" in parts.toml
    parts.toml = parts.toml.replace("pitch = 0.04", "pitch = 0.02")
    report = look(parts)
    for pad in ("lower right", "upper left", "upper right"):
        has(report, Severity.WARNING, f"of pad {pad!r} lies more than 0.02 m", "EIT tells no place there")
    assert not any("pad 'lower left'" in finding.what for finding in report.findings)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_sheet_resistance_that_is_ten_times_wrong_is_suspected(factor, parts, look):
    variable, units, rate, time, eit = parts.streams["eit"]
    parts.streams["eit"] = (variable, units, rate, time, factor * eit)
    has(look(parts), Severity.WARNING, "times the model's", "sheet_resistance is wrong")


def test_a_skin_that_does_not_parse_is_an_error(parts, look):
    parts.toml = parts.toml.replace('shape = "rectangle"', 'shape = "rhombus"')
    only(look(parts), Severity.ERROR, "/device", "rhombus")


def test_an_edited_skin_under_a_shipped_name_is_noticed(parts, look):
    parts.toml = parts.toml.replace("sheet_resistance = 150.0", "sheet_resistance = 120.0")
    only(look(parts), Severity.WARNING, "differs from the shipped 'testbed' in: sheet.sheet_resistance")


def test_a_pattern_in_another_order_than_the_skin_s(parts, look):
    parts.pattern = np.roll(parts.pattern, 1, 0)
    parts.change("eit", np.roll(parts.values("eit"), 1, 1))
    only(look(parts), Severity.ERROR, "the same readings in another order: 550 rows differ")


def test_a_pattern_of_electrodes_that_are_not_there(parts, look):
    parts.pattern = parts.pattern + 1
    report = look(parts)
    only(report, Severity.ERROR, "names electrode 25; the skin has 0 to 24")
    assert report.order is None


def test_eit_without_a_pattern(parts, look):
    parts.pattern = None
    only(look(parts), Severity.ERROR, "no pattern was recorded")


def test_frames_faster_than_a_scan(parts, look, skin):
    slow = replace(skin, protocol=replace(skin.protocol, reading_time=2.5e-4))
    only(look(parts, slow), Severity.WARNING, "10 frames a second, but one scan takes 138 ms")


# --- streams, presses, pads ----------------------------------------------------------------------


def test_an_interrupted_recording(parts, look):
    def interrupt(file):
        file.attrs["complete"] = np.uint8(0)

    report = look(parts, break_file=interrupt)
    only(report, Severity.WARNING, "not complete")
    assert "NOT COMPLETE" in render(report)


def test_a_gap_sets_a_press_aside(parts, look):
    keep = (clock(100.0) < 11.5 * SECOND) | (clock(100.0) > 14.5 * SECOND)
    variable, units, rate, time, values = parts.streams["pressure"]
    parts.streams["pressure"] = (variable, units, rate, time[keep], values[keep])
    report = look(parts)
    has(report, Severity.WARNING, "1 gap, the longest of 3.02 s, 11.49 s after its start; 301 samples lost")
    assert report.presses.accepted == 1
    assert report.presses.rejected[0][0] == 1
    assert "no pressure sample" in report.presses.rejected[0][1]


def test_an_irregular_log_of_force_alone_is_no_error(parts, look):
    time, values = parts.streams["force"][3], parts.values("force")
    keep = np.random.default_rng(3).random(len(time)) < 0.6
    values[::2] = np.nan
    parts.streams = {"force": ("force", "N", 100.0, time[keep], values[keep])}
    parts.presses = None
    report = look(parts)
    has(report, Severity.WARNING, "comes irregularly")
    has(report, Severity.WARNING, "none of 2 presses can be used", "of its force samples are missing")
    assert report.ok


@pytest.mark.parametrize(
    ("lost", "severity", "words"), [(False, Severity.OK, "jitter"), (True, Severity.WARNING, "20 gaps")]
)
def test_gaps_that_early_samples_make_up_for_are_jitter(lost, severity, words, parts, look):
    """Each fifteenth sample comes late, and the next ones together; or each fortieth is lost."""
    variable, units, rate, time, values = parts.streams["pressure"]
    k = np.arange(len(time))
    late = time + np.where(k % 15 == 7, 9 * SECOND // 1000, 0)
    keep = k % (len(k) // 20) != 9
    given = (time[keep][: len(k)], values[keep]) if lost else (late, values)
    parts.streams["pressure"] = (variable, units, rate, *given)
    has_words = [f for f in look(parts).findings if f.where == "/streams/pressure" and words in f.what]
    assert [f.severity for f in has_words] == [severity]


def test_lost_samples_are_counted_from_sequence_numbers(parts, look):
    seq = np.arange(1800, dtype=np.int64) + 2**32 - 900  # wraps half-way
    seq[1000:] += 5
    parts.extras["force"] = {"seq": seq % 2**32}
    only(look(parts), Severity.WARNING, "/streams/force", "5 samples were lost")


def test_a_rate_that_is_not_the_nominal_one(parts, look):
    variable, units, _, time, values = parts.streams["force"]
    parts.streams["force"] = (variable, units, 200.0, time, values)
    only(look(parts), Severity.WARNING, "at 100 Hz, not at the nominal 200 Hz")


@pytest.mark.parametrize("listed", [True, False])
def test_negative_force_while_pressing(listed, parts, look):
    parts.presses = parts.presses if listed else None
    parts.change("force", -parts.values("force"))
    has(look(parts), Severity.ERROR, "negative while pressing")


def test_force_far_from_its_target(parts, look):
    parts.change("force", parts.values("force") / 9.80665)
    only(look(parts), Severity.WARNING, "0.102 times the target")


@pytest.mark.parametrize(("factor", "words"), [(1e-3, "kPa or bar"), (100.0, "beyond the sensor's span")])
def test_pressure_in_another_unit(factor, words, parts, look):
    parts.change("pressure", parts.values("pressure") * factor)
    has(look(parts), Severity.WARNING, words)


def test_a_pad_too_few(parts, look):
    parts.change("pressure", parts.values("pressure")[:, :3])
    has(look(parts), Severity.ERROR, "has 3 columns, the skin 'testbed' has 4 pads")


def test_pressures_by_another_name_are_missing(parts, look):
    parts.streams["presure"] = parts.streams.pop("pressure")
    only(look(parts), Severity.ERROR, "missing; the skin 'testbed' has 4 pads, the file has: eit, force, presure")


@pytest.mark.parametrize(("value", "words"), [(np.nan, "no finite sample"), (101.0, "always reads 101 Pa")])
def test_a_dead_pad_is_named(value, words, parts, look):
    parts.values("pressure")[:, 1] = value
    report = look(parts)
    only(report, Severity.ERROR, "pad 'lower right'", words)
    assert [p.dead for p in report.pads] == [False, True, False, False]


def test_a_pressure_sensor_at_its_end(parts, look):
    pressure = parts.values("pressure")
    pressure[:, 0] = np.minimum(pressure[:, 0] * 30, 34474.0)
    only(look(parts), Severity.WARNING, "pad 'lower left'", "end of the sensor's span")


def test_pads_in_another_order(parts, look):
    parts.change("pressure", parts.values("pressure")[:, [1, 0, 2, 3]])
    parts.presses = table(x=np.array([0.05, 0.05]), y=np.array([0.05, 0.05]), pad=np.array([0, 0]))
    pressure = parts.values("pressure")
    pressure[:, 1] += pressure[:, 3]
    pressure[:, 3] = pressure[::-1, 2]
    only(look(parts), Severity.ERROR, "column 1 responds over pad 'lower left'")


def test_millimetres_put_presses_outside_the_sheet(parts, look):
    parts.presses = table(x=np.array([50.0, 150.0]))
    only(look(parts), Severity.ERROR, "2 of 2 presses lie outside the sheet")


@pytest.mark.parametrize(("rows", "said"), [(80, "rises 0.800 s after"), (-80, "rises 0.800 s before")])
def test_clocks_that_disagree(parts, look, rows, said):
    parts.change("pressure", np.roll(parts.values("pressure"), rows, 0))
    only(look(parts), Severity.ERROR, "/streams/pressure", said)


@pytest.mark.parametrize("rows", [-60, -15, 0, 15, 60])
def test_the_delay_of_a_stream_is_found_in_either_direction(parts, look, rows):
    """Also where the rest before a press holds the rise of a stream that is early."""
    plain = dict(look(parts).onsets)["pressure"].delay
    parts.change("pressure", np.roll(parts.values("pressure"), rows, 0))
    assert dict(look(parts).onsets)["pressure"].delay - plain == pytest.approx(0.01 * rows, abs=2e-3)


def test_damaged_samples_are_a_finding(parts, tmp_path, transfer):
    path = parts.write(tmp_path / "press.h5")
    with h5py.File(path) as file:
        chunk = file["streams/force/force"].id.get_chunk_info(0)
    raw = bytearray(path.read_bytes())
    raw[chunk.byte_offset + 40] ^= 0xFF
    path.write_bytes(raw)
    with open_session(path) as session:
        report = check_session(session, transfer=transfer)
    has(report, Severity.ERROR, "/streams/force: cannot be read")
