"""A server of the websocket protocol of Foxglove (https://foxglove.dev): the optional extra ``foxglove``."""

from typing import Any

from ...session.importers.child import library
from .bridge import AbstractLiveSink

EXTRA = "foxglove"
PORT = 8766  # the live page has Foxglove's own, 8765


class FoxgloveServer(AbstractLiveSink):
    """Sends messages of ROS 2 to all Foxglove apps that connect; a context manager.

    ``address`` is the one to open in Foxglove.

    Args:
        host: address to listen on.
        port: 0: any free port.

    Raises:
        ImportError: without `foxglove-sdk` or `rosbags`.
        OSError: on entering, if the port is in use.
    """

    keeps = False

    def __init__(self, host: str = "127.0.0.1", port: int = PORT, name: str = "jaxeit"):
        super().__init__(EXTRA)
        self._foxglove = library("foxglove", EXTRA)
        self._host, self._port, self._name = host, port, name
        self._context, self._channels = self._foxglove.Context(), dict[str, Any]()
        self._server: Any = None
        self.address = ""

    def __enter__(self) -> "FoxgloveServer":
        try:
            self._server = self._foxglove.start_server(
                name=self._name, host=self._host, port=self._port, context=self._context
            )
        except (RuntimeError, OverflowError) as error:
            raise OSError(f"--foxglove: {self._host}:{self._port}: {error}; name another port") from error
        self.address = f"ws://{self._host}:{self._server.port}"
        return self

    def __exit__(self, *error: object) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def open_topic(self, name: str, kind: str, latched: bool) -> None:
        text, _ = self.store.generate_msgdef(kind, ros_version=2)
        schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
        self._channels[name] = self._foxglove.Channel(
            name, schema=schema, message_encoding="cdr", context=self._context
        )

    def send(self, topic: str, time: int, data: bytes) -> None:
        self._channels[topic].log(data, log_time=time)
