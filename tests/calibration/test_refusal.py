"""What `check` calls an error is not calibrated, evaluated or applied, unless a person says so; then results tell."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from datetime import UTC, datetime

import equinox as eqx
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.batch.sessions import calibrate_many
from calib.bench import Bench, Timing, simulate
from calib.calibration.logs import procedure as logs
from calib.check import RecordingError, accept
from calib.cli import main
from calib.fitting.cross_validation import held_out, selection
from calib.fitting.logs import selection as log_selection
from calib.fitting.response import fold_presses
from calib.fitting.results import FitError, FitResult
from calib.presses.pooled import pool_presses
from calib.report import document as report
from calib.session import SessionFacts, StreamFacts, open_session, read_archive

from ..check.recording import SECOND, Recording, Samples

QUICK = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
FAST = ["--pixels", "20", "--fidelity", "draft"]


@pytest.fixture(scope="module")
def honest(skin, tmp_path_factory):
    """Sixteen presses, as a file would hold them."""
    effects = (je.effects.ContactPiezoresistance(), je.effects.Noise(std=1e-5))
    sites = np.stack(np.meshgrid([0.03, 0.07, 0.12, 0.17], [0.03, 0.07, 0.13, 0.16]), -1).reshape(-1, 2)
    timing = Timing(rest=0.6, ramp=0.4, hold=1.1, release=0.4, recovery=0.6)
    settings = {"timing": timing, "blank": 2.0, "eit_rate": 10.0, "pad_rate": 50.0, "eit_step": 3e-6, "seed": 1}
    bench = Bench(je.Scene(skin, effects), sites, np.array([10.0, 20.0]), **settings, toml="x")
    path = simulate(bench, tmp_path_factory.mktemp("honest") / "s.h5", fidelity=je.Fidelity.draft())
    with open_session(path) as session:
        return Recording.of(session)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("refusal")


@pytest.fixture(scope="module")
def sound(honest, folder):
    return honest.write(folder / "sound.h5")


@pytest.fixture(scope="module")
def reversed_(honest, folder):
    """Each frame comes in reversed order."""
    return honest.change("eit", honest.values("eit")[:, ::-1]).write(folder / "reversed.h5")


@pytest.fixture(scope="module")
def calibration(sound, folder):
    with open_session(sound) as session:
        made = calib.calibrate([session], recipe=QUICK)
    made.save(folder / "calibration.h5")
    return made


REFUSED = {
    "readings in reversed order": (lambda r: r.change("eit", r.values("eit")[:, ::-1]), "order looks wrong"),
    "EIT that never changes": (lambda r: r.change("eit", 0 * r.values("eit") + r.values("eit")[0]), "never change"),
    "places 100 km off": (lambda r: r.pressed(x=r.presses.x + 1e5), "outside the sheet"),
    "pressure columns exchanged": (lambda r: r.change("pressure", r.values("pressure")[:, [1, 0, 2, 3]]), "column 1"),
}


@pytest.mark.parametrize("lie", REFUSED)
def test_calibrate_refuses_what_check_calls_an_error(lie, honest, tmp_path):
    tell, words = REFUSED[lie]
    path = tell(honest).write(tmp_path / "lie.h5")
    with open_session(path) as session, pytest.raises(RecordingError, match=words) as caught:
        calib.calibrate([session], recipe=QUICK)
    assert str(caught.value).startswith("lie.h5: /")
    assert "--force" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_forced_it_is_calibrated_and_says_so(calibration, reversed_, tmp_path, capsys):
    out = str(tmp_path / "c.h5")
    assert main(["calibrate", str(reversed_), "-o", out, *FAST]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "reversed order" in said
    assert main(["calibrate", str(reversed_), "-o", out, "--force", *FAST]) == 0
    assert "note: reversed.h5: error ignored: /streams/eit" in capsys.readouterr().out
    made = calib.load_calibration(out)
    assert "reversed order" in made.provenance["ignored_errors"]
    report.write_report(made, tmp_path / "report.html")
    assert "error ignored: /streams/eit" in (tmp_path / "report.html").read_text()
    assert "ignored_errors" not in calibration.provenance


def test_evaluate_and_apply_refuse_as_well(calibration, reversed_, folder, tmp_path, capsys):
    made, out = str(folder / "calibration.h5"), str(tmp_path / "map.h5")
    for command in (["evaluate", made, str(reversed_)], ["apply", made, str(reversed_), "-o", out]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "reversed order" in said
        assert main([*command, "--force"]) == 0
        capsys.readouterr()
    assert "reversed order" in read_archive(out, "skin-forcemap").attrs["ignored_errors"]


def test_a_session_of_another_skin_is_refused_as_such(skin, sound):
    """Its wires are in order: they look wrong with a skin whose electrodes have another order."""
    other = je.skin.parse_skin(skin.toml.replace('order = "snake"', 'order = "rows"'), "other.toml")
    with open_session(sound) as session:
        accept([session], skin)
        with pytest.raises(
            RecordingError, match=r"/device: the recorded skin differs from .*electrodes\.grid"
        ) as refused:
            accept([session], other)
    assert "use a session of that skin. With it, /streams/eit: " in str(refused.value)


def test_check_asks_whether_a_session_is_of_the_skin_of_its_calibration(calibration, skin, sound, tmp_path, capsys):
    """Not by the skin that the session brings, with which nothing is wrong."""
    other = je.skin.parse_skin(skin.toml.replace('order = "snake"', 'order = "rows"'), "other.toml")
    replace(calibration, skin=other).save(tmp_path / "other.h5")
    words = ["check", str(sound), "--calibration"]
    assert main(["check", str(sound)]) == main([*words, str(sound.parent / "calibration.h5")]) == 0
    assert "Nothing wrong" in capsys.readouterr().out
    assert main([*words, str(tmp_path / "other.h5")]) == 2
    assert "the recorded skin differs from" in capsys.readouterr().out


def test_apply_does_not_mind_the_force(calibration, honest, folder, tmp_path, capsys):
    """A force map is made of frames and pressures; a load cell the wrong way round does not touch it."""
    path = str(honest.change("force", -honest.values("force")).write(tmp_path / "s.h5"))
    made = str(folder / "calibration.h5")
    assert main(["apply", made, path, "-o", str(tmp_path / "map.h5")]) == 0
    assert main(["evaluate", made, path]) == 2
    assert "none of 16 presses can be used: no force; see jaxeit check" in capsys.readouterr().err


@pytest.fixture(scope="module")
def warned(honest, folder):
    """Voltages at ten times the gain, which `check` warns of."""
    return honest.change("eit", 10 * honest.values("eit")).write(folder / "loud.h5")


WARNING = "loud.h5: /streams/eit: the amplitude is"


def test_what_check_warns_of_is_said_once_and_kept_in_the_force_map(calibration, warned, folder, tmp_path, capsys):
    made, out = str(folder / "calibration.h5"), str(tmp_path / "map.h5")
    for command in (["apply", made, str(warned), "-o", out], ["evaluate", made, str(warned)]):
        assert main(command) == 0
        assert capsys.readouterr().out.count(f"note: {WARNING}") == 1
    assert read_archive(out, "skin-forcemap").attrs["warnings"].startswith(WARNING)


def test_what_check_warns_of_is_a_note_of_calibrations_too(calibration, warned, tmp_path, capsys):
    command = ["recalibrate", str(warned.parent / "calibration.h5"), str(warned), "-o", str(tmp_path / "m.h5")]
    main([*command, "--force"])
    assert capsys.readouterr().out.count(WARNING) == 1
    assert not any(note.startswith("sound.h5: /") for note in calibration.notes)
    with open_session(warned) as session:
        notes = calib.calibrate([session], recipe=QUICK).notes
    assert sum(note.startswith(WARNING) for note in notes) == 1


def test_nothing_is_said_of_an_honest_session(calibration, sound, folder, tmp_path, capsys):
    out = str(tmp_path / "map.h5")
    assert main(["apply", str(folder / "calibration.h5"), str(sound), "-o", out]) == 0
    assert "note: sound.h5: /" not in capsys.readouterr().out
    assert "warnings" not in read_archive(out, "skin-forcemap").attrs


class Here(Executor):
    """Works at once, in this process."""

    def submit(self, call, task):
        done = Future()
        done.set_result(call(task))
        return done


@pytest.mark.slow
def test_a_batch_refuses_too(reversed_, sound, tmp_path, calibration):
    paths = [sound, reversed_]
    good, bad = calibrate_many(paths, tmp_path, recipe=QUICK, executor=Here())
    assert good.reason == ""
    assert "reversed order" in bad.reason
    _, forced = calibrate_many(paths, tmp_path, recipe=QUICK, executor=Here(), ignore_errors=True)
    assert forced.reason == ""


# --- nothing at all ------------------------------------------------------------------------------


def emptied(recording, name):
    samples = recording.streams[name]
    return recording.with_stream(name, replace(samples, time=samples.time[:0], values=samples.values[:0]))


@pytest.mark.parametrize("name", ["eit", "pressure", "force"])
@pytest.mark.parametrize("command", ["calibrate", "evaluate", "apply"])
def test_a_stream_without_a_sample_is_one_clear_line(name, command, calibration, honest, folder, tmp_path, capsys):
    path = str(emptied(honest, name).write(tmp_path / "s.h5"))
    out = ["-o", str(tmp_path / "out.h5")]
    made = str(folder / "calibration.h5")
    words = {"calibrate": [path, *out, *FAST], "evaluate": [made, path], "apply": [made, path, *out]}[command]
    needless = command == "apply" and name == "force"
    assert main([command, *words]) == (0 if needless else 2)
    said = capsys.readouterr().err
    assert needless or f"s.h5: /streams/{name}: holds no sample; record again" in said
    assert needless or said.count("\n") == 1


@pytest.mark.parametrize("command", ["calibrate", "evaluate"])
def test_no_press_at_all_is_one_clear_line(command, calibration, honest, folder, tmp_path, capsys):
    none = {n: getattr(honest.presses, n)[:0] for n in honest.presses.__dataclass_fields__}
    path = str(replace(honest, presses=replace(honest.presses, **none)).write(tmp_path / "s.h5"))
    made = str(folder / "calibration.h5")
    words = {"calibrate": [path, "-o", str(tmp_path / "c.h5"), *FAST], "evaluate": [made, path]}[command]
    assert main([command, *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("jaxeit: s.h5: /presses: ")
    assert said.count("\n") == 1


# --- fits that fail ------------------------------------------------------------------------------


def failing(fit, curve):
    """`fit` whose result for one kind of curve is that the solver ran out of steps, with NaN for numbers."""

    def failed(fitted):
        return eqx.tree_at(
            lambda f: (f.result, f.parameters),
            fitted,
            (0 * fitted.result + FitResult.MAX_STEPS, np.nan * fitted.parameters),
        )

    def run(chosen, *args, **kwargs):
        found = fit(chosen, *args, **kwargs)
        if not isinstance(chosen, curve):
            return found
        if isinstance(found, calib.fitting.FittedCurve):
            return failed(found)
        return replace(found, curves=failed(found.curves))

    return run


@pytest.fixture
def curved_log(tmp_path):
    """A log in which the force follows the square root of the pressure."""
    time = np.arange(3000) * (SECOND // 50)
    pressure = 1000 * (1 - np.cos(time / SECOND)) + np.random.default_rng(0).normal(0, 1, len(time))
    force = np.sqrt(np.abs(pressure))
    streams = {
        name: Samples(StreamFacts(name, units=unit, channels=1, rate_hz=50.0), time, values[:, None])
        for name, unit, values in (("force", "N", force), ("pressure", "Pa", pressure))
    }
    facts = SessionFacts(epoch=datetime(2026, 1, 1, tzinfo=UTC))
    return Recording(facts, streams, None).write(tmp_path / "log.h5")


def test_a_log_s_curve_that_does_not_converge_is_neither_chosen_nor_saved(curved_log, monkeypatch):
    curves = [calib.Linear(), calib.Affine(), calib.PowerLaw()]
    with open_session(curved_log) as session:
        assert logs.calibrate_logs([session], calib.Recipe(curve=curves)).curve_name == "power"
        monkeypatch.setattr(log_selection, "fit_curves", failing(log_selection.fit_curves, calib.PowerLaw))
        found = logs.calibrate_logs([session], calib.Recipe(curve=curves))
        assert found.curve_name != "power"
        assert "power not determined" in found.why
        with pytest.raises(
            FitError, match=r"log\.h5: the power curve could not be fitted: the solver ran out of steps"
        ):
            logs.calibrate_logs([session], calib.Recipe(curve=calib.PowerLaw()))


def test_a_pad_s_curve_that_does_not_converge_is_not_chosen(sound, skin, monkeypatch):
    curves = [calib.PowerLaw(), calib.Linear()]
    with open_session(sound) as session:
        data = pool_presses([session], skin).data
        folds = fold_presses(skin, data, None, QUICK.loss, QUICK.folds)
    monkeypatch.setattr(held_out, "fit_pads", failing(held_out.fit_pads, calib.PowerLaw))
    choice = selection.choose(curves, [None], folds)
    assert isinstance(choice.curve, calib.Linear)
    assert "power not determined" in choice.why


def test_a_log_that_check_refuses_is_not_fitted(curved_log, tmp_path, capsys):
    with open_session(curved_log) as session:
        recording = Recording.of(session)
    path = str(recording.change("force", np.nan * recording.values("force")).write(tmp_path / "s.h5"))
    assert main(["calibrate", path, "-o", str(tmp_path / "c.h5")]) == 2
    assert "s.h5: /streams/force: holds no finite value" in capsys.readouterr().err
