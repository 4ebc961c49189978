"""The honest input that lies are made from: a small skin, two recordings and a calibration, made once."""

import json
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je
from calib.bench import simulate
from calib.check import transfer_matrix
from calib.session import open_session, read_archive
from tests.check.honest import sixteen_presses
from tests.check.recording import SECOND, Recording

from .telling import Answer, tell

SHORT = 4  # presses


def small_skin() -> str:
    """The testbed with 16 electrodes instead of 25, as TOML."""
    text = je.load_skin("testbed").toml
    for old, new in (
        ("columns = 5", "columns = 4"),
        ("rows = 5", "rows = 4"),
        ("pitch = 0.04", "pitch = 0.05"),
        ("origin = [0.02, 0.02]", "origin = [0.025, 0.025]"),
        ('name = "testbed"', 'name = "small"'),
    ):
        text = text.replace(old, new)
    return "\n".join(line.split("#")[0].rstrip() for line in text.splitlines() if line.split("#")[0].strip()) + "\n"


def first_presses(recording: Recording, count: int) -> Recording:
    """A recording until the end of so many presses."""
    table = recording.presses
    end = table.t_press[count]
    for name, s in recording.streams.items():
        recording = recording.with_stream(name, replace(s, time=s.time[s.time < end], values=s.values[s.time < end]))
    kept = {
        name: tuple(value[:count]) if isinstance(value := getattr(table, name), tuple) else value[:count]
        for name in table.__dataclass_fields__
    }
    return recording.pressed(**kept)


@dataclass(frozen=True)
class Honest:
    """Files in `folder`: small.toml, s.h5 (16 presses), short.h5 (4 presses), c.h5 (a calibration on s.h5)."""

    folder: Path
    skin: je.Skin
    recording: Recording
    short: Recording

    @classmethod
    def make(cls, folder: Path) -> "Honest":
        """Simulate, cut and calibrate."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "small.toml").write_text(small_skin())
        skin = je.load_skin(folder / "small.toml")
        simulate(sixteen_presses(skin, blank=3.0, pad_rate=50.0), folder / "simulated.h5", fidelity=je.Fidelity.draft())
        with open_session(folder / "simulated.h5") as session:
            whole = Recording.of(session)  # nothing tells that it was simulated
        short = first_presses(whole, SHORT)
        short.write(folder / "short.h5")
        whole.write(folder / "s.h5")
        choices = ("--fidelity", "draft", "--pixels", "10")
        assert tell("calibrate", folder / "s.h5", "-o", folder / "c.h5", *choices).status == 0
        return cls(folder, skin, whole, short)

    @cached_property
    def transfer(self) -> np.ndarray:
        """Transfer matrix of the skin."""
        return transfer_matrix(self.skin)

    @cached_property
    def duration(self) -> float:
        """Length of the recording, s."""
        return float(max(s.time[-1] for s in self.recording.streams.values()) / SECOND)

    @cached_property
    def maps(self) -> dict[str, np.ndarray]:
        """Force maps of the whole recording."""
        return self.force_maps(self.folder / "c.h5", self.folder / "s.h5")[0]

    @cached_property
    def short_maps(self) -> dict[str, np.ndarray]:
        """Force maps of the short recording."""
        return self.force_maps(self.folder / "c.h5", self.folder / "short.h5")[0]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What `evaluate` says of the calibration on the whole recording."""
        return self.evaluated(self.folder / "s.h5")[0]

    def evaluated(self, session: Path) -> tuple[dict[str, Any], Answer]:
        """What `evaluate` says of the calibration on a session, and its answer; no numbers if it refuses."""
        answer = tell("evaluate", self.folder / "c.h5", session, "--json")
        return ({} if answer.refused else next(iter(json.loads(answer.out).values()))), answer

    def force_maps(self, calibration: Path, session: Path) -> tuple[dict[str, np.ndarray], Any]:
        """What `apply` writes and answers; no arrays if it refuses."""
        out = self.folder / f"forces{os.getpid()}.h5"
        out.unlink(missing_ok=True)
        answer = tell("apply", calibration, session, "-o", out)
        return (dict(read_archive(out, "skin-forcemap").arrays) if out.exists() else {}), answer
