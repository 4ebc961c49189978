"""Bags of ROS 2 hold the numbers of the force map and of the session, as two readers that are not ours read them."""

import json
import sys
from dataclasses import replace
from datetime import datetime
from importlib import import_module

import numpy as np
import pytest

import calib
from calib.calibration.application.places_in_space import normals_in_space, pad_centres, points_in_space
from calib.calibration.localisation.contact_tracks import TRACK_ARRAYS
from calib.cli import main
from calib.export.mcap_messages import turn_to
from calib.export.mcap_writer import topic_names
from calib.session import ArchiveWriter, SessionFacts, SessionWriter, Status, StreamFacts
from calib.session.importers import McapImporter, child
from jaxeit.geometry import Cylinder, Sphere

highlevel = pytest.importorskip("rosbags.highlevel")
ROWS, COLUMNS, FRAMES = 3, 4, 5
EPOCH, EPOCH_NS = "2026-01-31T12:00:00Z", 1_769_860_800_000_000_000
PADS = ("left arm", "2: right")
TOPICS = {
    "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
    "/skin/force_map": ("sensor_msgs/msg/Image", FRAMES),
    "/skin/taxels": ("sensor_msgs/msg/PointCloud2", FRAMES),
    "/skin/pad_forces": ("std_msgs/msg/Float64MultiArray", FRAMES),
    "/skin/contacts": ("std_msgs/msg/Float64MultiArray", FRAMES),
    "/skin/tracks": ("std_msgs/msg/Float64MultiArray", FRAMES),
    "/skin/pads/left_arm/wrench": ("geometry_msgs/msg/WrenchStamped", FRAMES),
    "/skin/pads/pad_2_right/wrench": ("geometry_msgs/msg/WrenchStamped", FRAMES),
}


@pytest.fixture(scope="module")
def arrays():
    """A force map on a cylinder, as `calib.apply` writes it: the last pixel is off the sheet, a pad is missing once."""
    rng, pixels = np.random.default_rng(5), ROWS * COLUMNS
    chart = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), -1).reshape(-1, 2) * 0.01 + 0.005
    middles, surface = np.array([[0.01, 0.015], [0.03, 0.015]]), Cylinder(0.05, 0.02)
    areas = np.where(np.arange(pixels) < pixels - 1, 1e-4, 0.0)
    force = rng.normal(size=(FRAMES, pixels)).astype("f4")
    force[3, :6] = np.nan
    pads = {name: rng.normal(size=(FRAMES, 2)) for name in ("pad_force", "pad_force_se", "pad_force_half")}
    pads["pad_force"][3, 0] = np.nan
    times, followed = np.arange(FRAMES) * 55_555_555 + 7, [1, 1, 2, 4]  # frames of the rows of contacts
    tracks = {f"tracks/{name}": rng.normal(size=(4, *about.shape)) for name, about in TRACK_ARRAYS.items()}
    tracks |= {"tracks/time": times[followed], "tracks/number": np.array([1, 2, 1, 3])}
    return {
        "pixel": np.arange(pixels),
        "space": np.arange(3),
        "pad": np.arange(2),
        "areas": areas,
        "points": points_in_space(surface, chart, areas > 0),
        "pad_names": np.array(PADS),
        "pad_points": points_in_space(surface, middles),
        "pad_normals": normals_in_space(surface, middles),
        "time": times,
        "force": force,
        "force_se": np.abs(force),
        **pads,
        "pad_valid": np.ones((FRAMES, 2), "u1"),
        "shape_valid": np.eye(FRAMES, 2).astype("u1"),
        "contact_position": np.where(np.arange(FRAMES)[:, None, None] < 2, np.nan, rng.normal(size=(FRAMES, 1, 2))),
        "contact_force": rng.normal(size=(FRAMES, 1)),
        **tracks,
    }


def force_map(path, arrays, **attrs):
    own = {"image_rows": ROWS, "image_columns": COLUMNS, "time_epoch_utc": EPOCH} | attrs
    with ArchiveWriter(path, "skin-forcemap", own) as writer:
        for name, values in arrays.items():
            writer.add(name, values, "1")
    return path


@pytest.fixture(scope="module")
def bag(arrays, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    assert main(["export", "mcap", str(force_map(folder / "f.h5", arrays)), "-o", str(folder / "bag")]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["bag", "f.h5"]
    return folder / "bag"


def by_rosbags(path):
    """Times and messages by topic, and types by topic."""
    found, kinds = {}, {}
    with highlevel.AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(raw, connection.msgtype)))
            kinds[connection.topic] = connection.msgtype
    return found, kinds


def by_mcap(path):
    """As `by_rosbags`, by the reader of the format's authors."""
    reader, decoder = import_module("mcap.reader"), import_module("mcap_ros2.decoder")
    found, kinds = {}, {}
    with open(path / f"{path.name}.mcap", "rb") as stream:
        reading = reader.make_reader(stream, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, message, decoded in reading.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
            kinds[channel.topic] = schema.name
    return found, kinds


def cloud_of(message):
    types = {7: "<f4"}
    kind = np.dtype([(field.name, types[field.datatype]) for field in message.fields])
    assert [kind.fields[field.name][1] for field in message.fields] == [field.offset for field in message.fields]
    assert message.point_step == kind.itemsize
    assert len(message.data) == message.row_step == message.width * kind.itemsize
    return np.frombuffer(bytes(message.data), kind)


def tracks_of(message):
    contacts, columns = message.layout.dim
    names = columns.label.split()
    assert (names[0], names[8], names[12], len(names)) == ("number", "force_N", "velocity_x_m_s", columns.size)
    return np.reshape(message.data, (contacts.size, columns.size))


@pytest.mark.parametrize("read", [by_rosbags, by_mcap])
def test_a_force_map_is_read_back(bag, arrays, read):
    if read is by_mcap:
        pytest.importorskip("mcap_ros2")
    found, kinds = read(bag)
    assert {topic: (kinds[topic], len(found[topic])) for topic in found} == TOPICS
    times = EPOCH_NS + arrays["time"]
    for topic, messages in found.items():
        if topic != "/tf_static":
            np.testing.assert_array_equal([time for time, _ in messages], times)
        if hasattr(messages[0][1], "header"):
            stamps = [one.header.stamp.sec * 10**9 + one.header.stamp.nanosec for _, one in messages]
            np.testing.assert_array_equal(stamps, times)
    for frame, (_, picture) in enumerate(found["/skin/force_map"]):
        assert (picture.encoding, picture.is_bigendian, picture.header.frame_id) == ("32FC1", 0, "skin")
        assert (picture.height, picture.width, picture.step) == (ROWS, COLUMNS, 4 * COLUMNS)
        shown = np.frombuffer(bytes(picture.data), "<f4").reshape(ROWS, COLUMNS)
        np.testing.assert_array_equal(shown, arrays["force"][frame].reshape(ROWS, COLUMNS)[::-1])
    on = arrays["areas"] > 0
    for frame, (_, message) in enumerate(found["/skin/taxels"]):
        cloud = cloud_of(message)
        assert (message.height, message.is_dense) == (1, False)
        place = np.stack([cloud[axis] for axis in "xyz"], 1)
        np.testing.assert_array_equal(place, arrays["points"][on].astype("f4"))
        np.testing.assert_allclose(np.hypot(place[:, 0], place[:, 2]), 0.05, rtol=1e-6)  # on the cylinder
        np.testing.assert_array_equal(cloud["force"], arrays["force"][frame][on])
        np.testing.assert_array_equal(cloud["force_se"], arrays["force_se"][frame][on])
        np.testing.assert_allclose(cloud["pressure"], arrays["force"][frame][on] / 1e-4, rtol=1e-6)
    for frame, (_, table) in enumerate(found["/skin/pad_forces"]):
        assert [(one.label, one.size, one.stride) for one in table.layout.dim] == [
            ("pad", 2, 10),
            ("force_N standard_error_N half_90_percent_N pressure_valid shape_valid", 5, 5),
        ]
        names = ("pad_force", "pad_force_se", "pad_force_half", "pad_valid", "shape_valid")
        np.testing.assert_array_equal(np.reshape(table.data, (2, 5)), np.stack([arrays[n][frame] for n in names], 1))
    for frame, (_, table) in enumerate(found["/skin/contacts"]):
        assert [(one.label, one.size) for one in table.layout.dim] == [("contact", 1), ("x_m y_m force_N", 3)]
        np.testing.assert_array_equal(table.data[:2], arrays["contact_position"][frame, 0])
        np.testing.assert_array_equal(table.data[2:], arrays["contact_force"][frame])
    rows = [tracks_of(message) for _, message in found["/skin/tracks"]]
    assert [len(one) for one in rows] == [0, 2, 1, 0, 1]
    for name, column in {"number": 0, "position": slice(1, 3), "force": 8, "velocity": slice(12, 14)}.items():
        np.testing.assert_array_equal(np.concatenate(rows)[:, column], arrays[f"tracks/{name}"])
    frames = {one.child_frame_id: one for one in found["/tf_static"][0][1].transforms}
    for pad, name in enumerate(("left_arm", "pad_2_right")):
        messages = [message for _, message in found[f"/skin/pads/{name}/wrench"]]
        np.testing.assert_array_equal([one.wrench.force.z for one in messages], -arrays["pad_force"][:, pad])
        moved = frames[messages[0].header.frame_id]
        assert moved.header.frame_id == "skin"
        place, turn = moved.transform.translation, moved.transform.rotation
        np.testing.assert_array_equal([place.x, place.y, place.z], arrays["pad_points"][pad])
        np.testing.assert_allclose(z_axis(turn.x, turn.y, turn.z, turn.w), arrays["pad_normals"][pad], atol=1e-12)


def z_axis(x, y, z, w):
    """Where the rotation of a unit quaternion takes z: the third column of its matrix."""
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def test_directions_and_normals(skin):
    for normal in np.array([[0, 0, 1.0], [0, 0, -1], [0.6, 0, 0.8], [0, -0.8, -0.6], [1, 0, 0]]):
        np.testing.assert_allclose(z_axis(*turn_to(normal)), normal, atol=1e-12)
    chart = np.random.default_rng(1).uniform(0, 0.1, (20, 2))
    for surface in (Cylinder(0.08, 0.05), Sphere(0.08, (0.05, 0.05))):
        known = surface.project(surface(chart)).normal
        np.testing.assert_allclose(normals_in_space(surface, chart), known, atol=1e-7)
    np.testing.assert_array_equal(normals_in_space(None, chart), np.tile([0.0, 0.0, 1.0], (20, 1)))
    triangle = replace(skin.pads[0], outline=np.array([[0.01, 0.01], [0.04, 0.01], [0.01, 0.04]]))
    np.testing.assert_allclose(pad_centres(replace(skin, pads=(triangle,))), [[0.02, 0.02]])


def test_a_session_comes_back_by_import(tmp_path):
    """Values exactly, times to half a microsecond, flags as messages of the flagged samples."""
    rng, path = np.random.default_rng(2), tmp_path / "session.h5"
    kinds = {"eit": ("voltage", "V", 5, 40), "pressure": ("pressure", "Pa", 2, 97), "force": ("force", "N", 1, 60)}
    values = {name: rng.normal(size=(count, channels)) for name, (_, _, channels, count) in kinds.items()}
    values["pressure"][11, 1] = np.nan
    with SessionWriter(path, SessionFacts(epoch=datetime.fromisoformat(EPOCH))) as writer:
        for name, (variable, unit, channels, count) in kinds.items():
            writer.add_stream(name, StreamFacts(variable, unit, channels, count, dtype="f8"))
            status = np.where(np.arange(count) == 7, Status.gap_before, 0)
            writer.append(name, np.sort(rng.choice(10**9, count, False)), values[name], status=status)
    assert main(["export", "mcap", str(path), "-o", str(tmp_path / "s.mcap"), "--prefix", "arm"]) == 0
    with calib.open_session(path) as session:
        found, _ = by_rosbags(tmp_path / "s.mcap")
        for name, stream in session.streams.items():
            times, rows = zip(*found[f"/arm/{name}"], strict=True)
            np.testing.assert_array_equal(times, EPOCH_NS + stream.time)
            np.testing.assert_array_equal([row.data for row in rows], values[name])
            variable, unit, channels, _ = kinds[name]
            (axis,) = rows[0].layout.dim
            assert (axis.label, axis.size, axis.stride) == (f"{variable} [{unit}]", channels, channels)
            flags = {time - EPOCH_NS: flag.data for time, flag in found[f"/arm/{name}/status"]}
            assert flags == {int(stream.time[k]): int(stream.status()[k]) for k in np.flatnonzero(stream.status())}
        words = [f"--stream={name}=/arm/{name}.data:{kind[1]}" for name, kind in kinds.items()]
        assert main(["import", "mcap", str(tmp_path / "s.mcap"), *words, "-o", str(tmp_path / "back.h5")]) == 0
        with calib.open_session(tmp_path / "back.h5") as back:
            for name, stream in session.streams.items():
                np.testing.assert_array_equal(back.streams[name].read(), values[name])
                times = back.epoch_ns + back.streams[name].time
                np.testing.assert_allclose(times - EPOCH_NS, stream.time, rtol=0, atol=500)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The bytes of an exported session of two chunks, and its values."""
    folder = tmp_path_factory.mktemp("exported")
    time, values = np.arange(140) * 10**7, np.random.default_rng(3).normal(size=(140, 1000))
    with SessionWriter(folder / "s.h5", SessionFacts(epoch=datetime.fromisoformat(EPOCH))) as writer:
        writer.add_stream("eit", StreamFacts("voltage", "V", 1000, 100, dtype="f8"))
        writer.append("eit", time, values)
    calib.export_mcap(folder / "s.h5", folder / "s.mcap")
    return (folder / "s.mcap").read_bytes(), values


def test_import_refuses_an_export_with_a_flipped_bit(exported, tmp_path):
    """A flip in messages or summary is refused. Others lie where the reader does not look, as the index of chunks."""
    good, values = exported
    path, names = tmp_path / "s.mcap", ["/skin/eit.data"]
    request = {"module": McapImporter.__module__, "reader": "McapImporter", "task": "arrays", "names": names}
    request = json.dumps(request | {"path": str(path), "folder": str(tmp_path)})

    def refused(place):
        path.write_bytes(good[:place] + bytes([good[place] ^ 0x10]) + good[place + 1 :])
        status, said = child.answer(request)
        assert not status or (status == child.BAD_FILE and "the file is damaged" in said), said
        np.testing.assert_array_equal(values, values if status else np.load(tmp_path / "0.npy"))
        return bool(status)

    path.write_bytes(good)
    assert child.answer(request) == (0, "null")
    assert sum(map(refused, np.random.default_rng(4).integers(0, len(good), 50).tolist())) > 45
    summary = int.from_bytes(good[-28:-20], "little")
    assert all(map(refused, range(summary, len(good), 20)))


def test_every_chunk_of_an_export_has_a_checksum(exported, tmp_path):
    stream = pytest.importorskip("mcap.stream_reader")
    (tmp_path / "s.mcap").write_bytes(exported[0])
    with open(tmp_path / "s.mcap", "rb") as file:
        records = list(stream.StreamReader(file, emit_chunks=True).records)
    chunks = [one for one in records if type(one).__name__ == "Chunk"]
    assert len(chunks) > 1
    assert all(one.uncompressed_crc for one in chunks)
    assert sum(one.summary_crc > 0 for one in records if type(one).__name__ == "Footer") == 1
    with open(tmp_path / "s.mcap", "rb") as file:
        assert (
            sum(type(one).__name__ == "Message" for one in stream.StreamReader(file, validate_crcs=True).records) == 140
        )


def test_what_cannot_be_exported_ends_in_one_line(bag, arrays, tmp_path, capsys):
    folder = bag.parent

    def refused(source, *words, output=tmp_path / "out"):
        assert main(["export", "mcap", str(source), "-o", str(output), *words]) == 2
        assert not (tmp_path / "out").exists()
        assert not list(tmp_path.glob(".*"))
        (line,) = capsys.readouterr().err.splitlines()
        return line

    good = folder / "f.h5"
    assert "bag: output: exists; name another" in refused(good, output=bag)
    assert "--prefix 1/a: is no topic of ROS" in refused(good, "--prefix", "1/a")
    assert "--frame-id a b: is no frame" in refused(good, "--frame-id", "a b")
    with ArchiveWriter(tmp_path / "c.h5", "skin-calibration", {}) as writer:
        writer.add("a", [1.0], "1")
    assert "is 'skin-calibration'; name a force map" in refused(tmp_path / "c.h5")
    less = {name: values for name, values in arrays.items() if name != "points"}
    assert "points: missing; write the force map again" in refused(force_map(tmp_path / "l.h5", less))
    odd = arrays | {"force_se": arrays["force_se"][:, 1:]}
    assert "force_se: has the shape (5, 11), not (5, 12)" in refused(force_map(tmp_path / "o.h5", odd))
    late = force_map(tmp_path / "t.h5", arrays, time_epoch_utc="2039-01-01T00:00:00Z")
    assert "ROS counts from 1970 to 2038" in refused(late)


def test_an_interrupted_export_leaves_nothing(bag, tmp_path):
    def break_off(blocks):
        yield next(iter(blocks))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calib.export_mcap(bag.parent / "f.h5", tmp_path / "out", progress=break_off)
    assert not list(tmp_path.iterdir())


def test_names_become_topics():
    names = ["left arm", "left_arm", "left-arm!", "2", "Ärmel", "__", "x__y_"]
    assert topic_names(names, "pad") == ["left_arm", "left_arm_2", "left_arm_3", "pad_2", "rmel", "pad", "x_y"]


def test_without_rosbags_the_extra_is_named(bag, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(ImportError, match=r"needs rosbags: pip install 'jaxeit\[tables\]'"):
        calib.export_mcap(bag.parent / "f.h5", tmp_path / "out")
    assert not list(tmp_path.iterdir())
