"""Send the same packets to all listeners without waiting for any of them."""

import contextlib
import socket
from collections.abc import Callable, Sequence

MAX_BACKLOG = 1 << 20  # bytes held for a listener
MAX_SEND_BYTES = 1 << 16
MAX_LISTENERS = 32  # at one time; the connections beyond are closed
MAX_ACCEPTED = 100  # connections accepted in one call, so that a flood of connections does not hold up the frames


def address_family(host: str) -> socket.AddressFamily:
    """The family of an address to listen on: names and numbers with points are IPv4, numbers with colons IPv6."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def host_and_port(host: str, port: int) -> str:
    """An address as URLs write it: 127.0.0.1:8765, [::1]:8765."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class Listener:
    """One receiver of packets. Packets are sent whole, or dropped while too many bytes wait."""

    def __init__(
        self,
        send: Callable[[memoryview], int],
        close: Callable[[], None],
        backlog: int = MAX_BACKLOG,
        receive: Callable[[int], bytes] = lambda size: b"",
    ):
        self._send, self.close, self._backlog, self._receive = send, close, backlog, receive
        self._waiting = bytearray()
        self.tail = b""  # received bytes of a request that has not ended, kept for the parser of requests
        self.dropped = 0

    def receive(self) -> bytes:
        """Bytes that the listener has sent, without waiting for any."""
        with contextlib.suppress(OSError):  # no bytes yet; a lost connection is noticed by sending
            return self._receive(MAX_SEND_BYTES)
        return b""

    def send(self, packets: Sequence[bytes]) -> None:
        """Send as much as the listener takes at once; raises OSError if the connection is lost."""
        for packet in packets:
            if len(self._waiting) < self._backlog:
                self._waiting += packet
            else:
                self.dropped += 1
        with contextlib.suppress(BlockingIOError):
            while self._waiting:
                with memoryview(self._waiting) as view:
                    sent = self._send(view[:MAX_SEND_BYTES])
                del self._waiting[:sent]


class Broadcaster:
    """A TCP server that sends packets to all clients; a context manager. Raises OSError if the port is in use."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0, backlog: int = MAX_BACKLOG):
        self._server = socket.create_server((host, port), family=address_family(host))
        self._server.setblocking(False)
        self._backlog = backlog
        self.address: tuple[str, int] = self._server.getsockname()[:2]
        self.listeners: list[Listener] = []

    def accept(self, refuse: bool = False) -> None:
        """Accept waiting connections, at most `MAX_LISTENERS`; with `refuse`, close these and all others."""
        with contextlib.suppress(OSError):  # none waits, a client has gone again, or the system has no more sockets
            for _ in range(MAX_ACCEPTED):
                client, _ = self._server.accept()
                if refuse or len(self.listeners) >= MAX_LISTENERS:
                    client.close()
                    continue
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.listeners.append(Listener(client.send, client.close, self._backlog, client.recv))
        while refuse and self.listeners:
            self.listeners.pop().close()

    def send(self, packets: Sequence[bytes]) -> None:
        """Send to all listeners; those whose connection is lost are removed."""
        send_to_all(self.listeners, packets)

    def publish(self, packets: Sequence[bytes]) -> None:
        """Accept waiting connections, then send to all listeners."""
        self.accept()
        self.send(packets)

    def close(self) -> None:
        """Disconnect all listeners."""
        for listener in self.listeners:
            listener.close()
        self.listeners.clear()
        self._server.close()

    def __enter__(self) -> "Broadcaster":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def send_to_all(listeners: list[Listener], packets: Sequence[bytes]) -> None:
    """Send to all listeners; those whose connection is lost are closed and removed from the list."""
    for listener in listeners[:]:
        try:
            listener.send(packets)
        except OSError:
            listener.close()
            listeners.remove(listener)
