"""Many sessions: each its own result, failures named, nothing done twice, nothing lost."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future

import jax
import numpy as np
import pytest

import calib
import calib.batch.sessions as batch
import jaxeit as je
from calib.batch import cluster
from calib.batch.digests import describe
from calib.calibration.logs.procedure import curves_of
from calib.calibration.recipes.text import curve_choice
from calib.cli import main
from calib.runtime import settings, take_over

from ..batch_worker import deadly_pool
from .held_pool import Held


class Here(Executor):
    """Runs what it is given at once; breaks at a task whose session is named so."""

    def __init__(self, breaks_at=""):
        self.breaks_at = breaks_at

    def submit(self, call, task):
        future = Future()
        if self.breaks_at and self.breaks_at in task.session:
            future.set_exception(BrokenExecutor("a worker died"))
        else:
            future.set_result(call(task))
        return future


@pytest.fixture(scope="module")
def made(bundled, tmp_path_factory):
    """A calibration of the bundled session, by a batch of one and of one that fails."""
    out = tmp_path_factory.mktemp("batch")
    recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
    options = {"recipe": recipe}
    return out, batch.calibrate_many(bundled, out, executor=Here(), **options), options


@pytest.fixture
def quick(made, monkeypatch):
    """Calibrations that take no time; the sessions for which one was made."""
    ready, names = calib.load_calibration(made[0] / "testbed_grid.h5"), []

    def calibrate(sessions, skin, *, recipe, ignore_errors):
        names.append(sessions[0].name)
        return ready

    monkeypatch.setattr(batch, "calibrate", calibrate)
    return names


@pytest.fixture
def sessions(bundled, tmp_path):
    folder = tmp_path / "sessions"
    folder.mkdir()
    return [str(shutil.copy(bundled[1], folder / f"s{i}.h5")) for i in range(4)]


def test_a_session_that_fails_is_named_and_the_rest_complete(made, bundled):
    out, outcomes, _ = made
    grid, presses = outcomes
    assert grid.session == str(bundled[0])
    assert grid.reason == ""
    assert not grid.skipped
    assert grid.simulated
    assert presses.reason.startswith("pad 0 (lower left): the curve could not be fitted: too few samples")
    assert presses.summary == {}
    assert sorted(os.listdir(out)) == ["testbed_grid.h5"]
    loaded = calib.load_calibration(out / "testbed_grid.h5")
    assert loaded.evaluation.summary() == grid.summary
    text = batch.render_outcomes(outcomes, "out")
    assert "SIMULATED" in text
    assert "FAILED: pad 0" in text
    assert text.endswith("1 calibrations in out; 1 failed")


def test_what_is_done_is_skipped_until_the_session_or_an_option_changes(quick, sessions, bundled, tmp_path):
    out = tmp_path / "out"

    def again(**options):
        quick.clear()
        told = []
        outcomes = batch.calibrate_many(sessions, out, executor=Here(), tell=told.append, **options)
        assert [o.skipped for o in outcomes] == [f"s{i}.h5" not in quick for i in range(4)]
        assert sorted(o.session for o in told) == sessions
        return len(quick)

    assert again() == 4
    assert again() == 0
    assert again(recipe=calib.Recipe(curve=calib.PowerLaw())) == 4
    assert again(recipe=calib.Recipe(curve=calib.PowerLaw(900.0))) == 4
    assert again(recipe=calib.Recipe(curve=calib.PowerLaw(900.0))) == 0
    shutil.copy(bundled[0], sessions[1])
    assert again(recipe=calib.Recipe(curve=calib.PowerLaw(900.0))) == 1
    (out / "s2.h5").write_bytes((out / "s2.h5").read_bytes()[:5000])
    assert again(recipe=calib.Recipe(curve=calib.PowerLaw(900.0))) == 1


@pytest.mark.slow
def test_a_report_that_is_missing_is_written_and_an_old_one_does_not_stay(quick, sessions, tmp_path):
    out = tmp_path / "out"
    batch.calibrate_many(sessions[:1], out, executor=Here())
    assert not (out / "s0.html").exists()
    (first,) = batch.calibrate_many(sessions[:1], out, executor=Here(), report=True)
    assert not first.skipped
    assert quick == ["s0.h5"]
    assert "Calibration of the skin" in (out / "s0.html").read_text()
    (out / "s0.html").write_text("old")
    batch.calibrate_many(sessions[:1], out, executor=Here(), recipe=calib.Recipe(folds=4))
    assert not (out / "s0.html").exists()


def test_what_a_killed_worker_left_half_made_is_removed_and_only_that(quick, sessions, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    ours = [".s0.h5.0123456789ab.tmp", ".s0_gain.png.0123456789ab.tmp", ".s0.h5.lock"]
    others = [".s0_gain.h5.0123456789ab.tmp", ".s1.html.0123456789ab.tmp", "s0.txt"]
    for name in ours + others:
        (out / name).touch()
    batch.calibrate_many(sessions[:1], out, executor=Here())
    assert sorted(os.listdir(out)) == sorted(["s0.h5", *others])


def test_a_broken_executor_names_what_it_did_not_do(quick, sessions, tmp_path):
    outcomes = batch.calibrate_many(sessions, tmp_path / "out", executor=Here(breaks_at="s2"))
    assert [bool(o.reason) for o in outcomes] == [False, False, True, False]
    assert "worker process died" in outcomes[2].reason


def test_wrong_inputs_are_one_clear_line(sessions, tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(calib.SessionError, match=r"its result would be s0\.h5, as that of"):
        batch.calibrate_many([sessions[0], other / "s0.h5"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(calib.SessionError, match="would take its place"):
        batch.calibrate_many(sessions, tmp_path / "sessions")
    with pytest.raises(calib.SessionError, match="no folder can be made there"):
        batch.calibrate_many(sessions, sessions[0])
    with pytest.raises(TypeError, match="foldz"):
        batch.calibrate_many(sessions, tmp_path / "out", foldz=3)
    monkeypatch.setattr(cluster, "Client", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxeit\[dask\]'"), cluster.dask_executor("tcp://x:1"):
        pass


def test_the_command_of_a_cluster_without_dask_is_one_line(sessions, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cluster, "Client", None)
    words = ["calibrate", *sessions, "-o", str(tmp_path / "out")]
    for more, said in (
        (["--scheduler", "tcp://127.0.0.1:1"], "a Dask scheduler needs dask"),
        (["--jobs", "2", "--test", sessions[0]], "--test is for one calibration"),
        (["--jobs", "2", "--report", "r.html"], "every session gets a page of its own"),
        (["--report"], "give the name of the page"),
    ):
        assert main([*words, *more]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1


def test_equal_options_are_told_alike_and_others_apart():
    told = [
        describe(options)
        for options in (
            {"a": calib.PowerLaw(900.0), "b": None},
            {"b": None, "a": calib.PowerLaw(900.0)},
            {"a": calib.PowerLaw(900.0000001), "b": None},
            {"a": calib.PadEdge(), "b": None},
            {"a": [calib.Linear(), calib.Affine()]},
            {"a": calib.presses.Processing()},
            {"a": calib.presses.Processing(corrections=(calib.presses.LowPass(3.0),))},
        )
    ]
    assert told[0] == told[1]
    assert len(set(told)) == len(told) - 1


def test_a_worker_is_set_up_as_its_parent():
    before = settings()
    changed = before | {"jax_enable_x64": not before["jax_enable_x64"]}
    try:
        take_over(changed)
        assert settings() == changed
    finally:
        take_over(before)
    assert jax.config.jax_enable_x64 == before["jax_enable_x64"]


@pytest.mark.slow
def test_200_sessions_killed_twice(made, bundled, tmp_path, hard):
    """None is done twice, none is lost."""
    folder, out, log = tmp_path / "many", tmp_path / "out", tmp_path / "log"
    folder.mkdir()
    names = [str(shutil.copy(bundled[1], folder / f"s{i:03d}.h5")) for i in range(200)]
    command = [sys.executable, "-m", "tests.batch_worker", str(made[0] / "testbed_grid.h5"), str(log), str(out), *names]
    for most in (60, 140, 200):
        with subprocess.Popen(command, start_new_session=True) as running:
            deadline = time.monotonic() + 300
            while running.poll() is None and (most == 200 or _results(out) < most):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            if most < 200:
                running.send_signal(signal.SIGKILL)  # its workers end by themselves
    saved = log.read_text().split()
    assert len(saved) == len(set(saved))
    assert sorted(os.listdir(out)) == [f"s{i:03d}.h5" for i in range(200)]
    hashes = {calib.load_calibration(out / f"s{i:03d}.h5").provenance["batch"] for i in range(200)}
    assert len(hashes) == 1  # all sessions are copies
    hard("fault 18: a batch of sessions killed", "200 sessions, twice", beyond="none is done twice, none lost")


def _results(out):
    return sum(name.endswith(".h5") for name in os.listdir(out)) if out.exists() else 0


@pytest.mark.slow
def test_the_command_spawns_workers_and_says_what_failed(made, bundled, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["calibrate", *map(str, bundled), "-o", str(out), "--jobs", "2", "--pixels", "20"]
    assert main(words) == 2
    said = capsys.readouterr()
    assert "jaxeit: testbed_presses.h5: pad 0 (lower left)" in said.err
    assert "1 calibrations" in said.out
    assert main([*words, "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert "failed" in told[str(bundled[1])]
    one = calib.load_calibration(out / "testbed_grid.h5")
    assert one.provenance["pixels"] == "20x20"
    np.testing.assert_allclose(told[str(bundled[0])]["force_rmse"], one.evaluation.summary()["force_rmse"])


@pytest.mark.slow
def test_workers_of_dask_do_the_same(bundled, tmp_path):
    """Processes of a cluster: results as by a batch here, a session that fails named, nothing done twice."""
    distributed = pytest.importorskip("distributed")
    names = [str(shutil.copy(bundled[0], tmp_path / f"s{i}.h5")) for i in range(2)] + [str(bundled[1])]
    recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
    options = {"recipe": recipe}
    plan = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1"}
    with (
        distributed.LocalCluster(processes=True, **plan) as workers,
        cluster.dask_executor(workers.scheduler_address) as executor,
    ):
        outcomes = batch.calibrate_many(names, tmp_path / "out", executor=executor, **options)
        again = batch.calibrate_many(names, tmp_path / "out", executor=executor, **options)
    assert [bool(o.reason) for o in outcomes] == [False, False, True]
    assert [o.skipped for o in again] == [True, True, False]
    assert sorted(os.listdir(tmp_path / "out")) == ["s0.h5", "s1.h5"]
    assert outcomes[0].summary == outcomes[1].summary == again[0].summary
    np.testing.assert_allclose(outcomes[0].summary["presses"], 225)


@pytest.mark.slow
def test_a_session_that_kills_its_worker_is_named_and_the_rest_complete(made, bundled, tmp_path, monkeypatch):
    """The pool breaks; who held the lock is tried alone, and named when that breaks too."""
    folder, out = tmp_path / "many", tmp_path / "out"
    folder.mkdir()
    names = [str(shutil.copy(bundled[1], folder / f"{name}.h5")) for name in ("a", "kills", "c", "d")]
    ready = str(made[0] / "testbed_grid.h5")
    monkeypatch.setattr(batch, "spawned_pool", lambda jobs: deadly_pool(jobs, ready))
    outcomes = batch.calibrate_many(names, out, jobs=2)
    assert [bool(o.reason) for o in outcomes] == [False, True, False, False]
    assert "worker process died" in outcomes[1].reason
    assert sorted(os.listdir(out)) == ["a.h5", "c.h5", "d.h5"]


# --- interruptions -------------------------------------------------------------------------------


def test_after_an_interruption_what_runs_ends_and_nothing_begins(quick, sessions, tmp_path, monkeypatch):
    pool, ended = Held(), []
    monkeypatch.setattr(batch, "spawned_pool", lambda jobs: pool)
    monkeypatch.setattr(batch, "end_workers", ended.append)
    told, running = [], []

    def tell(outcome):
        told.append(outcome.session)
        if len(told) == 1:
            raise KeyboardInterrupt  # as by Ctrl-C

    def finishing(count):
        running.append(count)
        pool.finish(1)

    with pytest.raises(KeyboardInterrupt):
        batch.calibrate_many(sessions, tmp_path / "out", jobs=2, tell=tell, finishing=finishing)
    assert running == [1]
    assert told == sessions[:2]
    assert quick == ["s0.h5", "s1.h5"]
    assert len(pool.given) == 2
    assert ended == [pool]
    assert sorted(os.listdir(tmp_path / "out")) == ["s0.h5", "s1.h5"]


def test_a_second_interruption_ends_the_workers_and_leaves_nothing_unfinished(quick, sessions, tmp_path, monkeypatch):
    pool, ended, out = Held(), [], tmp_path / "out"
    monkeypatch.setattr(batch, "spawned_pool", lambda jobs: pool)
    monkeypatch.setattr(batch, "end_workers", ended.append)
    told = []

    def interrupt(what):
        told.append(what)
        raise KeyboardInterrupt

    out.mkdir()
    # Of the worker that is killed, and of another batch, which goes on.
    for name in (".s1.h5.lock", ".s1.h5.0123456789ab.tmp", ".s2.h5.0123456789ab.tmp"):
        (out / name).touch()
    with locked(out / ".s2.h5.lock"), pytest.raises(KeyboardInterrupt):
        batch.calibrate_many(sessions, out, jobs=2, tell=interrupt, finishing=interrupt)
    assert told[1:] == [1]
    assert ended == [pool]
    assert sorted(os.listdir(out)) == [".s2.h5.0123456789ab.tmp", ".s2.h5.lock", "s0.h5"]


@contextlib.contextmanager
def locked(path):
    """The lock file of another process."""
    fcntl = pytest.importorskip("fcntl")
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def test_the_command_says_what_an_interrupted_batch_has_written(quick, sessions, tmp_path, monkeypatch, capsys):
    pool = Held()
    monkeypatch.setattr(batch, "spawned_pool", lambda jobs: pool)
    monkeypatch.setattr(batch, "end_workers", lambda pool: None)
    real = batch.calibrate_many

    def interrupted(*args, tell, finishing, **options):
        def tell_and_interrupt(outcome):
            tell(outcome)
            if outcome.session == sessions[0]:
                raise KeyboardInterrupt

        def finish(running):
            finishing(running)
            pool.finish(1)

        return real(*args, tell=tell_and_interrupt, finishing=finish, **options)

    monkeypatch.setattr(batch, "calibrate_many", interrupted)
    assert main(["calibrate", *sessions, "-o", str(tmp_path / "out"), "--jobs", "2"]) == 130
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "jaxeit: finishing 1 session; Ctrl-C again to stop now",
        f"jaxeit: interrupted; 2 of 4 calibrations are in {tmp_path / 'out'}; the same command goes on",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_ends_a_batch(times, made, sessions, tmp_path):
    """Once: those that run are written; twice: at once, with nothing half-written, and no process stays."""
    gate, out = tmp_path / "gate", tmp_path / "out"
    gate.mkdir()
    command = [sys.executable, "-m", "tests.batch_worker", "held", str(made[0] / "testbed_grid.h5"), str(gate)]
    command += ["calibrate", *sessions, "-o", str(out), "--jobs", "2"]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as running:
        deadline = time.monotonic() + 200
        while len(os.listdir(gate)) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does
        assert "finishing 2 sessions; Ctrl-C again to stop now" in running.stderr.readline()
        if times == 1:
            (gate / "go").touch()
        else:
            os.killpg(running.pid, signal.SIGINT)
        told = running.stderr.read()  # to its end, when no process has it open
        assert running.wait(100) == 130
    assert f"{2 if times == 1 else 0} of 4 calibrations are in {out}; the same command goes on" in told
    assert "Traceback" not in told
    assert sorted(os.listdir(out)) == (["s0.h5", "s1.h5"] if times == 1 else [])
    assert sorted(set(os.listdir(gate)) - {"go"}) == ["s0.h5", "s1.h5"]


# --- logs without EIT ----------------------------------------------------------------------------


@pytest.fixture
def logs(tmp_path):
    """Two logs of force and pressure, and one whose force is missing."""
    folder, paths = tmp_path / "logs", []
    folder.mkdir()
    time = np.arange(0, 20, 0.05)
    force = 5 * (1 - np.cos(time))
    for name, slope in (("a", 200.0), ("b", 300.0), ("silent", 100.0)):
        rows = np.column_stack([time, force, slope * force + np.sin(40 * time)])
        np.savetxt(folder / "log.csv", rows, delimiter=",")
        paths.append(folder / f"{name}.h5")
        stream = "force=1:N" if name != "silent" else "load=1:N"
        words = ["--time", "0:s", "--stream", stream, "--stream", "pressure=2:Pa"]
        assert main(["import", "csv", str(folder / "log.csv"), *words, "-o", str(paths[-1])]) == 0
    return [str(path) for path in paths]


def test_logs_without_eit_get_the_curves_that_they_get_singly(logs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(batch, "_run_in_pools", lambda tasks, jobs, *told: batch._run(Here(), tasks, jobs, *told))
    words = ["calibrate", *logs, "-o", str(tmp_path / "out"), "--jobs", "2", "--json"]
    capsys.readouterr()
    assert main(words) == 2
    said = capsys.readouterr()
    assert "silent.h5: /streams/force: missing" in said.err
    told = json.loads(said.out)
    assert sorted(os.listdir(tmp_path / "out")) == ["a.h5", "b.h5"]
    for path in logs[:2]:
        single = tmp_path / "single.h5"
        assert main(["calibrate", path, "-o", str(single)]) == 0
        kept = tmp_path / "out" / os.path.basename(path)
        ours, theirs = (calib.session.read_archive(one, "log-calibration").arrays for one in (kept, single))
        assert ours.keys() == theirs.keys()
        for name, array in ours.items():
            np.testing.assert_array_equal(array, theirs[name])
        assert told[path]["force_rmse"] == calib.load_calibration(single).evaluation.summary()["force_rmse"]


def test_a_log_is_done_once_and_shown_in_the_table(logs, tmp_path):
    first = batch.calibrate_many(logs[:1], tmp_path / "out", executor=Here(), report=True)
    (again,) = batch.calibrate_many(logs[:1], tmp_path / "out", executor=Here(), report=True)
    assert again.skipped
    assert again.summary == first[0].summary
    (other,) = batch.calibrate_many(
        logs[:1], tmp_path / "out", executor=Here(), recipe=calib.Recipe(curve=calib.Affine())
    )
    assert not other.skipped
    assert sorted(os.listdir(tmp_path / "out")) == ["a.h5"]  # the page of the earlier calibration is gone
    assert "a.h5" in batch.render_outcomes([again], "out")
    assert "      log" in batch.render_outcomes([again], "out")


def test_auto_lets_all_curves_compete_for_a_log():
    recipe = calib.Recipe(curve=curve_choice("auto"))
    assert len(curves_of(recipe)) == len(calib.fitting.CURVES.shipped)
    assert curves_of(calib.Recipe()) == calib.Recipe().curves
