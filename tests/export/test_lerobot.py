"""LeRobot datasets hold the numbers of the force maps, as Parquet and, where it is installed, LeRobot read them."""

import io
import json
import re
import sys

import numpy as np
import pytest

import calib
from calib.cli import main
from calib.export import ExportError, export_lerobot
from calib.export.lerobot import dataset as lerobot_dataset, files as lerobot_files
from calib.export.lerobot.dataset import due_times, held_rows
from calib.export.lerobot.stats import FeatureStats, aggregated
from calib.session import ArchiveWriter, SessionError

parquet = pytest.importorskip("pyarrow.parquet")
ROWS, COLUMNS, PADS = 3, 4, ("left arm", "right")
PIXELS = ROWS * COLUMNS
S = 10**9


def force_map(path, times, seed=0, rows=ROWS, columns=COLUMNS, pads=PADS, skin=""):
    """A force map file with frames at these times, ns, and what it holds."""
    rng = np.random.default_rng(seed)
    count = len(times)
    arrays = {
        "time": np.asarray(times),
        "force": rng.normal(1, 1, (count, rows * columns)).astype("f4"),
        "pad_force": rng.normal(5, 2, (count, len(pads))),
        "pad_valid": rng.integers(0, 2, (count, len(pads))).astype("u1"),
    }
    if count > 2:
        arrays["force"][2, :5] = np.nan
        arrays["pad_force"][2, 0] = np.nan
    attrs = {"image_rows": rows, "image_columns": columns, "time_epoch_utc": "2026-01-31T12:00:00Z"}
    attrs |= {"skin": skin} if skin else {}
    with ArchiveWriter(path, "skin-forcemap", attrs) as writer:
        for name, values in arrays.items():
            writer.add(name, values, "1")
        writer.add("pad_names", np.array(pads), "1")
    return arrays


@pytest.fixture
def sources(tmp_path):
    """Two force maps at 20 Hz, the second with late frames, as files and as arrays."""
    even = 5 * S + np.arange(13) * S // 20
    late = even[:9] + np.array([0, 0, 4, 0, 0, 30, 40, 0, 0]) * 10**6
    paths = [tmp_path / name for name in ("a.h5", "b.h5")]
    return paths, [
        force_map(path, times, seed) for seed, (path, times) in enumerate(zip(paths, (even, late), strict=True))
    ]


def held(times, fps):
    """Row of the last frame at or before each due time, one by one."""
    rows, step = [], 0
    while times[0] + step * S // fps <= times[-1]:
        rows.append(max(row for row, at in enumerate(times) if at <= times[0] + step * S // fps))
        step += 1
    return np.array(rows)


def test_a_dataset_is_what_the_force_maps_are(sources, tmp_path):
    paths, arrays = sources
    folder = tmp_path / "set"
    assert main(["export", "lerobot", *map(str, paths), "-o", str(folder), "--task", "press"]) == 0
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 20, 2)
    table = parquet.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert table.column_names == list(info["features"])
    rows = [held(part["time"], 20) for part in arrays]
    assert [len(part) for part in rows] == [13, 9]
    assert info["total_frames"] == table.num_rows == 22
    found = {name: table[name].to_pylist() for name in table.column_names}
    for name, key in (("observation.state", "pad_force"), ("observation.pad_valid", "pad_valid")):
        wanted = np.concatenate([part[key][row] for part, row in zip(arrays, rows, strict=True)])
        np.testing.assert_array_equal(np.array(found[name], "f4"), wanted.astype("f4"))
        assert info["features"][name]["names"] == list(PADS)
    maps = np.concatenate([part["force"][row] for part, row in zip(arrays, rows, strict=True)])
    maps = maps.reshape(-1, ROWS, COLUMNS)[:, ::-1]  # +y upwards
    np.testing.assert_array_equal(np.array(found["observation.force_map"], "f4"), maps)
    np.testing.assert_array_equal(found["frame_index"], [*range(13), *range(9)])
    np.testing.assert_array_equal(found["index"], np.arange(22))
    np.testing.assert_array_equal(found["episode_index"], [0] * 13 + [1] * 9)
    np.testing.assert_allclose(found["timestamp"], np.concatenate([np.arange(13), np.arange(9)]) / 20, rtol=1e-6)
    ages = [(p["time"][0] + np.arange(len(r)) * S // 20 - p["time"][r]) / S for p, r in zip(arrays, rows, strict=True)]
    np.testing.assert_allclose(found["observation.frame_age"], np.concatenate(ages), atol=1e-6)
    assert max(found["observation.frame_age"]) > 0.05  # a frame that was late is held for longer than a step

    feature = info["features"]["observation.images.skin"]
    scale = feature["info"]["newtons_of_255"]
    assert scale == 5.0  # the largest force is between 2 and 5 N
    assert 2 < np.nanmax(maps) < 5
    image = pytest.importorskip("PIL.Image")
    for number in (0, 2, 15):
        seen = np.asarray(image.open(io.BytesIO(found["observation.images.skin"][number]["bytes"])))
        assert seen.shape == tuple(feature["shape"]) == (ROWS, COLUMNS, 3)
        wanted = np.clip(np.nan_to_num(maps[number]) / scale, 0, 1) * 255
        assert np.abs(seen - wanted[..., None]).max() <= 0.5 + 1e-4


def test_metadata(sources, tmp_path):
    paths, arrays = sources
    summary = export_lerobot(paths, tmp_path / "set", task="press", fps=40, full_scale=3.0)
    assert str(summary) == "2 episodes, 42 frames at 40 Hz; white in an image is 3 N on a pixel"
    rows = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(r["episode_index"], r["length"], r["dataset_from_index"], r["dataset_to_index"]) for r in rows] == [
        (0, 25, 0, 25), (1, 17, 25, 42),
    ]  # fmt: skip
    assert [r["tasks"] for r in rows] == [["press"], ["press"]]
    assert {r[name] for r in rows for name in ("data/chunk_index", "data/file_index", "meta/episodes/file_index")} == {
        0
    }
    tasks = parquet.read_table(tmp_path / "set/meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "press"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]

    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    state = np.concatenate([p["pad_force"][held(p["time"], 40)].astype("f4") for p in arrays])
    first = arrays[0]["pad_force"][held(arrays[0]["time"], 40)].astype("f4")
    np.testing.assert_allclose(rows[0]["stats/observation.state/mean"], np.nanmean(first, 0), rtol=1e-6)
    np.testing.assert_allclose(rows[0]["stats/observation.state/std"], np.nanstd(first, 0), rtol=1e-6)
    np.testing.assert_allclose(rows[0]["stats/observation.state/q10"], np.nanquantile(first, 0.1, 0), rtol=1e-6)
    np.testing.assert_allclose(stats["observation.state/max"], np.nanmax(state, 0))
    np.testing.assert_allclose(
        stats["observation.state/mean"], np.nanmean(state, 0), rtol=0.02
    )  # of episodes, as theirs
    assert stats["observation.state/count"] == [42]
    assert np.shape(stats["observation.images.skin/mean"]) == (3, 1, 1)
    assert np.shape(stats["observation.force_map/q99"]) == (ROWS, COLUMNS)
    assert np.shape(stats["timestamp/mean"]) == (1,)
    assert 0 < np.ravel(stats["observation.images.skin/mean"])[0] < 1


def test_many_episodes_are_spread_over_files(sources, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_files, "FILE_MEGABYTES", 0)
    monkeypatch.setattr(lerobot_files, "FILES_PER_CHUNK", 2)
    monkeypatch.setattr(lerobot_dataset, "BLOCK", 4)
    export_lerobot([*sources[0], sources[0][0]], tmp_path / "set")
    found = sorted(str(path.relative_to(tmp_path / "set")) for path in (tmp_path / "set/data").rglob("*.parquet"))
    names = ["data/chunk-000/file-000.parquet", "data/chunk-000/file-001.parquet", "data/chunk-001/file-000.parquet"]
    assert found == names
    rows = parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(r["data/chunk_index"], r["data/file_index"]) for r in rows] == [(0, 0), (0, 1), (1, 0)]
    for row, name in zip(rows, names, strict=True):
        index = parquet.read_table(tmp_path / "set" / name)["index"].to_pylist()
        assert index == [*range(row["dataset_from_index"], row["dataset_to_index"])]


@pytest.mark.parametrize("jitter", [0.0, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("rate", [20, 24, 30, 48, 60, 90, 120, 144, 180])
def test_equal_rates_give_one_frame_for_each_force_map(rate, jitter):
    """Session times are rounded to whole ns, and devices are early and late by a part of the period."""
    for seed in range(5):
        late = np.random.default_rng(seed).uniform(-jitter, jitter, 3000)
        times = np.round(7 * S + (np.arange(3000) + late) * S / rate).astype("i8")
        due = due_times(times, rate)
        np.testing.assert_array_equal(held_rows(times, rate, due), np.arange(3000))
        assert 0 <= due.delay <= 2 * jitter * S / rate + 1


def test_a_few_late_force_maps_do_not_move_the_others():
    rng = np.random.default_rng(3)
    times = np.arange(3000) * S / 60 + rng.normal(0, 1e-4, 3000) * S
    late = rng.choice(np.arange(1, 2999), 30, replace=False)
    times[late] += rng.uniform(0.5, 0.9, 30) * S / 60
    times = np.round(times).astype("i8")
    rows = held_rows(times, 60, due_times(times, 60))
    assert len(rows) == 3000
    assert set(np.flatnonzero(rows != np.arange(3000))) <= set(late)


@pytest.mark.parametrize(("rate", "fps"), [(100, 30), (60, 24), (20, 50), (40, 20), (30, 60)])
def test_other_rates_hold_the_last_force_map(rate, fps):
    times = np.round(np.arange(600) * S / rate).astype("i8")
    due = due_times(times, fps)
    exact = [step * rate // fps for step in range(599 * fps // rate + 1)]
    np.testing.assert_array_equal(held_rows(times, fps, due), exact)


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_no_age_is_negative_at_the_default_rate(jitter, tmp_path):
    late = np.random.default_rng(1).uniform(0, jitter, 60)
    arrays = force_map(tmp_path / "m.h5", np.round(5 * S + (np.arange(60) / 48 + late) * S).astype("i8"))
    assert export_lerobot([tmp_path / "m.h5"], tmp_path / "set").frames == 60
    table = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(
        np.array(table["observation.state"].to_pylist(), "f4"), arrays["pad_force"].astype("f4")
    )
    ages = np.array(table["observation.frame_age"].to_pylist())
    assert 0 <= ages.min() <= ages.max() <= jitter + 1e-8


def test_statistics_block_by_block_are_those_of_all_frames():
    values = np.random.default_rng(4).normal(size=(5000, 3))
    values[:, 2] = np.nan
    values[17, 0] = np.nan
    one = FeatureStats(5000)
    for block in np.array_split(values, 7):
        one.add(block)
    found = one.result()
    np.testing.assert_allclose(found["mean"][:2], np.nanmean(values[:, :2], 0), rtol=1e-9)
    np.testing.assert_allclose(found["std"][:2], np.nanstd(values[:, :2], 0), rtol=1e-9)
    np.testing.assert_allclose(found["q90"][:2], np.nanquantile(values[::2, :2], 0.9, 0), rtol=1e-9)
    assert all(part[2] == 0 for name, part in found.items() if name != "count")  # nothing is known of it
    halves = []
    for part in (values[:2000, :2], values[2000:, :2]):
        halves.append(FeatureStats(len(part)))
        halves[-1].add(np.nan_to_num(part))
    both = aggregated([half.result() for half in halves])
    np.testing.assert_allclose(both["std"], np.nan_to_num(values[:, :2]).std(0), rtol=1e-9)
    assert both["count"] == [5000]


def refused(kind, message, folder, *args, **options):
    with pytest.raises(kind, match=message):
        export_lerobot(*args, folder / "set", **options)
    assert not [path for path in folder.iterdir() if "set" in path.name]


def test_what_cannot_be_exported_is_refused(sources, tmp_path, capsys, monkeypatch):
    paths, _ = sources
    refused(ExportError, "no force map", tmp_path, [])
    refused(ExportError, "--fps", tmp_path, paths, fps=0)
    refused(ExportError, "would repeat each force map .* times", tmp_path, paths, fps=1_000_000)
    refused(ExportError, "--full-scale", tmp_path, paths, full_scale=-1.0)
    force_map(tmp_path / "other.h5", [0, S], columns=5)
    named = f"{tmp_path}/other.h5: another skin than that of {tmp_path}/a.h5"
    refused(ExportError, named, tmp_path, [paths[0], tmp_path / "other.h5"])
    force_map(tmp_path / "gaps.h5", [0, 1, 2, 10**6])
    refused(SessionError, "gaps.h5: time: .*long gaps", tmp_path, [tmp_path / "gaps.h5"])
    force_map(tmp_path / "back.h5", [0, 2, 1])
    refused(SessionError, "back.h5: time: is not in order", tmp_path, [tmp_path / "back.h5"])
    with ArchiveWriter(tmp_path / "less.h5", "skin-forcemap", {"image_rows": 1, "image_columns": 1}) as writer:
        writer.add("time", np.zeros(1, int), "1")
    refused(SessionError, "less.h5: force: missing", tmp_path, [tmp_path / "less.h5"])
    (tmp_path / "there").mkdir()
    assert main(["export", "lerobot", str(paths[0]), "-o", str(tmp_path / "there")]) == 2
    assert "exists" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["export", "lerobot", str(paths[0]), "-o", str(tmp_path / "set")]) == 2
    assert "pip install 'jaxeit[tables]'" in capsys.readouterr().err
    assert not [path for path in tmp_path.iterdir() if "set" in path.name]


def test_force_maps_of_two_skins_are_told_apart_by_path_and_skin(tmp_path):
    for folder, skin, columns in (("A", "chest", 4), ("B", "left arm", 5)):
        (tmp_path / folder).mkdir()
        force_map(tmp_path / folder / "fm.h5", [0, S], columns=columns, skin=skin)
    first, second = (tmp_path / folder / "fm.h5" for folder in "AB")
    said = f"{second}: another skin than that of {first} (left arm, image 3 x 5, 2 pads and chest, image 3 x 4, 2 pads)"
    refused(ExportError, re.escape(said), tmp_path, [first, second])


def test_one_frame_and_one_pad(tmp_path):
    force_map(tmp_path / "one.h5", [7], pads=("only",))
    assert calib.export_lerobot([tmp_path / "one.h5"], tmp_path / "set").frames == 1
    table = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert isinstance(table["observation.state"].to_pylist()[0], float)  # as LeRobot has features of one number


def test_lerobot_reads_it(sources, tmp_path):
    module = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    paths, arrays = sources
    export_lerobot(paths, tmp_path / "set", task="press")
    found = module.LeRobotDataset("local/skin", root=tmp_path / "set")
    assert (len(found), found.num_episodes, found.fps) == (22, 2, 20)
    item = found[15]
    assert item["task"] == "press"
    row = held(arrays[1]["time"], 20)[2]
    np.testing.assert_allclose(item["observation.state"], arrays[1]["pad_force"][row].astype("f4"))
    np.testing.assert_array_equal(np.asarray(item["observation.force_map"])[::-1].ravel(), arrays[1]["force"][row])
    assert item["observation.images.skin"].shape == (3, ROWS, COLUMNS)
