"""Sending the same to everyone who listens, without ever waiting for anyone."""

import contextlib
import socket
from collections.abc import Callable, Sequence

BACKLOG = 1 << 20  # bytes held for a listener
_BURST = 1 << 16


class Listener:
    """Something to send to: whole packets, or none of them where too much waits already."""

    def __init__(
        self,
        send: Callable[[memoryview], int],
        close: Callable[[], None],
        backlog: int = BACKLOG,
        hear: Callable[[int], bytes] = lambda size: b"",
    ):
        self._send, self.close, self._backlog, self._hear = send, close, backlog, hear
        self._waiting = bytearray()
        self.tail = b""  # of what was heard, for whoever understands it
        self.dropped = 0

    def heard(self) -> bytes:
        """What it has said, without waiting."""
        with contextlib.suppress(OSError):  # nothing yet; that it has gone is noticed by sending
            return self._hear(_BURST)
        return b""

    def give(self, packets: Sequence[bytes]) -> None:
        """Send what it takes; raises OSError if it is gone."""
        for packet in packets:
            if len(self._waiting) < self._backlog:
                self._waiting += packet
            else:
                self.dropped += 1
        with contextlib.suppress(BlockingIOError):
            while self._waiting:
                with memoryview(self._waiting) as view:
                    sent = self._send(view[:_BURST])
                del self._waiting[:sent]


class Broadcaster:
    """A TCP server that only talks; a context manager. Raises OSError if the port is taken."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0, backlog: int = BACKLOG):
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self._backlog = backlog
        self.address: tuple[str, int] = self._server.getsockname()[:2]
        self.listeners: list[Listener] = []

    def meet(self, away: bool = False) -> None:
        """Take in whoever has called; throw everyone out while `away`."""
        with contextlib.suppress(BlockingIOError):
            while True:
                client, _ = self._server.accept()
                if away:
                    client.close()
                    continue
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.listeners.append(Listener(client.send, client.close, self._backlog, client.recv))
        while away and self.listeners:
            self.listeners.pop().close()

    def give(self, packets: Sequence[bytes]) -> None:
        """To everyone; who is gone is forgotten."""
        give(self.listeners, packets)

    def say(self, packets: Sequence[bytes]) -> None:
        """Take in whoever has called, then to everyone."""
        self.meet()
        self.give(packets)

    def close(self) -> None:
        """Disconnect everyone."""
        for listener in self.listeners:
            listener.close()
        self.listeners.clear()
        self._server.close()

    def __enter__(self) -> "Broadcaster":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def give(listeners: list[Listener], packets: Sequence[bytes]) -> None:
    """To all listeners; those that are gone are taken off the list."""
    for listener in listeners[:]:
        try:
            listener.give(packets)
        except OSError:
            listener.close()
            listeners.remove(listener)
