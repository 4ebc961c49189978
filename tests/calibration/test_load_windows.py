"""What touches the skin over time, by `apply --loads`: windows, shares of the pads' force, and the command line."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

import calib
import jaxeit as je
from calib.bench import load_bench, simulate
from calib.calibration.localisation import load_windows
from calib.calibration.localisation.learned import loads
from calib.calibration.localisation.learned.loads import MAX_PRESSES, MIN_PRESSES, learned_loads, render_loads
from calib.calibration.localisation.load_windows import WindowedFrames
from calib.calibration.localisation.proposals import chosen_proposal
from calib.calibration.press_examples import PressExamples
from calib.cli import main
from jaxeit.imaging import InverseError
from jaxeit.tracking import GainField, LearnedLayer

from ..place_logs import place_log, write_place_log

S = 10**9


def test_windows_hold_touched_frames_of_the_length_asked_for():
    seen = WindowedFrames(1.0, 2)
    time = np.arange(60) * S // 10
    loaded = (time >= 1 * S) & (time < 4.2 * S)
    frames = np.where(loaded[:, None], 5.0, 3.0) + 0.1 * (np.arange(60) % 2)[:, None] * [1, -1]
    for part in np.array_split(np.arange(60), 7):
        seen.add(time[part], frames[part], frames[part] - 3.05, loaded[part], np.full(len(part), 4.0))
    seen.close()
    assert [round((w.end - w.begin) / S, 1) for w in seen.windows] == [0.9, 0.9, 0.9]
    assert [w.frames for w in seen.windows] == [10, 10, 10]
    np.testing.assert_allclose(seen.windows[0].frame, [2.0, 1.9], atol=0.01)
    assert seen.windows[0].force == 4.0
    np.testing.assert_allclose(seen.quiet.untouched, [3.05, 2.95], atol=0.01)
    assert seen.quiet.noise is not None
    assert WindowedFrames(1.0, 2).quiet.noise is None


@pytest.mark.parametrize("seconds", [0, -1.0, np.nan, np.inf, "1", None])
def test_windows_have_a_duration(seconds):
    said = r"loads: windows of .* s; give a duration in s, a finite number above zero"
    with pytest.raises(je.registry.SettingError, match=said):
        WindowedFrames(seconds, 2)


class Asked(Exception):
    """The fit of loads is prepared."""


@pytest.fixture
def asked(calibration, monkeypatch):
    """What loads are fitted with: gain of the layer and settings, for a calibration and settings of the user."""

    def prepare(_, settings, *, gain, **__):
        raise Asked(gain, settings)

    monkeypatch.setattr(je.contacts, "prepare_loads", prepare)
    monkeypatch.setattr(load_windows, "fit_untouched_sheet", lambda *_: (None, ()))
    readings = calibration.recon.readings
    seen, noise = WindowedFrames(0.1, readings), np.random.default_rng(0).normal(size=(60, readings))
    loaded = np.arange(60) >= 40
    seen.add(np.arange(60) * S // 100, noise, noise, loaded, np.where(loaded, 9.0, 0.0))
    seen.close()

    def of(one, settings=None):
        with pytest.raises(Asked) as found:
            load_windows.fit_windows(one, seen, settings=settings)
        return found.value.args

    return of


def test_loads_are_fitted_with_the_layer_that_the_calibration_learned(calibration, asked):
    corners = np.array([[0.0, 0.0], [0.2, 0.2]])
    layer = LearnedLayer.unknown(GainField.on_sheet(corners, corners, je.contacts.LoadSettings(gain_length=0.05), 0.3))
    for known in (layer, None):
        assert asked(replace(calibration, layer=known, probes=None)) == (known, None)


def test_loads_are_fitted_as_the_presses_of_the_calibration_tell(calibration, asked, monkeypatch):
    """Unless the user says what is known of loads."""
    told, own = je.contacts.LoadSettings(texture=0.1), je.contacts.LoadSettings.round_tips()
    monkeypatch.setattr(load_windows, "learned_loads", lambda *_: (told, "told"))
    assert asked(calibration)[1] is told
    assert asked(calibration, own)[1] is own


def presses(count, readings, pads):
    rng = np.random.default_rng(1)
    dv, pressure = rng.normal(size=(count, readings)), np.full((count, pads), 500.0)
    return PressExamples(dv, pressure, rng.uniform(0, 0.2, (count, 2)), rng.uniform(5, 20, count))


def test_whole_presses_of_a_calibration_tell_loads(calibration, model, monkeypatch):
    readings, given = calibration.recon.readings, []
    probes = presses(MAX_PRESSES + 4, readings, 4)
    channels = np.arange(readings) != 5
    probes.dv[0, 5] = np.nan  # of a reading that is not used
    probes.dv[2, 7] = np.nan

    def learn(_, dv, position, force, settings, *, gain, **sheet):
        assert settings.depth == 0.008
        given.append((dv, position, force, gain))
        assert sheet.keys() == {"noise", "channels"}
        return je.contacts.LoadSettings(texture=0.1)

    monkeypatch.setattr(je.contacts, "learn_loads", learn)
    monkeypatch.setattr(loads, "depth_of_loads", lambda *_: 0.008)
    known = {"noise": np.ones(readings), "channels": channels}
    found, line = learned_loads(replace(calibration, probes=probes), model, known)
    assert found.texture == 0.1
    assert line == render_loads(found)
    (dv, position, force, gain), whole = given[0], [0, 1, *range(3, MAX_PRESSES + 1)]
    np.testing.assert_array_equal(position, probes.position[whole])
    np.testing.assert_array_equal(force, probes.force[whole])
    assert dv.shape == (MAX_PRESSES, readings)
    assert gain is calibration.layer
    few = replace(calibration, probes=presses(MIN_PRESSES - 1, readings, 4))
    found, line = learned_loads(few, model, known)
    assert found is None
    assert f"as {MIN_PRESSES - 1} presses of the calibration lack no reading, and {MIN_PRESSES} are needed" in line
    found, line = learned_loads(replace(calibration, probes=None), model, known)
    assert found is None
    assert "kept no presses" in line
    assert len(given) == 1


def test_presses_whose_fits_do_not_converge_tell_nothing(calibration, model, monkeypatch):
    def learn(*_, **__):
        raise InverseError("no fit converges")

    monkeypatch.setattr(je.contacts, "learn_loads", learn)
    monkeypatch.setattr(loads, "depth_of_loads", lambda *_: 0.008)
    readings = calibration.recon.readings
    probes = replace(calibration, probes=presses(MIN_PRESSES, readings, 4))
    found, line = learned_loads(probes, model, {"channels": np.ones(readings, bool)})
    assert found is None
    assert line == "nothing by the presses of the calibration: no fit converges"


def test_what_was_learned_is_told_in_one_line():
    learned = je.contacts.LoadSettings(law=je.effects.ContactPiezoresistance(1.5, 25e3, 1.1), texture=0.2)
    assert render_loads(learned) == (
        "pressure adds up to 150 % of conductivity, half of that at 25 kPa (exponent 1.10); texture 0.20, "
        "model error 0.5 %"
    )
    forces = je.contacts.ForceLaw(logs=(0.0, 0.0, np.log(1.2)))
    assert (
        "kPa (exponent 1.10), and for the forces told up to 150 % of conductivity, half of that at 25 kPa "
        "(exponent 1.32); texture" in render_loads(replace(learned, forces=forces))
    )


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A press of two contacts at 45 mm, 15 and 10 N, one after the other."""
    bench = load_bench("two_contacts")
    few = type(bench)(**{**bench.__dict__, "sites": bench.sites[:1], "blank": 2.0, "eit_rate": 20.0})
    return simulate(few, tmp_path_factory.mktemp("two") / "two.h5", fidelity=je.Fidelity.draft())


@pytest.mark.slow
def test_two_contacts_are_told_over_time(session, tmp_path, capsys):
    """From the command line: first one, then two, then the other one, each with its share of the force."""
    c, out = str(tmp_path / "c.h5"), tmp_path / "out.h5"
    grid = "data/sessions/testbed_grid.h5"
    assert main(["calibrate", grid, "-o", c, "--fidelity", "draft", "--pixels", "20"]) == 0
    searching = ["apply", c, str(session), "-o", str(out), "--loads", "0.7", "--proposal", "none"]
    assert main(searching) == 0
    assert re.search(r"loads of \d+ windows: .*two \(\d+% probable\)", capsys.readouterr().out)
    arrays = calib.session.read_archive(out, "skin-forcemap").arrays
    middle = arrays["loads/time"].mean(1) / S
    probability, position, force = (arrays[f"loads/{name}"] for name in ("probability", "position", "force"))
    np.testing.assert_allclose(probability.sum(1), 1)
    with calib.open_session(session) as opened:
        known = opened.stream("force")
        reference = np.interp(middle * S, known.time, known.read()[:, 0])
    both = reference > 24
    assert both.any()
    assert (probability[both, 2] > 0.9).all()
    assert np.isnan(position[both, 2:]).all()
    order = np.argsort(position[both, :2, 0], axis=1)
    first = np.take_along_axis(position[both, :2], order[..., None], 1)
    sites = np.array([[0.03, 0.03], [0.075, 0.03]])
    near = np.linalg.norm(first - sites, axis=2).max(1) < 0.004
    assert near.sum() >= 1
    share = np.take_along_axis(force[both, :2], order, 1)[near]
    np.testing.assert_allclose(share, np.tile([15.0, 10.0], (len(share), 1)), rtol=0.25)
    assert np.isnan(arrays["loads/distance"]).all()
    assert main([*searching[:-2], "--round-tips"]) == 0
    of_round = calib.session.read_archive(out, "skin-forcemap")
    assert "nearest = 0.008" in of_round.attrs["load_settings"]
    of_round = of_round.arrays
    assert np.isnan(of_round["loads/distance"]).all()  # no network, which was trained on tips of all shapes
    assert (of_round["loads/probability"][both, 2] > 0.9).all()
    assert not of_round["loads/probability"][:, 3].any()
    assert main([*searching[:-2], "--report", str(tmp_path / "r.html")]) == 0  # the shipped network, by default
    page = (tmp_path / "r.html").read_text()
    assert "What touched the skin" in page
    assert "What presses of the calibration taught the fits: pressure adds up to" in page
    proposed = calib.session.read_archive(out, "skin-forcemap").arrays
    assert (proposed["loads/distance"] < 1).all()
    told = both & (proposed["loads/probability"].argmax(1) == 2)
    assert told.any()
    order = np.argsort(proposed["loads/position"][told, :2, 0], axis=1)
    pair = np.take_along_axis(proposed["loads/position"][told, :2], order[..., None], 1)
    assert np.linalg.norm(pair - sites, axis=2).min(0).max() < 0.004


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--round-tips: it is about fits of loads; add --loads SECONDS"),
        (("--loads", "1", "--proposal", "p.npz"), "trained on tips of all shapes; leave out one of the two"),
    ],
)
def test_what_round_tips_need_is_said_first(options, message, tmp_path, capsys):
    assert main(["apply", "c.h5", "s.h5", "-o", str(tmp_path / "map.h5"), "--round-tips", *options]) == 2
    assert message in capsys.readouterr().err


def test_the_shipped_network_is_chosen_by_the_skin(skin):
    """Whatever its name; where none fits, one line names the command that trains one."""
    lines = []
    renamed = replace(skin, name="mine", toml="")
    found = chosen_proposal(je.contacts.shipped_proposal, renamed, lines.append)
    assert found is not None
    assert found.about["skin"] == "testbed"
    assert chosen_proposal(None, skin, lines.append) is None
    assert lines == []
    other = replace(skin, sheet_resistance=151.0)
    assert chosen_proposal(je.contacts.shipped_proposal, other, lines.append) is None
    assert len(lines) == 1
    assert "jaxeit train SKIN -o PROPOSAL.npz" in lines[0]
    summed = replace(skin.protocol, mixing=scipy.sparse.csr_array(scipy.sparse.eye_array(skin.protocol.readings)))
    assert chosen_proposal(je.contacts.shipped_proposal, replace(skin, protocol=summed), lines.append) is None
    assert "none can be trained for its scan" in lines[1]
    with pytest.raises(InverseError, match="trained for another skin"):
        chosen_proposal(found, other, lines.append)


def test_a_log_has_no_loads(tmp_path, capsys):
    log, c = str(write_place_log(tmp_path / "log.h5", place_log(0))), str(tmp_path / "c.h5")
    assert main(["calibrate", log, "-o", c, "--curve", "affine"]) == 0
    assert main(["apply", c, log, "-o", str(tmp_path / "f.h5"), "--loads", "1"]) == 2
    assert "has no EIT" in capsys.readouterr().err
