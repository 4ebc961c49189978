"""Live results as messages of ROS 2: decoded by the authors of MCAP, and received over the websocket of Foxglove."""

import json
import os
import re
import socket
import struct
import sys
import time
from dataclasses import dataclass, field, replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main
from calib.live.bridges import AbstractLiveSink, Bridge, BridgeError, FoxgloveServer, RosNode
from calib.live.results import FrameResult, TouchEstimates
from tests.helpers import stand_in

from .test_live import listening

pytest.importorskip("rosbags.typesys")
ROWS, COLUMNS = 3, 4
PIXELS = ROWS * COLUMNS
KINDS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/skin/force_map": "sensor_msgs/msg/Image",
    "/skin/taxels": "sensor_msgs/msg/PointCloud2",
    "/skin/pad_forces": "std_msgs/msg/Float64MultiArray",
    "/skin/pads/left/wrench": "geometry_msgs/msg/WrenchStamped",
    "/skin/pads/the_right/wrench": "geometry_msgs/msg/WrenchStamped",
}


@pytest.fixture
def calibration():
    """Of a flat sheet of 3 by 4 pixels of 10 mm, the last of which is off the sheet, with two pads."""
    x, y = np.meshgrid(0.01 * np.arange(COLUMNS), 0.01 * np.arange(ROWS))
    corners = 0.01 * np.array([[0, 0], [2, 0], [2, 2], [0, 2]])
    pads = [je.Pad("left", corners), je.Pad("the right", corners + np.array([0.02, 0]))]
    areas = np.where(np.arange(PIXELS) < PIXELS - 1, 1e-4, 0.0)
    recon = stand_in(je.Reconstructor, centres=np.stack([x.ravel(), y.ravel()], 1), areas=areas, shape=(ROWS, COLUMNS))
    return stand_in(
        calib.Calibration,
        skin=stand_in(je.Skin, name="small", pads=pads, surface=None),
        recon=recon,
        masks=stand_in(je.fusion.PadMasks, areas=areas),
        locator=None,
        simulated=True,
    )


def result(number, **changes):
    """Frame `number`, 10 ms after the one before."""
    values = {
        "number": number,
        "host": time.monotonic_ns(),
        "latency": 0.001,
        "force": np.array([float(number), np.nan]),
        "standard_error": np.array([0.1, np.nan]),
        "half_width": np.array([0.16, np.nan]),
        "valid": np.array([True, False]),
        "centre": np.full((2, 2), np.nan),
        "map": number * np.arange(PIXELS, dtype=float),
        "image": np.zeros(PIXELS),
        "missing": 0,
        "dropped": 0,
    }
    return FrameResult(**{**values, **changes})


TRACKED = TouchEstimates(
    np.array([[0.02, 0.01]]),
    np.diag([4e-6, 1e-6])[None],
    np.array([True]),
    0,
    np.array([7]),
    np.array([3.0]),
    np.array([0.2]),
    np.array([[0.001, 0.002]]),
)


@pytest.fixture
def decoded():
    """Function from the type of a message and its bytes to the message, by the definitions in the channel's schema."""
    dynamic = pytest.importorskip("mcap_ros2._dynamic")

    def decode(kind, text, data):
        return dynamic.generate_dynamic(kind, text)[kind](data)

    return decode


def check_frame(messages, number):
    """The messages of a frame, by topic."""
    picture = messages["/skin/force_map"]
    assert (picture.encoding, picture.height, picture.width, picture.step) == ("32FC1", ROWS, COLUMNS, 4 * COLUMNS)
    np.testing.assert_array_equal(
        np.frombuffer(bytes(picture.data), "f4").reshape(ROWS, COLUMNS)[::-1].ravel(), number * np.arange(PIXELS)
    )
    cloud = messages["/skin/taxels"]
    points = np.frombuffer(bytes(cloud.data), "f4").reshape(PIXELS - 1, 6)
    assert [part.name for part in cloud.fields] == ["x", "y", "z", "force", "force_se", "pressure"]
    np.testing.assert_allclose(points[:, 0], 0.01 * (np.arange(PIXELS - 1) % COLUMNS), atol=1e-9)
    np.testing.assert_allclose(points[:, 3], number * np.arange(PIXELS - 1))
    assert np.isnan(points[:, 4]).all()  # live tells no error of a pixel
    np.testing.assert_allclose(points[:, 5], 1e4 * number * np.arange(PIXELS - 1), rtol=1e-6)
    wrench = messages["/skin/pads/left/wrench"]
    assert (wrench.header.frame_id, wrench.wrench.force.z) == ("skin_left", -number)
    assert np.isnan(messages["/skin/pads/the_right/wrench"].wrench.force.z)
    table = np.array(messages["/skin/pad_forces"].data).reshape(2, 5)
    np.testing.assert_allclose(table, [[number, 0.1, 0.16, 1, np.nan], [np.nan, np.nan, np.nan, 0, np.nan]])
    stamp = wrench.header.stamp
    seconds = getattr(stamp, "sec", None) + 1e-9 * stamp.nanosec
    assert abs(seconds - time.time()) < 60
    return seconds


class Recorder(AbstractLiveSink):
    """Keeps what is sent."""

    keeps = True

    def __init__(self):
        super().__init__("tables")
        self.opened, self.sent, self.closed = {}, [], False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.closed = True

    def open_topic(self, name, kind, latched):
        self.opened[name] = (kind, latched)

    def send(self, topic, time, data):
        self.sent.append((topic, time, data))

    def messages(self, decode):
        """All messages, by topic."""
        found = {}
        for topic, _, data in self.sent:
            kind = self.opened[topic][0]
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            found.setdefault(topic, []).append(decode(kind, text, data))
        return found


def test_numbers_of_every_result_and_pictures_of_the_newest(calibration, decoded):
    sink = Recorder()
    bridge = Bridge(calibration, sink)
    for number in range(1, 21):  # before anything is sent
        bridge.show_result(result(number))
    with bridge:
        pass
    assert sink.closed
    assert {name: kind for name, (kind, _) in sink.opened.items()} == KINDS
    assert [name for name, (_, latched) in sink.opened.items() if latched] == ["/tf_static"]
    found = sink.messages(decoded)
    assert [m.wrench.force.z for m in found["/skin/pads/left/wrench"]] == [-float(n) for n in range(1, 21)]
    assert {topic: len(found[topic]) for topic in ("/tf_static", "/skin/force_map", "/skin/taxels")} == {
        "/tf_static": 1, "/skin/force_map": 1, "/skin/taxels": 1,
    }  # fmt: skip
    seconds = check_frame({topic: messages[-1] for topic, messages in found.items()}, 20)
    assert seconds * 1e9 == pytest.approx(sink.sent[-1][1], abs=1000)
    places = found["/tf_static"][0].transforms
    assert [(p.header.frame_id, p.child_frame_id) for p in places] == [
        ("skin", "skin_left"),
        ("skin", "skin_the_right"),
    ]
    np.testing.assert_allclose([places[1].transform.translation.x, places[1].transform.rotation.w], [0.03, 1])


def test_contacts(calibration, decoded):
    """Those that are followed have numbers and forces; those found in a frame alone have places."""
    found = {}
    for track in (True, False):
        sink = Recorder()
        fits = stand_in(type(calibration), **{**vars(type(calibration)), "locator": object()})
        with Bridge(fits, sink, track=track, prefix="/arm", frame_id="arm") as bridge:
            bridge.show_result(result(1, touches=TRACKED if track else replace(TRACKED, number=None)))
            bridge.show_result(result(2))
        found |= sink.messages(decoded)
    rows = [np.array(message.data).reshape(-1, 14) for message in found["/arm/tracks"]]
    expected = [7, 0.02, 0.01, 4e-6, 0, 0, 1e-6, np.nan, 3.0, 0.2, 0.001, 0.002, np.nan, np.nan]
    np.testing.assert_allclose(rows[0], [expected])
    assert rows[1].shape == (0, 14)
    places = [np.array(message.data).reshape(-1, 3) for message in found["/arm/contacts"]]
    np.testing.assert_allclose(places[0], [[0.02, 0.01, np.nan]])
    assert places[1].shape == (0, 3)


def test_a_sink_that_fails_is_told_once_and_holds_nothing_up(calibration):
    class Broken(Recorder):
        def send(self, topic, time, data):
            if topic != "/tf_static":
                raise RuntimeError("gone")

    told = []
    with Bridge(calibration, Broken(), warn=told.append) as bridge:
        for number in range(5):
            bridge.show_result(result(number))
            time.sleep(0.01)
    assert told == ["Broken: gone; nothing more is sent"]


# --- ROS -------------------------------------------------------------------------------------------------------------


@dataclass
class FakeRos:
    """The few calls of rclpy that a node needs, as its source declares them."""

    log: list = field(default_factory=list)

    def modules(self):
        """Modules of ROS, by name."""
        rclpy, signals, qos = (ModuleType(name) for name in ("rclpy", "rclpy.signals", "rclpy.qos"))
        signals.SignalHandlerOptions = SimpleNamespace(NO="no handlers")
        qos.DurabilityPolicy = SimpleNamespace(TRANSIENT_LOCAL="transient local")
        qos.QoSProfile = lambda *, depth, durability: (depth, durability)

        def init(*, args=None, signal_handler_options=None):
            self.log.append(("init", args, signal_handler_options))

        rclpy.init, rclpy.create_node = init, self.node
        rclpy.shutdown = lambda: self.log.append(("shutdown",))
        found = {"rclpy": rclpy, "rclpy.signals": signals, "rclpy.qos": qos}
        for kind in KINDS.values():
            package, _, name = kind.split("/")
            module = found.setdefault(f"{package}.msg", ModuleType(f"{package}.msg"))
            setattr(module, name, type(name, (), {"__module__": f"{package}.msg"}))
            found[package] = ModuleType(package)
        return found

    def node(self, name):
        """A node, whose publishers take messages as bytes."""
        self.log.append(("node", name))

        def create_publisher(msg_type, topic, qos_profile):
            self.log.append(("publisher", f"{msg_type.__module__}.{msg_type.__name__}", topic, qos_profile))

            def publish(message):
                assert type(message) is bytes
                self.log.append(("publish", topic, message))

            return SimpleNamespace(publish=publish)

        return SimpleNamespace(
            create_publisher=create_publisher, destroy_node=lambda: self.log.append(("destroy", name))
        )


def test_a_node_of_ros_publishes_the_bytes_of_a_bag(calibration, decoded, monkeypatch):
    ros = FakeRos()
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    node = RosNode("skin_bridge")
    with Bridge(calibration, node) as bridge:
        bridge.show_result(result(3))
    assert ros.log[:2] == [("init", [], "no handlers"), ("node", "skin_bridge")]
    assert ros.log[-2:] == [("destroy", "skin_bridge"), ("shutdown",)]
    opened = {topic: (kind, qos) for what, kind, topic, qos in (row for row in ros.log if row[0] == "publisher")}
    assert {topic: kind.replace(".", "/") for topic, (kind, _) in opened.items()} == KINDS
    assert opened["/tf_static"][1] == (1, "transient local")
    assert {qos for topic, (_, qos) in opened.items() if topic != "/tf_static"} == {10}
    sent = {topic: data for what, topic, data in (row for row in ros.log if row[0] == "publish")}
    assert set(sent) == set(KINDS)
    text = {kind: node.store.generate_msgdef(kind, ros_version=2)[0] for kind in KINDS.values()}
    check_frame({topic: decoded(KINDS[topic], text[KINDS[topic]], data) for topic, data in sent.items()}, 3)


STREAMS = ["--eit", "tcp://127.0.0.1:1", "--pressure", "tcp://127.0.0.1:1"]


@pytest.mark.parametrize(
    ("option", "missing", "words"),
    [
        ("--ros2", "rclpy", "source the setup of ROS 2"),
        ("--foxglove", "foxglove", r"pip install 'jaxeit\[foxglove\]'"),
        ("--foxglove", "rosbags.typesys", r"pip install 'jaxeit\[foxglove\]'"),
    ],
)
def test_what_is_not_installed_is_said(option, missing, words, calibration, monkeypatch, capsys):
    monkeypatch.setattr("calib.calibration.load_calibration", lambda path: calibration)
    monkeypatch.setattr("calib.cli.commands.calibrations.live_command._planned", lambda args, calibration: (None, []))
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["live", "--calibration", "c.h5", *STREAMS, option]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(words, line)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--prefix", "/arm"], "--prefix: it is about topics; add --ros2 or --foxglove"),
        (["--frame-id", "arm"], "--frame-id: it is about topics; add --ros2 or --foxglove"),
        (["--publish-maps"], "--publish-maps: it adds to the lines of --publish; add --publish PORT"),
    ],
)
def test_options_of_an_output_that_was_not_asked_for_are_refused(words, said, capsys):
    assert main(["live", "--calibration", "c.h5", *STREAMS, *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


@pytest.mark.parametrize("option", ["--port", "--publish", "--foxglove"])
@pytest.mark.parametrize("number", ["99999", "-1", "1" * 5000, "many"])
def test_what_is_no_port_is_refused(option, number, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["live", "--calibration", "c.h5", *STREAMS, f"{option}={number}"])
    (line,) = capsys.readouterr().err.splitlines()
    assert f"argument {option}: {number}: give a port from 1 to 65535, or 0 for any free one" in line


def test_what_cannot_be_sent_is_refused(calibration):
    with pytest.raises(BridgeError, match="log has no force map"):
        Bridge(stand_in(calib.calibration.LogCalibration), Recorder())
    with pytest.raises(ValueError, match="no topic of ROS"):
        Bridge(calibration, Recorder(), prefix="/9")


# --- Foxglove --------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not os.path.exists("/proc/self/net/tcp"), reason="needs Linux")
def test_the_server_listens_on_this_machine_only():
    pytest.importorskip("foxglove")
    before = set(listening())
    with FoxgloveServer(port=0):
        (address,) = set(listening()) - before
    assert address.startswith("0100007F:")


def test_the_address_of_a_server_on_ipv6_is_one_that_programs_take():
    pytest.importorskip("foxglove")
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 on this machine")
    with FoxgloveServer("::1", port=0) as server:
        assert re.fullmatch(r"ws://\[::1\]:\d+", server.address)


def test_lost_clients_of_foxglove_are_one_line(caplog):
    pytest.importorskip("foxglove")
    said = []
    with FoxgloveServer(port=0, warn=said.append) as server:
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", int(server.address.rpartition(":")[2]))) as client:
                client.sendall(b"no websocket\r\n\r\n")
                assert client.recv(1) == b""  # the server has dropped it
    (line,) = said
    assert re.fullmatch(r"--foxglove: Dropping client \S+ handshake failed; the others are served, and nothing.*", line)
    assert not [record for record in caplog.records if record.name.startswith("foxglove")]


def test_the_foxglove_app_receives_topics_schemas_and_messages(calibration, decoded):
    """A client of the protocol, after its description: subscribe to all topics, and decode by the schemas given."""
    pytest.importorskip("foxglove")
    client = pytest.importorskip("websockets.sync.client")
    server = FoxgloveServer(port=0)
    with (
        Bridge(calibration, server) as bridge,
        client.connect(
            server.address, subprotocols=["foxglove.sdk.v1"], open_timeout=5, close_timeout=0.2
        ) as connection,
    ):
        told, channels = {}, {}
        while len(channels) < len(KINDS):
            message = json.loads(connection.recv(timeout=5))
            told[message["op"]] = message
            channels |= {c["id"]: c for c in message.get("channels", [])}
        assert {c["topic"]: c["schemaName"] for c in channels.values()} == KINDS
        assert {(c["encoding"], c["schemaEncoding"]) for c in channels.values()} == {("cdr", "ros2msg")}
        wanted = [{"id": 100 + number, "channelId": number} for number in channels]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        found = {}
        while set(found) < set(KINDS):
            bridge.show_result(result(4))
            data = connection.recv(timeout=5)
            if isinstance(data, str):
                continue
            op, subscription, _ = struct.unpack_from("<BIQ", data)
            assert op == 1
            channel = channels[subscription - 100]
            found[channel["topic"]] = decoded(channel["schemaName"], channel["schema"], data[13:])
        check_frame(found, 4)
        with pytest.raises(OSError, match="name another port"), FoxgloveServer(port=int(server.address[-5:])):
            pass
    assert told["serverInfo"]["name"] == "jaxeit"
