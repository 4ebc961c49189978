"""The live page: one self-contained file over HTTP, with results pushed as server-sent events.

A viewer gets the newest result whenever it is ready, so that a slow viewer sees fewer results, never older ones. By
default the server listens on this machine only. The page loads nothing from other servers.

Each message is one object of JSON:

| key    | meaning                                                                                             |
|--------|-----------------------------------------------------------------------------------------------------|
| about  | state, health, simulated and lost of `LiveControl`, the state with the faults                       |
| result | the newest result with map and image (`FrameResult.to_json`, `LogResult.to_json`); null: no new one |
| layer  | what contacts have told of the gain of the contact layer, if it has changed (`layer_maps`); null    |
|        | otherwise: mean and standard deviation of its logarithm in each pixel, as base64 of little-endian   |
|        | f4; the values of full colour; and the number of contacts that told them                            |
"""

import contextlib
import json
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from jaxeit.tracking import LearnedLayer

from ...calibration.calibration import Calibration
from ...calibration.logs.calibration import LogCalibration
from ...record.broadcast import address_family, host_and_port
from ..loop import LiveControl
from ..results import Result
from .page_scene import layer_maps, page_scene

LOOPBACK = ("127.0.0.1", "localhost", "::1")
HTTP_PORT = 80
PAGE_FILE = Path(__file__).with_name("page.html")
PAGE_PARTS = ("page.css", "page.js", "history.js")
MIN_RESULT_INTERVAL = 0.04  # s between two results for a viewer; the eye sees no more
KEEP_ALIVE_INTERVAL = 1.0  # s between messages without results, which reveal closed connections
REQUEST_TIMEOUT = 5.0  # s
MAX_CONNECTIONS = 32  # at one time; as many beyond are told so, and further ones are closed
SECURITY_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
SECURITY_HEADERS = {
    "Content-Security-Policy": SECURITY_POLICY,
    "X-Frame-Options": "DENY",  # browsers that do not know frame-ancestors
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
OWN_FETCH_SITES = (None, "same-origin", "none")  # Sec-Fetch-Site of this page, of the user, and of programs


def whole_page() -> bytes:
    """The page as one file: its style and its programs stand where it names them."""
    text = PAGE_FILE.read_text(encoding="utf-8")
    for name in PAGE_PARTS:
        text = text.replace(f"/* {name} */", PAGE_FILE.with_name(name).read_text(encoding="utf-8"))
    return text.encode()


class Page(ThreadingHTTPServer):
    """The HTTP server of the page, a context manager. `show_result` hands over the newest result."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self, calibration: Calibration | LogCalibration, control: LiveControl, host: str = "127.0.0.1", port: int = 0
    ):
        self.control, self.scene = control, json.dumps(page_scene(calibration)).encode()
        self._result: Result | None = None
        self._centres = np.zeros((0, 2))
        if not isinstance(calibration, LogCalibration):
            self._centres = np.asarray(calibration.recon.centres, float)
        self._drawing = threading.Lock()
        self._drawn: tuple[LearnedLayer | None, str] = None, "null"
        self._fresh = threading.Condition()
        self._host = host
        self._free, self._told = (threading.BoundedSemaphore(MAX_CONNECTIONS) for _ in range(2))
        self.address_family = address_family(host)
        super().__init__((host, port), _Handler)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{host_and_port(self._host, self.server_address[1])}/"

    @property
    def host_names(self) -> set[str] | None:
        """Host names that a request may use; None for all.

        A server on this machine only refuses other names, so that no foreign web page can reach it by DNS rebinding.
        """
        if self._host not in LOOPBACK:
            return None
        port = self.server_address[1]
        names = {host_and_port(name, port) for name in LOOPBACK}
        # Browsers leave out the usual port of HTTP.
        return names | {name.removesuffix(f":{HTTP_PORT}") for name in names} if port == HTTP_PORT else names

    def show_result(self, result: Result) -> None:
        """Hand over the newest result; returns at once, and viewers take the result when they are ready."""
        with self._fresh:
            self._result = result
            self._fresh.notify_all()

    def newest(self, after: int) -> Result | None:
        """The newest result with a number above `after`, or None after `KEEP_ALIVE_INTERVAL` without one."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._number > after or self.control.stop.is_set(), KEEP_ALIVE_INTERVAL)
            return self._result if self._number > after else None

    def layer_text(self, layer: LearnedLayer) -> str:
        """The maps of a layer as JSON, computed once for all viewers, in the thread of the first: without JAX."""
        with self._drawing:
            if self._drawn[0] is not layer:
                self._drawn = layer, json.dumps(layer_maps(layer, self._centres))
            return self._drawn[1]

    @property
    def _number(self) -> int:
        return 0 if self._result is None else self._result.number

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a connection in a thread of its own, or refuse it if `MAX_CONNECTIONS` are open."""
        for room, handler in ((self._free, _Handler), (self._told, _FullHandler)):
            if room.acquire(blocking=False):
                work = (request, client_address, room, handler)
                threading.Thread(target=self._handle, args=work, daemon=True).start()
                return
        self.shutdown_request(request)

    def _handle(
        self, request: Any, client_address: Any, room: threading.BoundedSemaphore, handler: "type[_Handler]"
    ) -> None:
        """Handle a connection, then make room for another."""
        try:
            with contextlib.suppress(Exception):  # print nothing when a viewer disconnects
                handler(request, client_address, self)
        finally:
            self.shutdown_request(request)
            room.release()

    def __enter__(self) -> "Page":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.control.stop.set()
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: Page
    server_version, sys_version = "jaxeit", ""
    timeout = REQUEST_TIMEOUT

    def do_GET(self) -> None:
        """Send the page, its fixed contents, or the results."""
        if not self._is_allowed():
            return
        if self.path == "/":
            self._reply(whole_page(), "text/html; charset=utf-8")
        elif self.path == "/scene":
            self._reply(self.server.scene, "application/json")
        elif self.path == "/results":
            self._push()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Measure the rest levels again, if the request comes from the page itself."""
        if not self._is_allowed():
            return
        if self.path != "/tare" or not self._is_own_page():
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        self.server.control.tare.set()
        self._reply(b"{}", "application/json")

    def _is_allowed(self) -> bool:
        host_names = self.server.host_names
        if host_names is None or self.headers.get("Host") in host_names:
            return True
        self.send_error(HTTPStatus.FORBIDDEN)
        return False

    def _is_own_page(self) -> bool:
        """Whether this page or a program sent the request, not the page of another site in the same browser."""
        origin, site = self.headers.get("Origin"), self.headers.get("Sec-Fetch-Site")
        return origin in (None, f"http://{self.headers.get('Host')}") and site in OWN_FETCH_SITES

    def _reply(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self._end_headers()
        self.wfile.write(body)

    def _end_headers(self) -> None:
        for name, value in SECURITY_HEADERS.items():
            self.send_header(name, value)
        self.end_headers()

    def _push(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self._end_headers()
        number, known, stop = 0, None, self.server.control.stop
        while not stop.is_set():
            result = self.server.newest(number)
            control = self.server.control
            about = json.dumps(
                {
                    "state": "; ".join((control.state, *control.faults)),
                    "health": control.health,
                    "simulated": control.simulated,
                    "lost": control.lost,
                }
            )
            text = result.to_json(image=True) if result is not None else "null"
            number = number if result is None else result.number
            layer, told = control.layer, "null"
            if layer is not known and layer is not None and layer.contacts:
                known, told = layer, self.server.layer_text(layer)
            self.wfile.write(f'data: {{"about": {about}, "layer": {told}, "result": {text}}}\n\n'.encode())
            self.wfile.flush()
            stop.wait(MIN_RESULT_INTERVAL)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class _FullHandler(_Handler):
    """Refuses each request, because `MAX_CONNECTIONS` are open."""

    def do_GET(self) -> None:
        """Say that there are too many viewers."""
        explanation = f"{MAX_CONNECTIONS} viewers are connected; close one of their pages, and load this one again"
        self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, explain=explanation)

    do_POST = do_GET
