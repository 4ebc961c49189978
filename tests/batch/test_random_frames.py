"""Frames for training: the same bytes however they are made, and physics that a second computation confirms."""

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from pathlib import Path

import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import pyarrow.dataset
import pyarrow.parquet
import pytest
from scipy.special import ndtr

import calib
import jaxeit as je
from calib.batch import random_frames
from calib.bench import BenchError, Footprint, FrameSet, RandomScenes
from calib.bench.training.random_scenes import MAX_CONTACTS, arrange_tips, draw_contacts
from calib.bench.training.scene_frames import SHARD_FRAMES, SceneFrames
from calib.bench.training.training_frames import ARRAYS
from calib.cli import main

from ..helpers import skin_of
from ..test_docs import run
from .held_pool import Held

FRAMES = SHARD_FRAMES + 200
WORDS = ["--fidelity", "draft", "--pixels", "20", "--seed", "5"]
WIDTH = 0.01  # of the scene's load spreading
SCENE = f"""
format = "jaxeit-scene"
version = 1
title = "frames of random contacts"
skin = "testbed"
seed = 1

[bench]
sites = [[0.1, 0.1]]
forces = [10.0]
eit_rate = 50.0
temperature_rate = 0.01

[[effects]]
type = "LoadSpreading"
width = {WIDTH}

[[effects]]
type = "CoatingNonUniformity"

[[effects]]
type = "ContactPiezoresistance"

[[effects]]
type = "SheetTemperature"

[[effects]]
type = "PadEdgeDip"

[[effects]]
type = "SensorError"
"""


class Here(Executor):
    """Runs what it is given at once; is interrupted before a task of some number."""

    def __init__(self, ends_at=None):
        self.ends_at = ends_at

    def submit(self, call, task):
        if task.number == self.ends_at:
            raise KeyboardInterrupt
        future = Future()
        future.set_result(call(task))
        return future


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.toml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """Frames by the command, in this process: others would import and compile everything anew."""
    path = tmp_path_factory.mktemp("frames") / "here"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(random_frames, "spawned_pool", lambda jobs: Here())
        assert main(["simulate", str(scene), "--random-scenes", str(FRAMES), "-o", str(path), *WORDS]) == 0
    return path


@pytest.fixture(scope="module")
def frames(folder):
    return calib.open_training_frames(folder)


def _bytes(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture
def held(monkeypatch):
    """A pool whose shards are empty files, the pools whose workers were ended, and the writing of five shards."""
    pool, ended = Held(), []
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: pool)
    monkeypatch.setattr(random_frames, "end_workers", ended.append)
    monkeypatch.setattr(random_frames, "make_shard", lambda task: Path(task.folder, f"{task.number}").touch())
    frame_set = FrameSet(calib.load_bench("paper_bench"), 5 * SHARD_FRAMES, fidelity=je.Fidelity.draft())

    told = []

    def tell(frames):
        told.append(frames)
        if len(told) == 1:
            interrupt(frames)

    def write(folder, finishing):
        calib.write_training_frames(frame_set, folder, jobs=2, tell=tell, finishing=finishing)

    return pool, ended, write


def interrupt(number):
    raise KeyboardInterrupt  # as by Ctrl-C


def test_after_an_interruption_shards_that_are_being_made_are_awaited_and_no_other_begins(held, tmp_path):
    pool, ended, write = held
    running = []

    def finishing(count):
        running.append(count)
        pool.finish(1)

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", finishing)
    assert running == [1]
    assert [task.number for _, _, task in pool.given] == [0, 1]
    assert ended == [pool]
    assert sorted(os.listdir(tmp_path / "out")) == ["0", "1", "card.json"]


def test_a_second_interruption_ends_the_workers_and_leaves_no_unfinished_shard(held, tmp_path):
    pool, ended, write = held
    out = tmp_path / "out"
    out.mkdir()
    (out / ".shard-000001.h5.0123456789ab.tmp").touch()  # of the worker that is killed
    with pytest.raises(KeyboardInterrupt):
        write(out, interrupt)
    assert ended == [pool]
    assert sorted(os.listdir(out)) == ["0", "card.json"]


@pytest.mark.slow
def test_ctrl_c_twice_ends_the_command_at_once(scene, tmp_path):
    """The pool waited for ever for workers that it could no longer tell to end."""
    out = tmp_path / "out"
    words = ["simulate", str(scene), "--random-scenes", str(20 * SHARD_FRAMES), "-o", str(out), "--jobs", "2", *WORDS]
    command = [sys.executable, "-m", "calib.cli", *words]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True) as running:
        try:
            assert "frames to write" in running.stderr.readline()
            time.sleep(3)  # until both workers have a task
            os.killpg(running.pid, signal.SIGINT)  # as a terminal does
            assert "finishing 2 shards; Ctrl-C again to stop now" in running.stderr.readline()
            os.killpg(running.pid, signal.SIGINT)
            assert running.wait(30) == 130
            told = running.stderr.read()  # to its end, when no process has it open
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGKILL)
    assert told == f"jaxeit: interrupted; the same command goes on from the shards in {out}\n"
    assert not [name for name in os.listdir(out) if name.endswith(".tmp")]


@pytest.mark.parametrize("found", [False, True])
def test_a_scene_that_is_refused_leaves_no_card_and_no_folder_of_its_own(found, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: Here())
    out = tmp_path / "out"
    if found:
        out.mkdir()
    assert main(["simulate", "ideal", "--random-scenes", "100", "-o", str(out), *WORDS]) == 2
    assert "no effect by which pressure changes the sheet" in capsys.readouterr().err
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == (["out"] if found else [])


@pytest.mark.slow
def test_one_process_after_an_interruption_gives_the_same_bytes(scene, tmp_path, monkeypatch, capsys):
    """As two processes without; after one of the first frames, and after one of frames that were to be added."""
    out, two = tmp_path / "one", tmp_path / "two"
    words = ["simulate", str(scene), "--random-scenes", str(FRAMES), "-o", str(out), *WORDS]
    assert main([*words[:4], "-o", str(two), *WORDS, "--jobs", "2"]) == 0
    capsys.readouterr()
    few = [*words[:3], "128", *words[4:]]
    pool = random_frames.spawned_pool
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: Here(ends_at=0))
    assert main(few) == 130
    assert "the same command goes on from the shards" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["card.json"]
    with pytest.raises(BenchError, match="1 of 1 shards are missing"):
        calib.open_training_frames(out)
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: Here())
    assert main(few) == 0
    assert len(calib.open_training_frames(out)["contacts"]) == 128
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: Here(ends_at=0))
    assert main([*words[:3], "129", *words[4:]]) == 130
    with pytest.raises(BenchError, match=r"shard-000000\.h5: frames are missing; give the command"):
        calib.open_training_frames(out)["contacts"]
    assert main(few) == 2
    assert "holds 129 frames; give as many or more" in capsys.readouterr().err
    (out / "shard-000000.h5").write_bytes((two / "shard-000000.h5").read_bytes()[:-1])  # not whole
    monkeypatch.setattr(random_frames, "spawned_pool", pool)
    assert main(words) == 0
    told = capsys.readouterr()
    assert f"{FRAMES:,} of them now" in told.out
    bound = float(re.search(r"at most ([\d.]+) MB", told.err)[1])
    assert 0.2 * bound < sum(path.stat().st_size for path in out.glob("*.h5")) / 1e6 < bound
    assert _bytes(out) == _bytes(two)
    assert main(words) == 0
    assert "all of them there before" in capsys.readouterr().out


def test_a_folder_of_something_else_is_refused(scene, folder, tmp_path, capsys):
    before = _bytes(folder)
    words = ["simulate", str(scene), "--random-scenes", str(FRAMES), "-o", str(folder)]
    assert main([*words, *WORDS[:-1], "6"]) == 2
    assert "holds frames that differ in seed" in capsys.readouterr().err
    scene.with_name("other.toml").write_text(SCENE.replace(f"width = {WIDTH}", "width = 0.011"))
    assert main([*words[:1], str(scene.with_name("other.toml")), *words[2:], *WORDS]) == 2
    assert "holds frames that differ in scene_toml" in capsys.readouterr().err
    assert _bytes(folder) == before
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*words[:-1], str(tmp_path), *WORDS]) == 2
    assert "holds other files" in capsys.readouterr().err


def _on_rectangle(place, low, high):
    """Share of a Gaussian of the scene's width within rectangles."""
    z = [(edge - place) / WIDTH for edge in (low, high)]
    return np.prod(ndtr(z[1]) - ndtr(z[0]), -1)


def test_maps_pads_and_contacts_tell_of_one_load(frames, skin):
    """By the distribution function of a Gaussian, for frames of tips alone."""
    kinds, force, place = frames["contact_footprint"], frames["contact_force"], frames["contact_place"]
    assert set(np.unique(frames["contacts"])) == {0, 1, 2, 3}
    assert ((kinds > 0).sum(1) == frames["contacts"]).all()
    assert ((force > 0) == (kinds > 0)).all()
    tips = (kinds <= Footprint.TIP).all(1)
    assert tips.sum() > 100
    on_sheet = (force * _on_rectangle(place.astype(float), 0.0, 0.2)).sum(1)
    total = frames["force_map"].sum(1)
    error = (total[tips] - on_sheet[tips]) / np.maximum(on_sheet[tips], 0.5)
    assert np.abs(error).max() < 0.04  # centroids of a coarse mesh, with edges as long as the Gaussian is wide
    assert abs(error.mean()) < 0.005
    corners = np.array([pad.outline for pad in skin.pads])
    each = _on_rectangle(place[:, :, None].astype(float), corners.min(1), corners.max(1))
    on_pads = np.einsum("fc,fcp->fp", force, each)
    np.testing.assert_allclose(frames["pad_forces"][tips], on_pads[tips], atol=0.03 * force.max())
    np.testing.assert_allclose(frames["pad_forces"].sum(1), total, rtol=1e-5, atol=1e-6)  # the pads cover the sheet
    untouched = frames["contacts"] == 0
    assert (frames["force_map"][untouched] == 0).all()


def test_a_frame_is_what_the_scene_says(frames, scene):
    """One frame of the second shard, from the model and the effects by hand."""
    bench = calib.load_bench(scene)
    drawn = np.random.default_rng([5, 1, 1])  # of the skin of that shard, in the order of its effects
    drawn.integers(2**31)
    warmth = drawn.random() * bench.duration * bench.temperature_rate
    seeds = {name: int(drawn.integers(2**31)) for name in ("CoatingNonUniformity", "SensorError")}
    effects = tuple(
        dataclasses.replace(e, seed=jnp.asarray(seeds[type(e).__name__])) if type(e).__name__ in seeds else e
        for e in bench.scene.effects
    )
    model = je.discretise(je.Scene(bench.scene.skin, effects), je.Fidelity.draft())
    part = frames.part(0.5, 1)
    number = int(np.flatnonzero((part["contact_footprint"] == Footprint.EDGE)[:, 0] & (part["contacts"] == 1))[0])
    place, size, angle, force = (
        part[f"contact_{name}"][number, 0].astype(float) for name in ("place", "size", "angle", "force")
    )
    along = size * (np.arange(12) - 5.5) / 6
    tips = place + along[:, None] * [np.cos(angle), np.sin(angle)]
    square = ((np.asarray(model.centroids)[None] - tips[:, None]) ** 2).sum(-1)
    pressure = jnp.asarray(force / 12 * (np.exp(-0.5 * square / WIDTH**2) / (2 * np.pi * WIDTH**2)).sum(0))
    change = je.forward(model, je.conductivity(model, pressure, warmth)) - je.forward(model)
    np.testing.assert_allclose(part["frames"][number], change, atol=1e-6 * float(jnp.abs(change).max()))
    np.testing.assert_allclose(part["untouched"][0], je.forward(model), rtol=1e-9)
    pads = je.pad_response(bench.scene.skin, model) @ pressure
    (sensor,) = je.effects.chosen(effects, je.effects.SensorError)
    offset, span = je.effects.random.own_normal(sensor, sensor.seed, (2, 4), float)
    np.testing.assert_allclose(part["pressures"][number], (1 + sensor.span * span) * pads, atol=1e-6 * pads.max())
    np.testing.assert_allclose(part["untouched_pressures"][0], sensor.offset * offset, rtol=1e-9)


def test_every_shard_is_another_skin_and_batches_hold_each_frame_once(frames, monkeypatch):
    assert len(frames) == FRAMES
    first, second = frames["untouched"]
    assert 0.01 < np.abs(first - second).max() / np.abs(first).max() < 1
    places = np.concatenate([batch for (batch,) in frames.batches(100, "contact_place", seed=3)])
    assert len(places) == 1000 + 200
    rows = {row.tobytes() for row in frames["contact_place"].reshape(FRAMES, -1)}
    assert {row.tobytes() for row in places.reshape(len(places), -1)} <= rows
    x, y = next(frames.part(0.5, 1).batches(200, "frames", "force_map"))
    assert (x == frames["frames"][SHARD_FRAMES:]).all()
    assert y.shape == (200, 400)
    with pytest.raises(BenchError, match="no such array; there are frames"):
        frames["voltage"]
    with pytest.raises(BenchError, match="belongs to a shard"):
        frames.batches(10, "untouched")
    with pytest.raises(BenchError, match="give 1 to 1024"):
        frames.batches(2000, "frames")
    with pytest.raises(BenchError, match="has none of 2 shards"):
        frames.part(0.1, 0.2)
    monkeypatch.setenv("JAXEIT_BUDGET", "1e-4")
    with pytest.raises(BenchError, match=r"force_map: .* bytes at once"):
        frames["force_map"]


def test_the_page_is_true(folder, root, monkeypatch):
    (folder.parent / "frames").symlink_to(folder)
    monkeypatch.chdir(folder.parent)
    page = root / "docs" / "training-frames.md"
    assert run(page, {})["places"].shape == (200, 3, 2)
    text = page.read_text()
    for name, about in ARRAYS.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}` |"))
        meaning = about.meaning.split(",")[0].split(";")[0]
        assert f"| {', '.join(about.dims)} |" in row
        assert meaning in row


def test_the_card_and_other_programs_read_the_shards(folder):
    card = json.loads((folder / "card.json").read_text())
    with h5py.File(folder / "shard-000001.h5") as shard:
        for name, about in card["arrays"].items():
            assert shard[name].dtype == about["dtype"]
            assert shard[name].attrs["units"].decode() == about["unit"]
            assert [axis[0].name[1:] for axis in shard[name].dims] == about["axes"]
            rows = [200 if axis == "frame" else size for axis, size in zip(about["axes"], about["shape"], strict=True)]
            assert list(shard[name].shape) == rows
        assert shard["frame"][0] == SHARD_FRAMES
    assert card["frames"] == FRAMES
    assert "[[effects]]" in card["scene_toml"]


def test_footprints_are_what_they_stand_for(skin):
    contacts = draw_contacts(RandomScenes(), skin.domain, 4000, np.random.default_rng(0))
    assert skin.domain.contains(contacts.place.reshape(-1, 2)).all()
    np.testing.assert_allclose(np.bincount(contacts.number) / 4000, RandomScenes().counts, atol=0.03)
    forces = contacts.force[contacts.number == MAX_CONTACTS]
    assert abs(np.median(forces) / np.sqrt(0.5 * 30) - 1) < 0.1
    tips = arrange_tips(contacts)
    for frame in range(200):
        assert abs(tips.share[frame].sum() - max(contacts.number[frame], 1)) < 1e-12
        for number in range(contacts.number[frame]):
            offset = (tips.place[frame] - contacts.place[frame, number])[tips.contact[frame] == number]
            count = 12 // contacts.number[frame]
            assert len(offset) == count
            assert np.abs(offset.mean(0)).max() < 1e-12
            share = {1: 0, 2: 0.5, 3: 1, 4: (1 - 1 / count**2) / 3}[int(contacts.footprint[frame, number])]
            assert abs((offset**2).sum(1).mean() - share * contacts.size[frame, number] ** 2) < 1e-12


def _small_bench(*more, law=None):
    """A bench with a skin of four electrodes and no pads."""
    places = np.array([[0.02, 0.02], [0.08, 0.02], [0.08, 0.08], [0.02, 0.08]])
    electrodes = [je.PointElectrode(tuple(place)) for place in places]
    skin = skin_of(je.Rectangle(0.1, 0.1), electrodes, [[0, 1, 2, 3], [1, 2, 3, 0]])
    law = je.effects.ContactPiezoresistance() if law is None else law
    scene = je.Scene(skin, (je.effects.LoadSpreading(), law, *more))
    return calib.bench.Bench(scene, np.zeros((1, 2)) + 0.05, np.array([5.0]))


def test_a_skin_without_pads(tmp_path):
    frame_set = FrameSet(_small_bench(), 100, je.Fidelity.draft(), je.Pixels(8))
    calib.write_training_frames(frame_set, tmp_path / "out", executor=Here())
    found = calib.open_training_frames(tmp_path / "out")
    assert "pad_forces" not in found.card["arrays"]
    assert found["frames"].shape == (100, 2)


def test_numbers_that_are_not_finite_do_not_travel():
    refused = jnp.array(jnp.inf), jnp.array(jnp.inf)  # when an effect is made
    law = eqx.tree_at(lambda law: (law.half_pressure, law.amplitude), je.effects.ContactPiezoresistance(), refused)
    made = SceneFrames(_small_bench(law=law), je.Fidelity.draft(), je.Pixels(8, 8), RandomScenes())
    with pytest.raises(BenchError, match="shard 3: frames, untouched are not finite"):
        made.simulate(3, 0, 10)


def test_what_remembers_sees_a_press_of_its_own_and_noise_runs_through_the_shard():
    """With hysteresis, a load that has fallen is felt more than one that has risen."""
    more, made = (je.effects.Hysteresis(), je.effects.BaselineDrift(rate=1e-3)), {}
    for name, peak in (("risen", (1.0, 1.0)), ("fallen", (2.0, 2.0))):
        scenes = RandomScenes(counts=(0.2, 0.8, 0, 0), peak=peak)
        frames = SceneFrames(_small_bench(*more), je.Fidelity.draft(), je.Pixels(8, 8), scenes)
        made[name] = frames.simulate(0, 1, 1024)
    risen, fallen = made["risen"], made["fallen"]
    np.testing.assert_array_equal(risen["force_map"], fallen["force_map"])
    idle = risen["contacts"] == 0
    np.testing.assert_array_equal(risen["frames"][idle], fallen["frames"][idle])
    drift = risen["frames"][idle] / risen["untouched"]  # a random walk since the untouched skin, whose mean is at 64
    expected = 1e-3 * np.sqrt((64 + np.flatnonzero(idle)) / 180)
    assert 0.3 < np.sqrt(np.mean(drift**2) / np.mean(expected**2)) < 2
    differ = (risen["frames"] != fallen["frames"]).any(1)
    assert 0.4 < differ[~idle].mean() < 0.6  # half of the frames have a peak
    strong = differ & (risen["force_map"].sum(1) > 5)
    change = np.abs(fallen["frames"] - risen["frames"])[strong].max(1) / np.abs(risen["frames"])[strong].max(1)
    assert 0.01 < np.median(change) < 0.1  # hysteresis of a tenth of the load, before a law that saturates


def test_what_cannot_be_simulated_is_refused(scene, tmp_path, capsys):
    def write(bench, jobs=1, **choices):
        frame_set = FrameSet(bench, 10, je.Fidelity.draft(), **choices)
        return calib.write_training_frames(frame_set, tmp_path / "out", executor=Here(), jobs=jobs)

    bench = calib.load_bench(scene)
    with pytest.raises(BenchError, match="no effect by which pressure changes the sheet"):
        write(calib.load_bench("ideal"))
    dead = je.Scene(bench.scene.skin, (je.effects.LoadSpreading(), je.effects.CoatingNonUniformity()))
    with pytest.raises(BenchError, match="no effect by which pressure changes the sheet"):
        write(dataclasses.replace(bench, scene=dead))
    law = je.effects.ContactPiezoresistance()
    tip = dataclasses.replace(bench, scene=je.Scene(bench.scene.skin, (law,)), tip_diameter=0.005)
    with pytest.raises(BenchError, match=r"of its force at .* on this mesh"):
        SceneFrames(tip, je.Fidelity.draft(), je.Pixels(20, 20), RandomScenes())
    for seed, message in ((-1, "the seed is -1"), (2**63, "give 0 to 2")):
        with pytest.raises(BenchError, match=message):
            write(dataclasses.replace(bench, seed=seed))
    for options, message in (({"jobs": 0}, "0 jobs"), ({"pixels": je.Pixels(2000)}, "coefficients")):
        with pytest.raises(ValueError, match=message):
            write(bench, **options)
    for ranges, message in (({"force": (0.0, 3.0)}, "above zero"), ({"counts": (0.5, 0.1, 0.1, 0.1)}, "sum is 1")):
        with pytest.raises(BenchError, match=message):
            RandomScenes(**ranges)
    for words, message in (
        (["ideal", "--seed", "3", "-o", "s.h5"], "--seed: an option of --random-scenes FRAMES"),
        (["ideal", "--random-scenes", "3", "--serve", "-o", "s"], "make different things"),
        (["ideal", "--random-scenes", "3"], "give either -o"),
    ):
        assert main(["simulate", *words]) == 2
        assert message in capsys.readouterr().err


def test_too_little_disk_is_said_before_the_work(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(random_frames.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 10**6}))
    with pytest.raises(BenchError, match=r"take up to \d+\.\d GB, and 0\.0 GB are free"):
        calib.write_training_frames(FrameSet(calib.load_bench(scene), 10**6), tmp_path / "out")


# --- Parquet ---


@pytest.fixture(scope="module")
def tables(folder):
    out = folder.parent / "tables"
    assert main(["export", "parquet", str(folder), "-o", str(out)]) == 0
    return out


def test_all_arrays_are_there_as_they_were(folder, tables):
    frames = calib.open_training_frames(folder)
    rows = pyarrow.dataset.dataset(sorted(map(str, tables.glob("shard-*.parquet")))).to_table()
    skins = pyarrow.parquet.read_table(tables / "skins.parquet")
    assert {*rows.column_names, *skins.column_names} == {"shard", *frames.card["arrays"]}
    for name, about in frames.card["arrays"].items():
        column = (rows if about["axes"][0] == "frame" else skins)[name]
        values = column.combine_chunks()
        while hasattr(values, "flatten") and pyarrow.types.is_fixed_size_list(values.type):
            values = values.flatten()
        np.testing.assert_array_equal(values.to_numpy().reshape(frames[name].shape), frames[name])
        assert values.to_numpy().dtype == frames[name].dtype
    np.testing.assert_array_equal(np.bincount(rows["shard"]), [SHARD_FRAMES, FRAMES - SHARD_FRAMES])
    again = calib.open_training_frames(tables)
    for name in ("frames", "untouched", "contacts"):
        np.testing.assert_array_equal(again[name], frames[name])
    field = pyarrow.parquet.read_schema(tables / "shard-000000.parquet").field("contact_place")
    assert field.metadata[b"unit"] == b"m"
    assert json.loads(field.metadata[b"axes"]) == ["frame", "contact", "axis"]


def test_frames_are_written_as_parquet_at_once(scene, tmp_path, monkeypatch, capsys):
    """The arrays of HDF5; the same command goes on, and gives the same bytes again."""
    monkeypatch.setattr(random_frames, "spawned_pool", lambda jobs: Here())
    words = ["simulate", str(scene), "--random-scenes", "96", *WORDS, "-o"]
    assert main([*words, str(tmp_path / "h5")]) == 0
    assert main([*words, str(tmp_path / "tables"), "--format", "parquet"]) == 0
    before = _bytes(tmp_path / "tables")
    assert set(before) == {"card.json", "shard-000000.parquet", "skins.parquet", "SHA256SUMS"}
    expected, found = (calib.open_training_frames(tmp_path / name) for name in ("h5", "tables"))
    for name in expected.card["arrays"]:
        np.testing.assert_array_equal(found[name], expected[name])
        assert found[name].dtype == expected[name].dtype
    (batch,) = found.batches(96, "contact_place")
    np.testing.assert_array_equal(batch[0], expected["contact_place"])
    path = tmp_path / "tables" / "shard-000000.parquet"
    path.write_bytes(before[path.name][:-9])
    with pytest.raises(BenchError, match=r"shard-000000\.parquet: is damaged .* give the command"):
        calib.open_training_frames(tmp_path / "tables")["contacts"]
    assert main([*words, str(tmp_path / "tables"), "--format", "parquet"]) == 0
    assert _bytes(tmp_path / "tables") == before
    capsys.readouterr()
    assert main([*words, str(tmp_path / "tables")]) == 2
    assert "file_format" in capsys.readouterr().err


def test_a_writing_goes_on_and_files_that_are_whole_stay(folder, tables):
    first, second = sorted(tables.glob("shard-*.parquet"))
    kept, lost = first.stat().st_mtime_ns, second.read_bytes()
    second.unlink()
    summary = calib.export_training_frames(folder, tables)
    assert (first.stat().st_mtime_ns, second.read_bytes()) == (kept, lost)
    assert (summary.frames, summary.skins) == (FRAMES, 2)


def test_what_cannot_be_written_is_refused(folder, tables, tmp_path, capsys):
    assert main(["export", "parquet", str(folder), "-o", str(folder)]) == 2
    assert "holds the frames themselves" in capsys.readouterr().err
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BenchError, match=r"holds other files and no card\.json"):
        calib.export_training_frames(folder, tmp_path)
    with pytest.raises(BenchError, match="write frames with jaxeit simulate"):
        calib.export_training_frames(tmp_path, tmp_path / "new")
    assert not (tmp_path / "new").exists()
