"""The doctor: every line says ok or what to do."""

import os
import subprocess
import sys
import warnings
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from calib.cli import diagnosis as doctor, main
from calib.cli.diagnosis import DiagnosisLine, examine
from calib.record import priority
from calib.record.priority import PriorityError


def found(name):
    return next(line for line in examine() if line.name == name)


def test_every_part_is_named(capsys):
    assert main(["doctor"]) in (0, 2)
    out = capsys.readouterr().out
    for name in (
        "python",
        "jaxeit",
        "jax",
        "numpy",
        "h5py",
        "pyserial",
        "device",
        "processors",
        "cache",
        "disk",
        "loopback",
    ):
        assert f"  {name}: " in out
    assert "ok    python: " in out


def test_an_old_or_missing_package_is_told_how_to_mend(monkeypatch):
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: ["numpy>=999.1", "nonesuch>=1", "x>=1; extra == 'y'"])
    lines = {line.name: line for line in examine()}
    assert lines["numpy"].remedy == "pip install --upgrade 'numpy>=999.1'"
    assert lines["nonesuch"].remedy == "pip install 'nonesuch>=1'"
    assert "x" not in lines
    assert not lines["numpy"].ok


def test_what_breaks_keeps_nothing_else_from_being_told(monkeypatch, capsys):
    def broken(name):
        raise RuntimeError("no such\ndevice")

    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    assert main(["doctor"]) == 2
    out = capsys.readouterr().out
    assert "BAD   device: RuntimeError: no such device" in out
    assert "  loopback: " in out


def test_real_time_priority_is_allowed_or_the_way_to_it_told(monkeypatch):
    def refuse():
        raise PriorityError("add a line")

    monkeypatch.setattr(priority, "real_time", refuse)
    line = found("real-time priority")
    assert line.ok
    assert "add a line" in line.render()
    monkeypatch.setattr(priority, "real_time", nullcontext)
    assert found("real-time priority").remedy == ""


def test_ports_without_permission(monkeypatch):
    port = SimpleNamespace(device="/dev/ttyX9", description="a board")
    monkeypatch.setattr(doctor.list_ports, "comports", lambda: [port])
    assert "dialout" in found("serial port").remedy
    monkeypatch.setattr(doctor.list_ports, "comports", list)
    assert found("serial ports").ok


def test_a_cache_open_to_others(monkeypatch):
    def shared():
        warnings.warn("/x is open to others", stacklevel=1)

    monkeypatch.setattr(doctor.importlib.import_module("calib.runtime"), "cache_folder", shared)
    assert (found("cache").text, found("cache").note) == ("/x is open to others", True)


def test_a_full_disk(monkeypatch):
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    assert not found("disk").ok


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("JAX_ENABLE_X64", "banana", "invalid truth value 'banana'"),
        ("JAX_PLATFORMS", "tpu", "Unable to initialize backend 'tpu'"),
        ("XLA_FLAGS", "--xla_banana=1", "Unknown flag"),
    ],
)
def test_a_variable_with_which_jax_does_not_begin_is_named(name, value, said):
    """The doctor says so, and goes on; XLA ends a process with flags that it does not know."""
    environment = os.environ | {name: value}
    command = [sys.executable, "-m", "calib.cli", "doctor"]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    line, remedy = found.stdout.partition("BAD   device: ")[2].splitlines()[:2]
    assert said in line
    assert remedy == f"      -> correct or unset {name}={value}"
    assert "install jaxeit again" not in found.stdout
    assert "ok    loopback: " in found.stdout


def test_flags_of_xla_that_are_right_are_no_fault(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    assert found("device").ok


def test_without_flags_of_xla_no_process_is_started(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(doctor.subprocess, "run", None)
    assert found("device").ok


def test_a_line_reads_well():
    assert DiagnosisLine("a", "b").render() == "ok    a: b"
    assert DiagnosisLine("a", "b", "c").render() == "BAD   a: b\n      -> c"
    assert DiagnosisLine("a", "b", "c", note=True).render().startswith("note  a")
