"""Import of files of arrays (NumPy, MATLAB, HDF5, Parquet, ROS): what was saved is read, what is damaged is refused."""

import os
import struct
import zipfile
from dataclasses import replace
from datetime import date, time, timedelta
from importlib.util import find_spec
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import io

from calib.cli import main
from calib.session import SessionError, open_session
from calib.session.importers import child
from calib.session.importers.arrays import ArrayFile
from jaxeit.budget import Budget

from ..helpers import REAL_DATA
from .hostile_format import Hostile

TIME = 1.5 + np.arange(6) / 8
FORCE = np.array([1, 2, -3.5, np.nan, 5, 6])
PRESSURE = np.arange(24.0).reshape(6, 4) ** 2
WORDS = ("--time", "t:s", "--stream", "force=f:N", "--stream", "pressure=p:kPa", "--stream", "two=p[2],p[0]:V")


def save_npz(path: Path, **arrays: np.ndarray) -> None:
    np.savez_compressed(path, **arrays)


def save_mat5(path: Path, **arrays: np.ndarray) -> None:
    io.savemat(path, arrays | {"note": "text", "cells": np.array([1, "a"], object)}, do_compression=True)


def save_mat73(path: Path, **arrays: np.ndarray) -> None:
    """As MATLAB does: axes in reverse, vectors of two axes, 512 bytes of its own at the beginning."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = np.atleast_2d(values) if values.ndim == 1 else values.T
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["note"] = np.frombuffer("text".encode("utf-16-le"), np.uint16)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with open(path, "rb+") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def save_hdf5(path: Path, **arrays: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(name, data=values, compression="gzip" if values.ndim else None)
        file["note"] = "text"


def save_parquet(path: Path, **arrays: np.ndarray) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {"note": arrow.array(["text"] * len(TIME))}
    for name, values in arrays.items():
        flat = arrow.array(values.ravel(), from_pandas=True)
        columns[name] = flat if values.ndim == 1 else arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])
    parquet.write_table(arrow.table(columns), path)


SAVED = {
    "npz": ("npz", save_npz),
    "mat 5": ("mat", save_mat5),
    "mat 7.3": ("mat", save_mat73),
    "hdf5": ("hdf5", save_hdf5),
    "parquet": ("parquet", save_parquet),
}


@pytest.fixture
def here(monkeypatch):
    """Read in this process: starting another takes most of the time of a test."""
    monkeypatch.setattr(child, "_asked", child.answer)


@pytest.fixture(params=SAVED)
def saved(request, tmp_path):
    """The name of a format, and a file of it."""
    name, save = SAVED[request.param]
    path = tmp_path / f"log.{name}"
    with open(path, "wb") as stream:  # NumPy adds its own suffix to a name
        stream.close()
        save(path, t=TIME, f=FORCE, p=PRESSURE)
    return name, path


def imported(kind: str, path: Path, *words: str) -> dict[str, np.ndarray]:
    output = path.with_name("s.h5")
    assert main(["import", kind, str(path), *words, "-o", str(output)]) == 0
    with open_session(output) as session:
        times = {f"{name}.time": stream.time for name, stream in session.streams.items()}
        return {name: stream.read() for name, stream in session.streams.items()} | times


def refusal(capsys: pytest.CaptureFixture, kind: str, path: Path, *words: str) -> str:
    """The line that an import ends with; no file is left."""
    output = path.with_name("s.h5")
    before = set(os.listdir(path.parent))
    assert main(["import", kind, str(path), *words, "-o", str(output)]) == 2
    assert set(os.listdir(path.parent)) == before
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_was_saved_is_what_is_read(saved):
    found = imported(*saved, *WORDS)
    np.testing.assert_array_equal(found["force"][:, 0], FORCE)
    np.testing.assert_array_equal(found["pressure"], 1e3 * PRESSURE)
    np.testing.assert_array_equal(found["two"], PRESSURE[:, [2, 0]])
    np.testing.assert_array_equal(found["force.time"], TIME * 1e9)


def test_arrays_of_the_file_are_named_when_one_is_not_there(saved, here, capsys):
    words = [word.replace("force=f", "force=load") for word in WORDS]
    line = refusal(capsys, *saved, *words)
    assert "column 'load': not there; header names: " in line
    assert "p[0]-p[3]" in line
    assert "note" not in line


def test_a_damaged_file_ends_in_one_line(saved, here, capsys):
    kind, path = saved
    raw = path.read_bytes()
    random = np.random.default_rng(0).bytes(5000)
    for damaged in (raw[: len(raw) // 2], raw[:200], b"", b"t,f\n1,2\n" * 99, random):
        path.write_bytes(damaged)
        assert refusal(capsys, kind, path, *WORDS).startswith(f"jaxeit: {path.name}: ")


def test_damage_within_the_numbers_is_found_by_the_checksums(saved, here, capsys):
    kind, path = saved
    raw = bytearray(path.read_bytes())
    middle = len(raw) // 2
    raw[middle : middle + 64] = bytes(255 - byte for byte in raw[middle : middle + 64])
    if kind in ("npz", "parquet") or raw.startswith(b"MATLAB 5"):  # the others have none
        path.write_bytes(raw)
        assert refusal(capsys, kind, path, *WORDS).startswith(f"jaxeit: {path.name}: ")


def test_arrays_of_unequal_length_need_clocks_of_their_own(tmp_path, capsys):
    path = tmp_path / "log.npz"
    np.savez(path, t=TIME, f=FORCE, p=PRESSURE[:4])
    assert "differ: t has 6, p has 4" in refusal(capsys, "npz", path, "--time", "t:s", "--stream", "p=p:kPa")
    more = ("--from", str(path), "--rate", "8", "--start", "1.5", "--stream", "p=p:kPa")
    found = imported("npz", path, "--time", "t:s", "--stream", "force=f:N", *more)
    np.testing.assert_array_equal(found["p.time"], TIME[:4] * 1e9)
    np.testing.assert_array_equal(found["p"], 1e3 * PRESSURE[:4])


# --- NumPy ---------------------------------------------------------------------------------------


def test_one_array_in_a_file_of_its_own_has_columns_by_number(tmp_path):
    path = tmp_path / "log.npy"
    np.save(path, np.column_stack([TIME, FORCE, PRESSURE]))
    found = imported("npz", path, "--time", "0:s", "--stream", "force=1:N", "--stream", "p=2-5:V")
    np.testing.assert_array_equal(found["p"], PRESSURE)


def test_times_of_numpy_count_from_1970(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, t=np.datetime64("2025-01-31T12:00:00.25") + np.arange(6) * np.timedelta64(125, "ms"), f=FORCE)
    found = imported("npz", path, "--time", "t", "--stream", "force=f:N")
    np.testing.assert_allclose(found["force.time"], 250_000_000 + np.arange(6) * 125_000_000, atol=500)
    with open_session(tmp_path / "s.h5") as session:
        assert session.epoch.startswith("2025-01-31T12:00:00")


@pytest.fixture
def kinds(tmp_path):
    """A Parquet file of columns of text, dates, durations, times of the day and dictionaries."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    count = range(len(FORCE))
    columns = {
        "label": arrow.array([f"press {k}" for k in count]),
        "pair": arrow.array([[1.0] * k for k in count]),
        "f": arrow.array(FORCE, from_pandas=True),
        "coded": arrow.array([f"{k % 2}" for k in count]).dictionary_encode(),
        "level": arrow.array([k / 2 for k in count]).dictionary_encode(),
        "day": arrow.array([date(2025, 1, 1 + k) for k in count]),
        "since": arrow.array([timedelta(milliseconds=500 * k) for k in count]),
        "clock": arrow.array([time(0, 0, k) for k in count]),
        "stamp": arrow.array([f"2025-01-31T12:00:0{k}Z" for k in count]),
    }
    parquet.write_table(arrow.table(columns), tmp_path / "log.parquet")
    return tmp_path / "log.parquet"


@pytest.mark.parametrize(
    ("column", "step", "epoch"),
    [("day", 86400, "2025-01-01"), ("stamp", 1, "2025-01-31"), ("since", 0.5, "1970"), ("clock", 1, "1970")],
)
def test_dates_and_durations_of_parquet_are_clocks(column, step, epoch, kinds, here, tmp_path):
    found = imported("parquet", kinds, "--time", column, "--stream", "force=f:N", "--stream", "level=level:V")
    np.testing.assert_array_equal(np.diff(found["force.time"]), step * 1e9)
    np.testing.assert_array_equal(found["level"][:, 0], np.arange(6) / 2)
    with open_session(tmp_path / "s.h5") as session:
        assert session.epoch.startswith(epoch)


@pytest.mark.parametrize(
    ("column", "held"), [("label", "text"), ("coded", "text"), ("pair", "values of the type list<")]
)
def test_columns_that_are_no_numbers_say_what_they_hold(column, held, kinds, here, capsys):
    said = refusal(capsys, "parquet", kinds, "--time", "since", "--stream", f"force={column}:N")
    assert f"column '{column}': holds {held}" in said
    assert "convert it to numbers, or leave it out" in said
    assert f"column '{column}': holds" in refusal(
        capsys, "parquet", kinds, "--time", f"{column}:s", "--stream", "f=f:N"
    )


def test_objects_are_never_loaded(tmp_path, capsys):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "was here"),)

    path = tmp_path / "log.npz"
    np.savez(path, t=TIME, f=np.array([Evil()] * 6, object))
    assert "column 'f': not there" in refusal(capsys, "npz", path, "--time", "t:s", "--stream", "force=f:N")
    path.write_bytes((tmp_path / "log.npz").read_bytes().replace(b"PK", b"\x80\x04"))
    assert "cannot be read" in refusal(capsys, "npz", path, "--time", "t:s", "--stream", "force=f:N")


def npy_claiming(shape: tuple[int, ...]) -> bytes:
    """An array of NumPy whose header claims more than is there."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(80)


@pytest.mark.parametrize(
    ("shape", "said"),
    [((10**12,), "rows, the limit is 20,000,000"), ((1000, 99_999), ""), ((2**40, 2**40), ""), ((-5,), ""), ((7,), "")],
)
def test_arrays_that_claim_more_than_is_there_are_refused(shape, said, tmp_path, capsys):
    path = tmp_path / "log.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("t", "f"):
            archive.writestr(f"{name}.npy", npy_claiming(shape))
    assert said in refusal(capsys, "npz", path, "--time", "t:s", "--stream", "force=f:N")


# --- MATLAB --------------------------------------------------------------------------------------


def test_fields_of_structures_are_columns(here, tmp_path):
    path = tmp_path / "log.mat"
    io.savemat(path, {"run": {"t": TIME[:, None], "deep": {"f": FORCE, "p": PRESSURE}, "who": "me"}})
    words = ("--time", "run.t:s", "--stream", "force=run.deep.f:N", "--stream", "p=run.deep.p[0]-run.deep.p[2]:V")
    found = imported("mat", path, *words)
    np.testing.assert_array_equal(found["force"][:, 0], FORCE)
    np.testing.assert_array_equal(found["p"], PRESSURE[:, :3])


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="the measured data are not here")
def test_the_insole_log_with_pressure_at_a_stated_rate(here, tmp_path):
    path = REAL_DATA / "insole_plenum" / "calibration_dataset.mat"
    linked = tmp_path / "insole.mat"
    linked.symlink_to(path)
    capacitance = (
        "--time",
        "experiment.C[1]:s",
        "--stream",
        "counts=experiment.C[2]-experiment.C[281]:counts",
        "--sort",
    )
    pressure = ("--from", str(linked), "--rate", "50", "--stream", "pressure=experiment.P:bar")
    found = imported("mat", linked, *capacitance, *pressure)
    raw = io.loadmat(path)["experiment"][0, 0]
    np.testing.assert_array_equal(found["pressure"][:, 0], raw["P"][:, 0] * 1e5)
    assert found["counts"].shape[1] == 280
    assert np.isin(found["counts"][:100], raw["C"][:, 2:]).all()


# --- ROS -----------------------------------------------------------------------------------------


@pytest.fixture(params=["mcap", "sqlite3"])
def bag(request, tmp_path):
    """A folder of rosbag2 with a wrench at 100 Hz and four pressures at 50 Hz."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    folder, start = tmp_path / "bag", 1_700_000_000_000_000_000
    plugin = {"mcap": rosbag2.StoragePlugin.MCAP, "sqlite3": rosbag2.StoragePlugin.SQLITE3}[request.param]

    def wrench(number: int, time: int) -> object:
        vector, stamp = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"]
        head = types["std_msgs/msg/Header"](stamp(time // 10**9, time % 10**9 - 1_000_000), "sensor")
        load = types["geometry_msgs/msg/Wrench"](vector(0.0, 1.0, -0.5 * number), vector(0.0, 0.0, 0.0))
        return types["geometry_msgs/msg/WrenchStamped"](head, load)

    def pressures(number: int) -> object:
        layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
        return types["std_msgs/msg/Float64MultiArray"](layout, np.arange(4.0) + number)

    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        names = {"/ft/wrench": "geometry_msgs/msg/WrenchStamped", "/skin": "std_msgs/msg/Float64MultiArray"}
        topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in names.items()}
        for number in range(20):
            time = start + number * 10_000_000 + 5_000_000
            message = wrench(number, time)
            writer.write(topics["/ft/wrench"], time, store.serialize_cdr(message, names["/ft/wrench"]))
            if number % 2 == 0:
                raw = store.serialize_cdr(pressures(number), names["/skin"])
                writer.write(topics["/skin"], time, raw)
    return folder


BAG_WORDS = ("--stream", "force=/ft/wrench.wrench.force.z:N", "--stream", "pressure=/skin.data:kPa")


def test_topics_of_a_rosbag_have_clocks_of_their_own(bag, here):
    found = imported("mcap", bag, *BAG_WORDS)
    np.testing.assert_array_equal(found["force"][:, 0], -0.5 * np.arange(20))
    np.testing.assert_array_equal(found["pressure"], 1e3 * (np.arange(4) + np.arange(0, 20, 2)[:, None]))
    np.testing.assert_allclose(found["force.time"], 5e6 + np.arange(20) * 1e7, atol=500)
    np.testing.assert_allclose(found["pressure.time"], 5e6 + np.arange(10) * 2e7, atol=500)
    found = imported("mcap", bag, "--time", "header.stamp", *BAG_WORDS[:2])
    np.testing.assert_allclose(found["force.time"], 4e6 + np.arange(20) * 1e7, atol=500)


def test_the_files_of_a_rosbag_can_be_read_alone(bag, here, capsys):
    (path,) = [path for path in bag.iterdir() if path.suffix != ".yaml"]
    np.testing.assert_array_equal(imported("mcap", path, *BAG_WORDS)["force"][:, 0], -0.5 * np.arange(20))
    path.with_name("s.h5").unlink()
    both = ("--stream", "force=/ft/wrench.wrench.force.z,/skin.data:N")
    assert "has columns of several topics" in refusal(capsys, "mcap", path, *both)
    said = refusal(capsys, "mcap", path, "--stream", "force=/ft.z:N")
    assert "topic '/ft': not there; topics are /ft/wrench, /skin; " in said
    raw = path.read_bytes()
    path.write_bytes(raw[:100])
    assert "cannot be read" in refusal(capsys, "mcap", path, *BAG_WORDS)


def test_a_folder_without_metadata_names_the_file_in_it(bag, here, capsys):
    (bag / "metadata.yaml").unlink()
    (path,) = bag.iterdir()
    said = refusal(capsys, "mcap", bag, *BAG_WORDS)
    assert said.endswith(f"metadata.yaml: is not in the folder; name the file in it, {path}")
    path.unlink()
    assert refusal(capsys, "mcap", bag, *BAG_WORDS).endswith("is not in the folder; name the folder of a bag")


def test_messages_about_topics(bag, here, capsys):
    (path,) = bag.glob("bag.*")
    if path.suffix != ".mcap":
        pytest.skip("of the file alone")
    assert "topic 'skin': not there; topics are /ft/wrench, /skin; did you mean '/skin'?" in refusal(
        capsys, "mcap", bag, "--stream", "pressure=skin.data:kPa"
    )
    raw = path.read_bytes()
    path.write_bytes(raw[:8])
    assert "file: ends after 8 bytes; the file is damaged" in refusal(capsys, "mcap", path, *BAG_WORDS)
    place = raw.index(b"geometry_msgs/msg/WrenchStamped") - 12  # a byte of the length of the chunk's first record
    path.write_bytes(raw[:place] + b"\xff" + raw[place + 1 :])
    said = refusal(capsys, "mcap", path, *BAG_WORDS)
    assert "topic '/ft/wrench': holds no number that can be read; name another topic, or take another copy" in said


def test_an_empty_topic_is_named(here, tmp_path, capsys):
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        writer.add_connection("/skin", "std_msgs/msg/Float64MultiArray", typestore=store)
    said = refusal(capsys, "mcap", tmp_path / "bag", *BAG_WORDS[2:])
    assert "topic '/skin': holds no message; name another topic, or record again" in said


@pytest.mark.parametrize(("kind", "module"), [("mcap", "rosbags"), ("parquet", "pyarrow")])
def test_a_missing_library_is_named_with_what_installs_it(kind, module, tmp_path, capsys):
    if find_spec(module):
        pytest.skip(f"{module} is installed")
    path = tmp_path / f"log.{kind}"
    path.write_bytes(b"anything")
    words = ("--time", "t:s", "--stream", "force=/f.f:N")
    assert f"needs {module}: pip install 'jaxeit[tables]'" in refusal(capsys, kind, path, *words)


# --- the child process ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "said"), [("memory", "bytes of memory"), ("crash", "ends the process"), ("loop", "takes more than 2 s")]
)
def test_a_library_that_misbehaves_ends_in_one_line(name, said, tmp_path, monkeypatch):
    if name == "loop":
        monkeypatch.setattr(child, "current_budget", lambda: replace(Budget(), child_seconds=2))
    with pytest.raises(SessionError, match=said):
        ArrayFile(Hostile, tmp_path / name)


def test_arrays_of_another_shape_than_was_declared_are_refused(tmp_path):
    with pytest.raises(SessionError, match="has the shape"):
        ArrayFile(Hostile, tmp_path / "lie").read([0, 1], 0, iter)
