"""The main jobs read as walks: the room that leads a job calls each other room once or twice, in one order."""

import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from itertools import islice, pairwise
from types import FrameType

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.application.frame_blocks import FrameBlocks, estimated
from calib.live.engine import Engine
from calib.live.frame_queue import FrameQueue
from calib.live.loop import LiveControl
from calib.live.views.page import Page
from calib.presses.table import resting_levels
from calib.record.plan import StreamPlan
from calib.record.wire.messages import Frame

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


@pytest.fixture(scope="module")
def calibrated(root):
    """A calibration of the bundled session, coarse, and the walk that made it."""
    coarse = {"imaging": je.Imaging(je.Pixels(20)), "fidelity": je.Fidelity.draft()}
    recipe, made = calib.Recipe(location=calib.PadEdge(), **coarse), []

    def job():
        with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as session:
            made.append(calib.calibrate([session], recipe=recipe))

    walk = rooms_called("calibration", job)
    return made[-1], walk


@pytest.mark.slow  # without the check of annotations, which calls properties of its own
def test_a_session_becomes_a_calibration_by_passing_each_room_at_most_twice(calibrated):
    _, walk = calibrated
    steps = ["skin", "presses", "check", "model", "imaging", "fusion", "metrics"]
    assert sorted(steps, key=walk.index) == steps
    assert walk.index("metrics") < len(walk) - 1 - walk[::-1].index("fitting")
    assert max(Counter(walk).values()) <= 2, walk


@pytest.mark.slow
def test_frames_of_a_session_become_forces_by_passing_each_room_at_most_twice(calibrated, root):
    """A block of frames: read, corrected, imaged, located, fused."""
    calibration, _ = calibrated
    with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as session:
        processing = calibration.processing
        blocks = FrameBlocks(session, processing, resting_levels(session, calibration.skin, processing))
        walk = rooms_called("calibration", lambda: next(iter(estimated(calibration, blocks))))
    steps = ["session", "presses", "imaging", "contacts"]
    assert sorted(steps, key=walk.index) == steps
    assert walk[-1] == "fusion"
    assert max(Counter(walk).values()) <= 2, walk


@pytest.mark.slow
def test_a_session_becomes_a_file_of_force_maps_by_passing_each_room_a_few_times(
    calibrated, root, tmp_path, monkeypatch
):
    """Up to the first block. The session is read and its force maps are written by one room, which is thus passed more
    often than the others. Whether pads and image agree is a job of its own, the one that `recalibrate` does."""
    calibration, _ = calibrated
    monkeypatch.setattr("calib.calibration.application.agreement_of_use", lambda found, _: (found, ()))
    monkeypatch.setattr("calib.calibration.application.estimated", lambda *given: islice(estimated(*given), 1))
    with calib.open_session(root / "data" / "sessions" / "testbed_grid.h5") as session:
        walk = rooms_called("calibration", lambda: calib.apply(calibration, session, tmp_path / "map.h5"))
    steps = ["check", "skin", "imaging", "contacts", "fusion", "fitting"]
    assert sorted(steps, key=lambda room: len(walk) - walk[::-1].index(room)) == steps
    counts = Counter(walk)
    assert counts.pop("session") <= 5, walk
    assert max(counts.values()) <= 3, walk


@pytest.mark.slow
def test_a_frame_comes_to_the_page_by_passing_each_room_at_most_twice(calibrated, model):
    """From what two devices send, in counts, to the text that is pushed to the browser; a contact is fitted between."""
    calibration, _ = calibrated
    readings, scale = calibration.recon.readings, 1e-9  # V
    plans = StreamPlan("eit", readings, scale=scale), StreamPlan("pressure", len(calibration.skin.pads))
    near = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1) < 0.01
    volts = [np.asarray(je.forward(model, model.background * jnp.where(near, more, 1.0))) for more in (1.0, 1.5)]
    queue, engine, shown = FrameQueue(*plans), Engine(calibration, rest=0.0), []
    with Page(calibration, LiveControl()) as page:

        def job():
            pressed = bool(shown)
            for number, values in ((1, np.array([0.0, 0.0, 500.0 * pressed, 0.0])), (0, volts[pressed] / scale)):
                queue.put(number, Frame(number, None, None, 32, values), time.monotonic_ns())
            result = engine.step(queue.take(1.0))
            engine.use_spare_time(60.0)
            shown.append(None)
            if result is not None:
                page.show_result(result)
                shown[-1] = json.loads(page.newest(result.number - 1).to_json(image=True))

        job()  # the levels at rest
        walk = rooms_called("live", job)
        job()  # shows the contacts that were fitted after the frame before
    assert shown[-1]["force"][2] > 1
    assert len(shown[-1]["contacts"]) > 0
    assert {"record", "imaging", "calibration"} <= set(walk)
    assert max(Counter(walk).values()) <= 2, walk
