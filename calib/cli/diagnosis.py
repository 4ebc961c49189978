"""Checks of `jaxeit doctor`: each examines one property of this machine, and says ok or what to do.

The checks are independent, so that a broken installation still gets the results of all other checks.
"""

import importlib
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from serial.tools import list_ports

from ..record.priority import refusal

_MIN_FREE_BYTES = 2e9  # an hour of 928 readings at 100 Hz takes 1.4 GB
_MAX_SYNC_TIME = 0.1  # s: the recorder syncs its journal at this interval
_REQUIREMENT = re.compile(r"([A-Za-z0-9_.\-]+)\s*>=\s*([0-9.]+)")


@dataclass(frozen=True)
class DiagnosisLine:
    """One finding: ``remedy`` says what to do, or is empty; a ``note`` does not make the machine unusable."""

    name: str
    text: str
    remedy: str = ""
    note: bool = False

    @property
    def ok(self) -> bool:
        """Whether the machine can be used as it is."""
        return not self.remedy or self.note

    def render(self) -> str:
        """The finding as one line of text, and its remedy as a second line."""
        mark = "ok  " if not self.remedy else "note" if self.note else "BAD "
        return f"{mark}  {self.name}: {self.text}" + (f"\n      -> {self.remedy}" if self.remedy else "")


def examine() -> list[DiagnosisLine]:
    """Run all checks in order and return their findings."""
    return [line for check in _CHECKS for line in _guarded(check)]


def _guarded(check: Callable[[], Iterator[DiagnosisLine]]) -> list[DiagnosisLine]:
    name = check.__name__.strip("_")
    try:
        return list(check())
    except Exception as error:  # a broken installation may raise any error
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return [DiagnosisLine(name, text, _unset(_named_in(str(error))) or "install jaxeit again")]


def _named_in(text: str) -> list[str]:
    """The variables of JAX and XLA that are set and that an error names."""
    return [
        name for name in sorted(os.environ) if name.startswith(("JAX_", "XLA_")) and re.search(rf"\b{name}\b", text)
    ]


def _unset(names: list[str]) -> str:
    """What to do about these variables; empty: there are none."""
    given = " and ".join(f"{name}={os.environ[name]}" for name in names)
    return f"correct or unset {given}" if names else ""


def _python() -> Iterator[DiagnosisLine]:
    text = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    yield DiagnosisLine("python", text, "" if sys.version_info >= (3, 11) else "use Python 3.11 or later")


def _packages() -> Iterator[DiagnosisLine]:
    yield DiagnosisLine("jaxeit", metadata.version("jaxeit"))
    for requirement in metadata.requires("jaxeit") or []:
        found = _REQUIREMENT.match(requirement)
        if found and "extra ==" not in requirement:
            yield _package(found[1], found[2])
    try:
        yield DiagnosisLine("matplotlib", metadata.version("matplotlib"))
    except metadata.PackageNotFoundError:
        yield DiagnosisLine("matplotlib", "not there, needed for --report", "pip install 'jaxeit[report]'", note=True)


def _package(name: str, least: str) -> DiagnosisLine:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return DiagnosisLine(name, "not there", f"pip install '{name}>={least}'")
    old = _numbers(version) < _numbers(least)
    return DiagnosisLine(name, version, f"pip install --upgrade '{name}>={least}'" if old else "")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r"\d+", version)[:3])


def _device() -> Iterator[DiagnosisLine]:
    refused = _refused_flags()
    if refused:
        yield DiagnosisLine("device", refused, _unset(["XLA_FLAGS"]))
        return
    jax = importlib.import_module("jax")
    devices = ", ".join(f"{d.platform} ({d.device_kind})" for d in jax.devices())
    yield DiagnosisLine("device", f"JAX computes on {devices}")
    skin = importlib.import_module("jaxeit").load_skin("testbed")
    yield DiagnosisLine("skins", f"{skin.name} is readable, {skin.protocol.readings} readings")


def _refused_flags() -> str:
    """Why JAX does not begin with the XLA_FLAGS that are set; empty: it does. It ends a process that has wrong ones."""
    if not os.environ.get("XLA_FLAGS"):
        return ""
    begin = [sys.executable, "-c", "import jax; jax.devices()"]
    found = subprocess.run(
        begin, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False
    )
    if "XLA_FLAGS" not in found.stderr or not found.returncode:
        return ""  # what else is wrong, this process can say by itself
    line = next(line for line in found.stderr.splitlines() if "XLA_FLAGS" in line)
    return line.partition("] ")[2] or line


def _threads() -> Iterator[DiagnosisLine]:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield DiagnosisLine("processors", str(count), "" if count > 1 else "recording and live need two", note=True)


def _priority() -> Iterator[DiagnosisLine]:
    refused = refusal()
    found = "refused; only jaxeit live --realtime needs it" if refused else "allowed, for jaxeit live --realtime"
    yield DiagnosisLine("real-time priority", found, refused or "", note=bool(refused))


def _cache() -> Iterator[DiagnosisLine]:
    runtime = importlib.import_module("calib.runtime")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        folder = runtime.cache_folder()
    if folder is None:
        reason = str(caught[-1].message) if caught else "no folder for compiled programs"
        yield DiagnosisLine("cache", reason, "make ~/.cache/jaxeit yours alone: chmod 700 ~/.cache/jaxeit", note=True)
    else:
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        yield DiagnosisLine("cache", f"{folder}, {size / 1e6:.0f} MB")


def _disk() -> Iterator[DiagnosisLine]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    remedy = "" if free > _MIN_FREE_BYTES else "free some space: an hour of 928 readings at 100 Hz takes 1.4 GB"
    yield DiagnosisLine("disk", f"{free / 1e9:.1f} GB free in {here}", remedy)
    if not os.access(here, os.W_OK):
        yield DiagnosisLine("folder", f"{here} cannot be written to", "record into another folder", note=True)
        return
    longest = max(_sync_times(here))
    remedy = (
        "" if longest < _MAX_SYNC_TIME else "record to a local disk: a power cut loses the time of a sync in addition"
    )
    yield DiagnosisLine("sync", f"{1e3 * longest:.1f} ms at most to bring a record to the disk", remedy, note=True)


def _sync_times(folder: Path) -> Iterator[float]:
    with tempfile.TemporaryFile(dir=folder) as file:
        for _ in range(5):
            file.write(bytes(4096))
            file.flush()
            begin = time.monotonic()
            os.fsync(file.fileno())
            yield time.monotonic() - begin


def _ports() -> Iterator[DiagnosisLine]:
    ports = sorted(list_ports.comports())
    if not ports:
        yield DiagnosisLine("serial ports", "none is plugged in")
    for port in ports:
        mine = os.name == "nt" or os.access(port.device, os.R_OK | os.W_OK)
        remedy = "" if mine else "sudo usermod -aG dialout $USER, then log in again"
        yield DiagnosisLine("serial port", f"{port.device} ({port.description})", remedy)


def _network() -> Iterator[DiagnosisLine]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield DiagnosisLine("loopback", f"listens on {server.getsockname()[0]}")


_CHECKS = (_python, _packages, _device, _threads, _priority, _cache, _disk, _ports, _network)
