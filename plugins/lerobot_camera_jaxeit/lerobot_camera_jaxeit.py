"""A camera of LeRobot whose pictures are the force maps of a live skin.

It reads the lines of JSON that ``jaxeit live --publish PORT --publish-maps`` sends, and needs neither jaxeit nor JAX.
LeRobot finds it by the name of the package: a camera of the type ``jaxeit_skin``.
"""

import base64
import contextlib
import json
import socket
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

READ_TIMEOUT_MS = 10_000  # of `SkinCamera.read`, which waits for a frame
MAX_LINE = 1 << 24  # bytes of a line, which never ends where another program answers


class MapError(ValueError):
    """Maps that do not fill the pictures asked for."""


@CameraConfig.register_subclass("jaxeit_skin")
@dataclass(kw_only=True)
class SkinCameraConfig(CameraConfig):
    """Where a live skin sends its force maps, and what they look like.

    | field         | meaning                                                                   | default   | unit |
    |---------------|---------------------------------------------------------------------------|-----------|------|
    | host, port    | of ``jaxeit live --publish PORT --publish-maps``                          | 127.0.0.1 |      |
    | full_scale    | force on a pixel of the map that is white                                 | 1         | N    |
    | width, height | of a picture: multiples of the columns and rows of the map; None: of it   |           |      |
    | wait          | time within which the first frame must arrive                             | 30        | s    |
    """

    host: str = "127.0.0.1"
    port: int = 8767
    full_scale: float = 1.0
    wait: float = 30.0

    def __post_init__(self) -> None:
        if not self.full_scale > 0:
            raise ValueError(f"full_scale is {self.full_scale}; give a force above zero, N")


class SkinCamera(Camera):
    """Pictures (height, width, 3) uint8 of force maps in grey, +y upwards: white is the full scale, unknown is black.

    ``forces`` are those of the pads in the newest frame, N; NaN: not known.
    """

    def __init__(self, config: SkinCameraConfig):
        super().__init__(config)
        self.config = config
        self.forces = np.zeros(0)
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._lock, self._new = threading.Lock(), threading.Event()
        self._picture: np.ndarray | None = None
        self._taken = 0.0
        self._failure = ""

    def __str__(self) -> str:
        return f"SkinCamera({self.config.host}:{self.config.port})"

    @property
    def is_connected(self) -> bool:
        return self._socket is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """A skin is not found by itself: name its host and port."""
        return []

    def connect(self, warmup: bool = True) -> None:
        """Connect, and wait for the first frame.

        Raises:
            ConnectionError: if nothing answers, or what answers is no live skin with maps of the size asked for.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        try:
            self._socket = socket.create_connection((self.config.host, self.config.port), timeout=self.config.wait)
        except OSError as error:
            todo = "start `jaxeit live --publish PORT --publish-maps`"
            raise ConnectionError(f"{self}: {error}; {todo}") from error
        self._socket.settimeout(None)
        self._failure, self._picture = "", None
        self._new.clear()
        self._thread = threading.Thread(target=self._receive, args=(self._socket,), daemon=True, name=str(self))
        self._thread.start()
        try:
            first = self.async_read(1e3 * self.config.wait)
        except (TimeoutError, RuntimeError) as error:
            self.disconnect()
            raise ConnectionError(str(error)) from error
        self.height, self.width = first.shape[:2]

    def read(self) -> np.ndarray:
        """The next picture; waits for it."""
        with self._lock:
            if not self._failure:
                self._new.clear()
        return self.async_read(READ_TIMEOUT_MS)

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest picture that was not read yet; waits for it.

        Raises:
            TimeoutError: if none arrives in time.
            RuntimeError: if the connection has ended.
        """
        self._require_connected()
        if not self._new.wait(timeout_ms / 1e3):
            raise TimeoutError(f"{self}: no frame in {timeout_ms:g} ms")
        with self._lock:
            if self._failure:
                raise RuntimeError(f"{self}: {self._failure}")
            assert self._picture is not None
            self._new.clear()
            return self._picture

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The newest picture, read before or not; does not wait.

        Raises:
            TimeoutError: if it is older than that.
            RuntimeError: if there is none.
        """
        self._require_connected()
        with self._lock:
            if self._picture is None:
                raise RuntimeError(f"{self}: no frame yet")
            age = 1e3 * (time.perf_counter() - self._taken)
            if age > max_age_ms:
                raise TimeoutError(f"{self}: the newest frame is {age:.0f} ms old")
            return self._picture

    def disconnect(self) -> None:
        """Close the connection."""
        self._require_connected()
        assert self._socket is not None
        assert self._thread is not None
        with contextlib.suppress(OSError):  # the other end has closed it
            self._socket.shutdown(socket.SHUT_RDWR)  # ends the thread's wait
        self._thread.join(timeout=2.0)
        self._socket.close()
        self._socket = self._thread = None

    def _require_connected(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected.")

    def _receive(self, connection: socket.socket) -> None:
        """Keep the newest picture, until the connection ends."""
        failure = "the connection has ended"
        try:
            with connection.makefile("rb") as lines:
                while line := lines.readline(MAX_LINE):
                    self._keep(json.loads(line))
        except MapError as error:
            failure = str(error)
        except (ValueError, KeyError, TypeError) as error:
            failure = f"no line of a live skin ({error}); start `jaxeit live` with --publish-maps"
        except OSError as error:
            failure = str(error)
        with self._lock:
            self._failure = failure
        self._new.set()

    def _keep(self, result: dict[str, Any]) -> None:
        picture = self._picture_of(result)
        forces = np.array([np.nan if force is None else force for force in result["force"]], float)
        with self._lock:
            self._picture, self.forces, self._taken = picture, forces, time.perf_counter()
        self._new.set()

    def _picture_of(self, result: dict[str, Any]) -> np.ndarray:
        rows, columns = result["shape"]
        forces = np.frombuffer(base64.b64decode(result["map"]), "<f4").reshape(rows, columns)[::-1]
        part = np.clip(np.nan_to_num(forces, nan=0.0) / self.config.full_scale, 0, 1)
        grey = np.rint(255 * part).astype(np.uint8)
        height, width = self.config.height or rows, self.config.width or columns
        if height % rows or width % columns:
            raise ValueError(
                f"a map of {columns} x {rows} pixels does not fill {width} x {height}; give multiples of it"
            )
        large = grey.repeat(height // rows, 0).repeat(width // columns, 1)
        return np.repeat(large[..., None], 3, -1)
