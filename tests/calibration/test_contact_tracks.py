"""Contacts followed through a recording, by `apply --track`: rows of the file, report, and the command line."""

import re
from pathlib import Path

import numpy as np
import pytest

import jaxeit as je
from calib.bench import load_bench, simulate
from calib.bench.motion import loads_at, planned_motion
from calib.calibration.application.map_files import FORCE_MAP_FORMAT, LOADS, TRACKS
from calib.calibration.calibration import Calibration
from calib.calibration.localisation import contact_tracks
from calib.calibration.localisation.contact_tracks import (
    GAIN_DRIFT,
    MIN_SECONDS,
    TRACK_ARRAYS,
    ContactTracks,
    NotFollowed,
)
from calib.calibration.localisation.learned import probes
from calib.calibration.localisation.learned.probes import PAD_SHARE, learned_depth, pad_errors
from calib.calibration.localisation.load_windows import LEARNED, LOAD_ARRAYS
from calib.calibration.localisation.quiet_frames import QuietFrames
from calib.cli import main
from calib.report.track_report import by_number, write_track_report
from calib.session import read_archive, write_archive
from jaxeit.contacts import LoadSettings
from jaxeit.contacts.loads.pressure import MAX_LOADS
from jaxeit.tracking import GainField, LearnedLayer, Track, Tracker, TrackerSettings, Tracking

from ..helpers import stand_in
from ..place_logs import place_log, write_place_log

S = 10**9


class FakeTracker(Tracker):
    """As many contacts as a frame's first reading says, which move by their number of mm from frame to frame."""

    def __init__(self):
        self.seconds = []

    def start(self, layer=None):
        return self._after(0, 0.0)

    def _after(self, count, x):
        return stand_in(
            Tracking,
            tracks=tuple(
                Track(n + 1, np.array([x * (n + 1), 0.0]), 1e-6 * np.eye(2), 0.01, 5.0, 0.1, np.zeros(2), np.zeros(2))
                for n in range(count)
            ),
        )

    def step(self, now, change, seconds, force, error):
        self.seconds.append(seconds)
        return self._after(int(np.nan_to_num(change[0])), 1e-3 * len(self.seconds))


def test_presses_to_which_no_contact_is_fitted_are_named(monkeypatch):
    """As recordings of contacts cannot be followed that the calibration's own presses do not show."""

    def refuse(*_):
        raise je.imaging.InverseError("one contact is fitted to 0 of 24 frames")

    monkeypatch.setattr(je.tracking, "fit_model_error", refuse)
    monkeypatch.setattr(contact_tracks, "probe_presses", lambda _: (np.zeros((24, 3)),) * 3)
    with pytest.raises(NotFollowed, match="do not tell how far the model errs: one contact is fitted to 0 of 24"):
        contact_tracks._with_model_error(FakeTracker(), None)


@pytest.fixture
def asked(monkeypatch):
    """Settings and untouched frames with which trackers are prepared; no coating explains readings below zero."""
    given = []

    def prepare(model, skin, settings, untouched=None, **options):
        given.append((settings, untouched))
        if untouched is not None and untouched[0] < 0:
            raise je.imaging.InverseError("no coating explains v0")
        return FakeTracker()

    monkeypatch.setattr(je.tracking, "prepare_tracker", prepare)
    monkeypatch.setattr(contact_tracks, "_with_model_error", lambda tracker, _: tracker)
    monkeypatch.setattr(contact_tracks, "learned_depth", lambda *_: 0.0)
    monkeypatch.setattr(je, "discretise", lambda *_: None)
    return given


def test_a_sheet_that_no_coat_explains_is_taken_for_even(skin, asked):
    """Else its error is in the deviations of the gain that is learned."""
    untouched = np.ones(3)
    calibration = stand_in(Calibration, recon=stand_in(je.Reconstructor, channels=untouched > 0), skin=skin)
    told = []
    for frame in (untouched, -untouched):
        contact_tracks.prepare_calibrated_tracker(calibration, frame, untouched, tell=told.append)
    assert len(told) == 1
    assert told[0].startswith("note: the sheet is taken for even, as the untouched frame shows none that fits: no coat")
    first, second, *others = [frame for _, frame in asked]
    np.testing.assert_array_equal(first, untouched)
    np.testing.assert_array_equal(second, -untouched)
    assert others == [None]


def test_the_depth_that_presses_tell_is_that_of_the_tracker(skin, asked, monkeypatch):
    """Unless the settings state one."""
    told, noise = [], np.ones(3)
    monkeypatch.setattr(contact_tracks, "learned_depth", lambda *_: 0.009)
    calibration = stand_in(Calibration, recon=stand_in(je.Reconstructor, channels=noise > 0), skin=skin)
    contact_tracks.prepare_calibrated_tracker(calibration, noise, noise, tell=told.append)
    assert [settings.loads.depth for settings, _ in asked] == [None, 0.009]
    assert told == ["presses of the calibration spread as at a depth of 9.0 mm in an elastic half-space"]
    flat = TrackerSettings(loads=LoadSettings(depth=0.0))
    contact_tracks.prepare_calibrated_tracker(calibration, noise, noise, flat, told.append)
    assert [settings for settings, _ in asked[2:]] == [flat]


def test_a_layer_keeps_the_depth_under_which_it_was_learned(monkeypatch):
    """Presses are not asked again; they are where nothing was learned, if the calibration kept any."""
    monkeypatch.setattr(je.tracking, "fit_depth", lambda tracker, *presses: 0.007)
    monkeypatch.setattr(probes, "probe_presses", lambda calibration: calibration.probes)
    learned = stand_in(LearnedLayer, field=stand_in(GainField, depth=0.012))
    for layer, presses, expected in ((learned, (1,), 0.012), (None, (1,), 0.007), (None, None, 0.0)):
        assert learned_depth(stand_in(Calibration, layer=layer, probes=presses), FakeTracker()) == expected


def test_a_drift_of_all_readings_is_noise():
    """A drift of a thousandth of all readings is as probable as noise; one of a single reading is not."""
    rng = np.random.default_rng(0)
    untouched, noise = rng.uniform(0.1, 1.0, 300), np.full(300, 1e-6)
    covariance = contact_tracks._covariance(noise, untouched)
    alone = np.where(np.arange(300) == 7, GAIN_DRIFT * untouched, 0.0)
    together, single = (x @ np.linalg.solve(covariance, x) for x in (GAIN_DRIFT * untouched, alone))
    assert together == pytest.approx(1, rel=1e-3)
    assert single > 1e3


def test_rows_are_the_contacts_of_each_frame():
    """In blocks; a frame at the time of another, and one without readings, are frames too."""
    tracker = FakeTracker()
    tracks = ContactTracks(tracker, smooth=False)
    time = np.array([0, 0, 1, 2, 4]) * S
    change = np.array([[1.0], [2.0], [np.nan], [0.0], [2.0]])
    pads = np.ones((5, 2))
    parts = [tracks.add(time[s], change[s], pads[s], pads[s]) for s in (slice(0, 3), slice(3, 4), slice(4, 5))]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in TRACK_ARRAYS}
    assert (rows["time"] / S).tolist() == [0, 0, 0, 4, 4]
    assert rows["number"].tolist() == [1, 1, 2, 1, 2]
    np.testing.assert_allclose(rows["position"][:, 0], [1e-3, 2e-3, 4e-3, 5e-3, 10e-3])
    np.testing.assert_allclose(rows["force_se"], 0.5)
    assert tracker.seconds == [MIN_SECONDS, MIN_SECONDS, 1, 1, 2]
    assert rows["position_covariance"].shape == (5, 2, 2)
    assert parts[1]["half"].shape == (0, 2)
    assert "2 followed from 0.00 to 4.00 s, at most 2 at once" in tracks.render()
    assert "none touched" in ContactTracks(tracker, smooth=False).render()


def test_a_pads_error_grows_with_its_force():
    np.testing.assert_allclose(pad_errors(np.array([0.0, 20.0]), np.array([0.3, 0.0])), [0.3, 20 * PAD_SHARE])


def test_quiet_frames_leave_out_what_is_missing_or_touched():
    quiet = QuietFrames(3)
    assert quiet.noise is None
    frames = np.array([[1.0, np.nan, 5.0], [3.0, np.nan, np.nan]]).repeat(10, 0)
    quiet.add(frames, frames - 2.0, np.zeros(20, bool))
    quiet.add(1e3 + frames, frames, np.ones(20, bool))
    np.testing.assert_array_equal(quiet.untouched, [2.0, 0.0, 5.0])
    np.testing.assert_array_equal(quiet.noise, [1.0, 0.0, 3.0])


def written(path, count):
    """A file of force maps with `count` contacts that slide, of which the last is an edge."""
    time = np.tile(np.arange(50) * S // 50, count)
    number = np.arange(1, count + 1).repeat(50)
    rows = {
        "time": time,
        "number": number,
        "position": np.stack([0.02 + 1e-10 * time, 0.03 * number], 1),
        "position_covariance": np.tile(1e-6 * np.eye(2), (len(time), 1, 1)),
        "width": np.full(len(time), 0.01),
        "force": 5.0 * number,
        "force_se": 0.1 * number,
        "half": np.stack([0.01 * (number == count), 0.0 * number], 1),
        "velocity": np.tile([0.1, 0.0], (len(time), 1)),
    }
    arrays = {TRACKS + name: (rows[name], *about[1:3]) for name, about in TRACK_ARRAYS.items()} if count else {}
    write_archive(path, FORCE_MAP_FORMAT, {"session": "<s>.h5", "simulated": 1}, arrays)
    return rows


def test_a_report_tells_each_contact(tmp_path, skin):
    pytest.importorskip("matplotlib")
    rows = written(tmp_path / "map.h5", 3)
    assert list(by_number(rows)) == [1, 2, 3]
    page = write_track_report(tmp_path / "r.html", tmp_path / "map.h5", skin).read_text()
    assert "SIMULATED" in page
    assert "&lt;s&gt;.h5" in page
    assert page.count("<svg") == 2
    assert "15.00\u00a0±\u00a00.30" in page
    assert "20.0, 90.0" in page
    assert "100" in page


def test_a_report_without_contacts_says_so(tmp_path, skin):
    pytest.importorskip("matplotlib")
    written(tmp_path / "map.h5", 0)
    assert "No contact" in write_track_report(tmp_path / "r.html", tmp_path / "map.h5", skin).read_text()


def test_a_report_tells_what_touched_the_skin(tmp_path, skin):
    """Each window with the probabilities of its kinds, and the loads of the most probable one."""
    pytest.importorskip("matplotlib")
    probability = np.array([[0.0, 0.91, 0.05, 0.04, 0.0], [0.0, 0.02, 0.17, 0.81, 0.0]])
    nothing = np.full((2, MAX_LOADS, 2), np.nan)
    nothing[:, 0] = [[0.03, 0.04], [0.123, 0.056]]
    force = np.array([[5.0, np.nan, np.nan], [7.25, np.nan, np.nan]])
    windows = {
        "time": np.array([[1, 2], [2, 3]]) * S,
        "probability": probability,
        "distance": np.array([0.3, 1.2]),
        "position": nothing,
        "force": force,
    }
    arrays = {LOADS + name: (part, *LOAD_ARRAYS[name]) for name, part in windows.items()}
    arrays[LOADS + LEARNED] = (np.array(["pressure adds < 150 %"]), "1", "what presses told")
    write_archive(tmp_path / "map.h5", FORCE_MAP_FORMAT, {"session": "s.h5", "simulated": 1}, arrays)
    page = write_track_report(tmp_path / "r.html", tmp_path / "map.h5", skin).read_text()
    assert "No contact" not in page
    assert page.count("<svg") == 1
    assert "1 of 2 windows are unlike" in page
    assert "taught the fits: pressure adds &lt; 150 %.</p>" in page
    cells = re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", page[page.index("<tbody>") :])
    assert cells[10:] == ["2.00", "3.00", "an edge", "0 %", "2 %", "17 %", "81 %", "0 %", "123, 56", "7.2"]


def test_what_cannot_be_followed_is_refused_in_one_line(tmp_path, capsys):
    log, c = str(write_place_log(tmp_path / "log.h5", place_log(0))), str(tmp_path / "c.h5")
    assert main(["calibrate", log, "-o", c, "--curve", "affine"]) == 0
    assert main(["apply", c, log, "-o", str(tmp_path / "f.h5"), "--track"]) == 2
    assert "--track: the calibration of a log has no EIT" in capsys.readouterr().err
    assert main(["apply", c, log, "-o", str(tmp_path / "f.h5"), "--report", "r.html"]) == 2
    assert "add --track" in capsys.readouterr().err
    assert not Path("r.html").exists()


@pytest.mark.slow
def test_two_contacts_are_followed_from_the_command_line(tmp_path, capsys):
    """Each keeps its number from press to release, and has its place and its force."""
    bench = load_bench("two_contacts")
    few = type(bench)(**{**bench.__dict__, "sites": bench.sites[4:5], "blank": 2.0, "eit_rate": 20.0})
    session = simulate(few, tmp_path / "two.h5", fidelity=je.Fidelity.draft())
    c, out, report = (str(tmp_path / name) for name in ("c.h5", "out.h5", "report.html"))
    assert main(["calibrate", "data/sessions/testbed_grid.h5", "-o", c, "--fidelity", "draft", "--pixels", "20"]) == 0
    assert main(["apply", c, str(session), "-o", out, "--track", "--report", report]) == 0
    assert "contacts: 2 followed" in capsys.readouterr().out
    assert Path(report).read_text().count("<svg") == 2
    archive = read_archive(out, FORCE_MAP_FORMAT)
    assert all(archive.units[TRACKS + name] == about.units for name, about in TRACK_ARRAYS.items())
    rows = by_number({name: archive.arrays[TRACKS + name] for name in TRACK_ARRAYS})
    motion = planned_motion(few)
    assert len(rows) == 2
    for tip, one in enumerate(rows.values()):
        load = loads_at(motion, one["time"] / S).load[:, tip]
        hold = load > 0.99 * load.max()
        assert np.linalg.norm(one["position"][hold] - motion.places[0, tip], axis=1).max() < 3e-3
        np.testing.assert_allclose(one["force"][hold], load[hold], rtol=0.25)
        assert (np.diff(one["time"]) == S // 20).all()


def test_apply_names_its_arrays_as_documented(root):
    text = (root / "docs" / "tracks.md").read_text()
    assert all(name in text.split("tracks/...")[1] for name in TRACK_ARRAYS)
