"""A server of the websocket protocol of Foxglove (https://foxglove.dev): the optional extra ``foxglove``."""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from ...record.broadcast import host_and_port
from ...session.errors import printable
from ...session.importers.child import library
from .bridge import AbstractLiveSink

EXTRA = "foxglove"
PORT = 8766  # the live page has Foxglove's own, 8765
LOGGER = "foxglove"  # of the SDK


class FoxgloveServer(AbstractLiveSink):
    """Sends messages of ROS 2 to all Foxglove apps that connect; a context manager.

    ``address`` is the one to open in Foxglove.

    Args:
        host: address to listen on.
        port: 0: any free port.
        warn: called with one line when the first client is lost or sends what no client sends. The SDK's own lines, one
            for each message to a client that is gone, are then left out. Default: the SDK logs them.

    Raises:
        ImportError: without `foxglove-sdk` or `rosbags`.
        OSError: on entering, if the port is in use.
    """

    keeps = False

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = PORT,
        name: str = "jaxeit",
        warn: Callable[[str], object] | None = None,
    ):
        super().__init__(EXTRA)
        self._foxglove = library("foxglove", EXTRA)
        self._host, self._port, self._name = host, port, name
        self._context, self._channels = self._foxglove.Context(), dict[str, Any]()
        self._server: Any = None
        self._warn = warn
        self.address = ""

    def __enter__(self) -> "FoxgloveServer":
        with ExitStack() as opened:
            if self._warn is not None:
                opened.enter_context(_only_first_line(self._warn))
            try:
                self._server = self._foxglove.start_server(
                    name=self._name, host=self._host, port=self._port, context=self._context
                )
            except (RuntimeError, OverflowError) as error:
                where = host_and_port(self._host, self._port)
                raise OSError(f"--foxglove: {where}: {error}; name another port") from error
            opened.callback(self._server.stop)
            self._close = opened.pop_all().close
        self.address = f"ws://{host_and_port(self._host, self._server.port)}"
        return self

    def __exit__(self, *error: object) -> None:
        for channel in self._channels.values():
            channel.close()
        self._close()

    def open_topic(self, name: str, kind: str, latched: bool) -> None:
        text, _ = self.store.generate_msgdef(kind, ros_version=2)
        schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
        self._channels[name] = self._foxglove.Channel(
            name, schema=schema, message_encoding="cdr", context=self._context
        )

    def send(self, topic: str, time: int, data: bytes) -> None:
        self._channels[topic].log(data, log_time=time)


class _FirstLine(logging.Handler):
    """Hands on the first line of a log."""

    def __init__(self, warn: Callable[[str], object]):
        super().__init__(logging.WARNING)
        self._warn: Callable[[str], object] | None = warn

    def emit(self, record: logging.LogRecord) -> None:
        warn, self._warn = self._warn, None
        if warn is not None:
            line = printable(record.getMessage(), 200)
            warn(f"--foxglove: {line}; the others are served, and nothing more is said of clients")


@contextmanager
def _only_first_line(warn: Callable[[str], object]) -> Iterator[None]:
    """Within this context the log of the SDK is one line."""
    logger, handler = logging.getLogger(LOGGER), _FirstLine(warn)
    before, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = before
