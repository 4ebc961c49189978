"""The main jobs read as walks: the room that leads a job calls each other room once or twice, in one order."""

import sys
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from types import FrameType

import pytest

import calib
import jaxeit as je

HELPERS = {"budget", "registry", "toml", "files", "array_files", "_compile"}
"""Rooms that serve every step, such as the memory budget; they are no steps of a job."""


def room_of(frame: FrameType) -> str:
    """The room of the code of a frame: ``model`` for ``jaxeit.model.scene``; "" for code of other packages."""
    package, *rooms = frame.f_globals.get("__name__", "").split(".")
    return rooms[0] if package in ("jaxeit", "calib") and rooms else ""


def caller_of(frame: FrameType) -> FrameType | None:
    """The nearest frame of jaxeit or calib above this one; wrappers, such as those of jax.jit, are passed over."""
    above = frame.f_back
    while above is not None and not room_of(above):
        above = above.f_back
    return above


def rooms_called(leader: str, job: Callable[[], object]) -> list[str]:
    """The rooms that the room ``leader`` calls during a job, in order, each run of one room once."""
    called = [leader]

    def note(frame: FrameType, event: str, _: object) -> None:
        room = room_of(frame) if event == "call" else ""
        if room and room != leader and room not in HELPERS:
            above = caller_of(frame)
            if above is not None and room_of(above) == leader:
                called.append(room)

    job()  # compiles, so that the walk has no tracing in it
    sys.setprofile(note)
    try:
        job()
    finally:
        sys.setprofile(None)
    return [after for before, after in pairwise(called) if before != after]


def test_a_scene_becomes_a_model_by_passing_each_room_at_most_twice():
    scene = je.Scene(je.load_skin("testbed"), effects=())
    walk = rooms_called("model", lambda: je.discretise(scene, je.Fidelity.draft()))
    assert {"skin", "meshing", "linalg"} <= set(walk)
    assert max(Counter(walk).values()) <= 2, walk


@pytest.mark.slow  # without the check of annotations, which calls properties of its own
def test_a_session_becomes_a_calibration_by_passing_each_room_at_most_three_times(root):
    recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())

    def job():
        with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as session:
            return calib.calibrate([session], recipe=recipe)

    walk = rooms_called("calibration", job)
    steps = ["skin", "presses", "check", "model", "imaging", "fusion", "metrics"]
    assert sorted(steps, key=walk.index) == steps
    assert walk.index("metrics") < len(walk) - 1 - walk[::-1].index("fitting")
    assert max(Counter(walk).values()) <= 3, walk
