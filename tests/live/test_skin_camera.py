"""The plug-in for LeRobot: a camera whose pictures are the maps of the lines that live sends."""

import abc
import json
import sys
import threading
import time
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

import numpy as np
import pytest

from calib.record.broadcast import Broadcaster

from .test_bridges import COLUMNS, PIXELS, ROWS, result


def stand_ins():
    """The classes of LeRobot that a camera derives from, with what theirs require (``lerobot/cameras``)."""

    class Camera(abc.ABC):
        def __init__(self, config):
            self.fps, self.width, self.height = config.fps, config.width, config.height

        @property
        @abc.abstractmethod
        def is_connected(self): ...

        @staticmethod
        @abc.abstractmethod
        def find_cameras(): ...

        @abc.abstractmethod
        def connect(self, warmup=True): ...

        @abc.abstractmethod
        def read(self): ...

        @abc.abstractmethod
        def async_read(self, timeout_ms=200): ...

        @abc.abstractmethod
        def disconnect(self): ...

    @dataclass(kw_only=True)
    class CameraConfig:
        fps: int | None = None
        width: int | None = None
        height: int | None = None

        @classmethod
        def register_subclass(cls, name):
            def registered(kind):
                kind.type = name
                return kind

            return registered

    names = ("DeviceAlreadyConnectedError", "DeviceNotConnectedError")
    errors = {name: type(name, (ConnectionError,), {}) for name in names}
    return {
        **{name: {} for name in ("lerobot", "lerobot.cameras", "lerobot.utils")},
        "lerobot.cameras.camera": {"Camera": Camera},
        "lerobot.cameras.configs": {"CameraConfig": CameraConfig},
        "lerobot.utils.errors": errors,
    }


@pytest.fixture(scope="module")
def plugin(root):
    """The module of the plug-in, with LeRobot where it is installed."""
    with pytest.MonkeyPatch.context() as patch:
        if find_spec("lerobot") is None:
            for name, contents in stand_ins().items():
                module = ModuleType(name)
                vars(module).update(contents)
                patch.setitem(sys.modules, name, module)
        patch.syspath_prepend(str(root / "plugins" / "lerobot_camera_jaxeit"))
        yield import_module("lerobot_camera_jaxeit")
        sys.modules.pop("lerobot_camera_jaxeit", None)


@pytest.fixture
def skin():
    """A live skin: its port, and `send`, by which it sends a line to whoever has connected."""
    with Broadcaster() as lines:

        class Skin:
            port = lines.address[1]

            def send(self, line):
                lines.publish([line + b"\n"])

            def send_until(self, done, number=1):
                """Frames of the same number, until something is done."""
                while not done.is_set():
                    self.send(line(number))
                    time.sleep(0.005)

        yield Skin()


def line(number, **changes):
    maps = number * np.arange(PIXELS, dtype=float)
    maps[0] = np.nan
    return result(number, map=maps, **changes).to_json(image=True, shape=(ROWS, COLUMNS)).encode()


def connected(camera, skin):
    """Connect while the skin sends frame 1."""
    done = threading.Event()
    sender = threading.Thread(target=skin.send_until, args=(done,))
    sender.start()
    try:
        camera.connect()
    finally:
        done.set()
        sender.join()
    time.sleep(0.1)  # until the last of these frames has arrived
    return camera


def picture(number, scale):
    """The picture of a frame, in grey."""
    maps = number * np.arange(PIXELS, dtype=float).reshape(ROWS, COLUMNS)[::-1]
    return np.rint(255 * np.clip(maps / scale, 0, 1))


def test_pictures_are_the_maps(plugin, skin):
    camera = plugin.SkinCamera(plugin.SkinCameraConfig(port=skin.port, full_scale=20.0))
    assert not camera.is_connected
    assert plugin.SkinCamera.find_cameras() == []
    connected(camera, skin)
    assert camera.is_connected
    assert (camera.height, camera.width) == (ROWS, COLUMNS)
    camera.read_latest(max_age_ms=10_000)
    camera._new.clear()  # frame 1 was read
    for number in (2, 3):
        skin.send(line(number))
        seen = camera.async_read(2000)
        assert (seen.shape, seen.dtype) == ((ROWS, COLUMNS, 3), np.uint8)
        np.testing.assert_array_equal(seen, np.repeat(picture(number, 20.0)[..., None], 3, -1))
        np.testing.assert_array_equal(camera.forces, [number, np.nan])
    with pytest.raises(TimeoutError, match="no frame in 30 ms"):
        camera.async_read(30)  # frame 3 was read
    np.testing.assert_array_equal(camera.read_latest(), seen)
    with pytest.raises(TimeoutError, match="ms old"):
        camera.read_latest(max_age_ms=0)
    later = threading.Timer(0.1, skin.send, [line(4)])
    later.start()
    np.testing.assert_array_equal(camera.read()[..., 0], picture(4, 20.0))
    later.join()  # a frame may arrive before its sender is done
    camera.disconnect()
    assert not camera.is_connected
    with pytest.raises(ConnectionError, match="not connected"):
        camera.async_read()
    connected(camera, skin).disconnect()  # it can be used again


def test_pixels_become_blocks(plugin, skin):
    config = plugin.SkinCameraConfig(port=skin.port, full_scale=20.0, width=5 * COLUMNS, height=4 * ROWS)
    camera = connected(plugin.SkinCamera(config), skin)
    seen = camera.read_latest(max_age_ms=10_000)
    np.testing.assert_array_equal(seen[..., 1], picture(1, 20.0).repeat(4, 0).repeat(5, 1))
    camera.disconnect()


def test_what_is_no_skin_is_said(plugin, skin):
    def camera(**settings):
        return plugin.SkinCamera(plugin.SkinCameraConfig(**{"port": skin.port, "wait": 5.0} | settings))

    with pytest.raises(ConnectionError, match="4 x 3 pixels does not fill 7 x 3"):
        connected(camera(width=7), skin)
    with pytest.raises(ConnectionError, match="--publish-maps"):
        camera(port=1).connect()
    plain = threading.Timer(0.2, skin.send, [json.dumps({"force": [1.0]}).encode()])
    plain.start()
    with pytest.raises(ConnectionError, match="no line of a live skin"):
        camera().connect()
    with pytest.raises(ValueError, match="full_scale"):
        camera(full_scale=0.0)
    plain.join()


def test_a_connection_that_ends_is_said(plugin):
    lines = Broadcaster()
    done = threading.Event()

    def send():
        while not done.is_set():
            lines.publish([line(1) + b"\n"])
            time.sleep(0.005)

    sender = threading.Thread(target=send)
    sender.start()
    camera = plugin.SkinCamera(plugin.SkinCameraConfig(port=lines.address[1]))
    camera.connect()
    with pytest.raises(ConnectionError, match="already connected"):
        camera.connect()
    done.set()
    sender.join()
    lines.close()
    while not camera._failure:
        time.sleep(0.01)
    with pytest.raises(RuntimeError, match="connection has ended"):
        camera.async_read(2000)
    with pytest.raises(RuntimeError, match="connection has ended"):
        camera.read()
    camera.disconnect()


def test_lerobot_makes_it_from_its_configuration(plugin):
    factory = pytest.importorskip("lerobot.cameras.utils")
    cameras = factory.make_cameras_from_configs({"skin": plugin.SkinCameraConfig(port=1, width=40, height=40)})
    assert type(cameras["skin"]) is plugin.SkinCamera
    assert plugin.SkinCameraConfig().type == "jaxeit_skin"
