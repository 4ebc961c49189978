"""The session file, written with h5py from its published description (data/schema/README.md) alone."""

from dataclasses import asdict
from pathlib import Path
from uuid import UUID

import h5py
import numpy as np

from . import motion
from .session import Session

EPOCH = "2026-03-01T08:00:00Z"
VARIABLES = {"eit": "voltage", "pressure": "pressure", "force": "force", "stage": "position",
             "temperature": "temperature"}  # fmt: skip
CHUNK = 256 * 1024
"""Bytes of a chunk, along time."""


def write(path: Path, session: Session) -> None:
    """Write a finished session; an existing file is replaced."""
    bench = session.bench
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        _attributes(
            file,
            format="skin-session",
            format_version="1.0",
            Conventions="CF-1.11",
            session_id=str(UUID(int=(bench.skin_seed << 32) + bench.seed)),
            title=f"Simulated presses, {bench.places} places",
            created_utc=EPOCH,
            time_epoch_utc=EPOCH,
            creator="tests.oracles.bench",
            license="Apache-2.0",
            complete=np.uint8(1),
            recovered=np.uint8(0),
            simulated=np.uint8(1),
            scene="\n".join(f"{name} = {value!r}" for name, value in asdict(bench.faults).items()),
            seed=np.int64(bench.seed),
        )
        _device(file.create_group("device"), session)
        for name, (rate, unit, samples) in session.streams.items():
            _stream(file.create_group(f"streams/{name}"), name, rate, unit, samples)
        _presses(file.create_group("presses"), session)
        place = _array(file.create_group("truth"), "contact_position", session.presses.places, "m", "where it pressed")
        assert place.shape[1] == 2


def _attributes(group: h5py.Group, **values: str | np.generic) -> None:
    for name, value in values.items():
        group.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value


def _array(group: h5py.Group, name: str, values: np.ndarray, units: str, long_name: str) -> h5py.Dataset:
    row = values.dtype.itemsize * int(np.prod(values.shape[1:]))
    chunks = (max(1, min(len(values), CHUNK // row)), *values.shape[1:])
    data = group.create_dataset(name, data=values, chunks=chunks, compression="gzip", compression_opts=1,
                                shuffle=True, fletcher32=True)  # fmt: skip
    _attributes(data, units=units, long_name=long_name)
    return data


def _device(group: h5py.Group, session: Session) -> None:
    skin = session.skin
    _attributes(group, skin=skin.name, skin_toml=skin.text)
    protocol = group.create_group("eit_protocol")
    _attributes(protocol, current=np.float64(skin.current), frequency=np.float64(0.0))
    _array(protocol, "pattern", skin.pattern.astype(np.int16), "1", "electrodes: drive+, drive-, sense+, sense-")
    offset = skin.reading_time * np.arange(len(skin.pattern))
    _array(protocol, "offset", offset, "s", "when in the scan each reading is taken")


def _stream(group: h5py.Group, name: str, rate: float, unit: str, samples: np.ndarray) -> None:
    _attributes(group, NX_class="NXdata", signal=VARIABLES[name], axes="time", clock="host", transport="simulated",
                nominal_rate_hz=np.float64(rate))  # fmt: skip
    time = np.round(np.arange(len(samples)) * (1e9 / rate)).astype(np.int64)
    _array(group, "time", time, f"nanoseconds since {EPOCH}", "time of the sample")
    kind = np.float32 if name in ("eit", "pressure", "force") else np.float64
    _array(group, VARIABLES[name], samples.astype(kind), unit, f"{name} {VARIABLES[name]}")
    _array(group, "status", np.zeros(len(samples), np.uint16), "1", "status flags")


def _presses(group: h5py.Group, session: Session) -> None:
    presses, pads = session.presses, session.skin.pads
    count = len(presses.forces)
    touch = motion.BLANK + motion.PERIOD * np.arange(count) + motion.REST
    within = (presses.places[:, None] >= pads[:, :2]) & (presses.places[:, None] <= pads[:, 2:])
    for name, values in {"x": presses.places[:, 0], "y": presses.places[:, 1],
                         "tip_diameter": np.full(count, session.bench.faults.tip)}.items():  # fmt: skip
        _array(group, name, values, "m", f"{name} of the tip")
    _array(group, "target_force", presses.forces, "N", "force asked of the stage, pressing is positive")
    held = touch + motion.RAMP
    steps = {"t_press": touch, "t_hold0": held, "t_hold1": held + motion.HOLD,
             "t_release": held + motion.HOLD + motion.RELEASE}  # fmt: skip
    for name, seconds in steps.items():
        _array(group, name, np.round(1e9 * seconds).astype(np.int64), f"nanoseconds since {EPOCH}", name)
    _array(group, "pad", within.all(-1).argmax(1).astype(np.int16), "1", "pad under the tip, -1 unknown")
    _array(group, "accepted", np.ones(count, np.uint8), "1", "1 if the press may be used")
    _array(group, "reason", np.full(count, b"", "S1"), "", "why the press was set aside")
