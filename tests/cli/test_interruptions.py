"""Every command that writes, ended or failing while it writes: one line, no half-written file, what was there stays."""

import errno
import gc
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from calib.cli import main
from calib.cli.terminal import after_writing
from calib.live.views import presentation
from calib.session import outputs
from tests.record.test_full_disk import SCENE
from tests.record.test_recorder import both, journal

EARLIER = b"an earlier result"


def raised(number):
    """A fault: the signal arrives."""
    return lambda: os.kill(os.getpid(), number)


def failed(number):
    """A fault: the disk refuses."""

    def fail():
        raise OSError(number, os.strerror(number))

    return fail


FAULTS = {
    "SIGTERM": (raised(signal.SIGTERM), 143, "ended by SIGTERM"),
    "SIGHUP": (raised(signal.SIGHUP), 129, "ended by SIGHUP"),
    "SIGINT": (raised(signal.SIGINT), 130, "interrupted"),
    "disk full": (failed(errno.ENOSPC), 2, "No space left on device"),
    "read-only": (failed(errno.EROFS), 2, "Read-only file system"),
}


@pytest.fixture(autouse=True)
def attended():
    """A terminal that hangs up: tests that run under `nohup` inherit that it is ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def calibrated(bundled, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibrated") / "calibration.h5"
    grid = next(path for path in bundled if path.stem == "testbed_grid")
    assert main(["calibrate", str(grid), "-o", str(path), "--pixels", "10"]) == 0
    return path


@pytest.fixture(scope="module")
def commands(bundled, calibrated, tmp_path_factory):
    """Arguments of each command but its output, by the suffix of what it writes."""
    folder = tmp_path_factory.mktemp("inputs")
    grid, presses = (next(path for path in bundled if path.stem == f"testbed_{name}") for name in ("grid", "presses"))
    (folder / "scene.toml").write_text(SCENE)
    table = np.column_stack([np.arange(200) / 100, np.random.default_rng(0).normal(size=(200, 2))])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,f,p", comments="")
    journal(folder / "s.h5.part", both(40))
    columns = ["--time", "t:s", "--stream", "force=f:N", "--stream", "pressure=p:Pa"]
    return {
        "simulate": (["simulate", folder / "scene.toml"], "-o", "session.h5"),
        "import": (["import", "csv", folder / "log.csv", *columns], "-o", "session.h5"),
        "recover": (["recover", folder / "s.h5.part"], "-o", "session.h5"),
        "calibrate": (["calibrate", grid, "--pixels", "10"], "-o", "calibration.h5"),
        "report": (["calibrate", grid, "--pixels", "10", "-o", folder / "c.h5"], "--report", "report.html"),
        "apply": (["apply", calibrated, presses], "-o", "map.h5"),
    }


QUICK = [(name, fault) for name in ("import", "recover") for fault in FAULTS]
LONG = [(name, fault) for name in ("simulate", "calibrate", "apply") for fault in ("SIGTERM", "disk full")]
REPORT = [pytest.param("report", fault, marks=pytest.mark.slow) for fault in ("SIGTERM", "disk full")]


@pytest.mark.parametrize(("name", "fault"), QUICK + LONG + REPORT)
def test_a_command_that_is_cut_short_leaves_what_was_there(name, fault, commands, tmp_path, monkeypatch, capsys):
    cause, status, words = FAULTS[fault]
    arguments, option, output = commands[name]
    arguments = list(map(str, [*arguments, option, tmp_path / output]))
    if name in ("simulate", "import", "recover"):  # these do not replace a file
        before = set()
    else:
        (tmp_path / output).write_bytes(EARLIER)
        before = {output}
    monkeypatch.setattr(outputs, "sync", spoilt(cause, tmp_path))
    assert main(arguments) == status
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("jaxeit: ")
    assert words in told
    assert {path.name for path in tmp_path.iterdir() if not path.is_dir()} == before
    if before:
        assert (tmp_path / output).read_bytes() == EARLIER
    if fault == "SIGTERM" and name != "report":  # the same command works afterwards
        monkeypatch.undo()
        assert main(arguments) == 0
        assert (tmp_path / output).stat().st_size > len(EARLIER)


def test_a_command_under_nohup_outlives_its_terminal(commands, tmp_path, monkeypatch):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    arguments, option, output = commands["import"]
    monkeypatch.setattr(outputs, "sync", spoilt(FAULTS["SIGHUP"][0], tmp_path))
    assert main([*map(str, arguments), option, str(tmp_path / output)]) == 0
    assert (tmp_path / output).is_file()


def spoilt(cause, folder):
    """`outputs.sync` that meets the fault at the first file in ``folder``."""

    def sync(path):
        if path.is_relative_to(folder):
            cause()

    return sync


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_within_a_collection_of_garbage_ends_the_command(number, status, monkeypatch):
    """Python drops what a callback of the collector raises."""

    def interrupted(phase, info):
        gc.callbacks.remove(interrupted)
        os.kill(os.getpid(), number)
        time.sleep(0.01)  # the signal is handled here

    def run(args):
        gc.callbacks.append(interrupted)
        gc.collect(0)
        time.sleep(60)  # cut short
        return 0

    monkeypatch.setattr("calib.cli.commands.skins.doctor_command.run", run)
    assert main(["doctor"]) == status


def test_an_interruption_after_the_output_says_that_it_is_written(monkeypatch, capsys):
    def run(args):
        with after_writing("c.h5"):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)  # cut short

    monkeypatch.setattr("calib.cli.commands.skins.doctor_command.run", run)
    assert main(["doctor"]) == 143
    assert capsys.readouterr().err == "jaxeit: ended by SIGTERM; c.h5 is written\n"


LEAVING = """
import atexit, sys
from calib.cli import __main__, commands
from calib.cli.commands.skins import doctor_command
def run(args):
    atexit.register(print, "taken down")
    print("begun")
    {end}
doctor_command.run = run
sys.argv = ["jaxeit", "doctor"]
__main__.run()
"""


@pytest.mark.parametrize(
    ("end", "status", "taken_down"),
    [("raise KeyboardInterrupt", 130, ""), ("raise ValueError('x')", 2, ""), ("return 0", 0, "taken down\n")],
)
def test_a_command_cut_short_does_not_wait_for_what_still_computes(end, status, taken_down):
    """Python would wait for computations of JAX, and some processes ended by a segmentation fault."""
    ended = subprocess.run([sys.executable, "-c", LEAVING.format(end=end)], stdout=subprocess.PIPE, text=True)
    assert (ended.returncode, ended.stdout) == (status, f"begun\n{taken_down}")


COMPILING = """
import hashlib
from calib.cli.signals import heard_at_once, orderly_end
from calib.record.recorder import StopRequest
heard = heard_at_once(lambda: print("first", flush=True), lambda: print("last", flush=True))
with orderly_end(StopRequest(), planned=False), heard:
    print("begun", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"password", b"salt", 10**9)  # minutes outside of Python, as a compiler takes
"""


def test_signals_are_heard_while_the_main_thread_handles_none():
    with subprocess.Popen([sys.executable, "-c", COMPILING], stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout.readline() == "begun\n"
        for word in ("first\n", "last\n"):
            running.send_signal(signal.SIGINT)
            assert running.stdout.readline() == word
        assert running.wait(20) == 130


@pytest.mark.parametrize("signals", [1, 2])
def test_live_that_compiles_answers_ctrl_c(signals, calibrated, bundled, monkeypatch, capsys):
    presses = next(path for path in bundled if path.stem == "testbed_presses")

    def present(calibration, plan, sources, show, *args, **options):
        for _ in range(signals):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.3)
        assert show.stop.is_set()
        return 0

    monkeypatch.setattr(presentation, "present", present)
    streams = [word for name in ("eit", "pressure") for word in (f"--{name}", f"replay://{presses}")]
    words = ["live", "--calibration", str(calibrated), *streams]
    assert main(words) == (0 if signals == 1 else 130)
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "jaxeit: ends after what is being compiled; Ctrl-C again to end now"
    assert ("jaxeit: interrupted; nothing was written" in told) == (signals == 2)
