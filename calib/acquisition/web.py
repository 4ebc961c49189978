"""The live page: one self-contained file over http, results pushed as server-sent events.

A viewer is given the newest result when it is ready for one, so that a slow one sees fewer, never older
ones. It listens on this machine only, unless told otherwise, and asks nothing of any other.
"""

import json
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from calib.calibration import Calibration

from .live import Show
from .results import Result

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_PAGE = Path(__file__).with_name("page.html")
_FASTEST = 0.04  # s between two results for a viewer: the eye sees no more
_QUIET = 1.0  # s after which something is said anyway, to notice who has gone
_PATIENCE = 5.0
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'"


def scene(calibration: Calibration) -> dict[str, object]:
    """What the page draws on: pads, outline and grid in m."""
    skin, recon = calibration.skin, calibration.recon
    centres = np.asarray(recon.centres)
    return {
        "skin": skin.name,
        "simulated": calibration.simulated,
        "rows": recon.shape[0],
        "columns": recon.shape[1],
        "low": centres.min(0).tolist(),
        "high": centres.max(0).tolist(),
        "pads": [pad.name for pad in skin.pads],
        "electrodes": np.asarray(skin.electrode_positions)[:, :2].tolist(),
    }


class Page(ThreadingHTTPServer):
    """The server; a context manager. `show_result` gives it the newest result and returns at once."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, calibration: Calibration, show: Show, host: str = "127.0.0.1", port: int = 0):
        self.show, self.scene = show, json.dumps(scene(calibration)).encode()
        self._result: Result | None = None
        self._fresh = threading.Condition()
        self._host = host
        super().__init__((host, port), _Handler)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True)

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://{self._host}:{self.server_address[1]}/"

    @property
    def names(self) -> set[str] | None:
        """What a browser may call us, so that no page of others can; None if we are open to all."""
        port = self.server_address[1]
        return {f"{name}:{port}" for name in LOOPBACK} if self._host in LOOPBACK else None

    def show_result(self, result: Result) -> None:
        """The newest; viewers take it when they can."""
        with self._fresh:
            self._result = result
            self._fresh.notify_all()

    def newest(self, after: int) -> Result | None:
        """The newest result if it is later than number `after`, waited for a moment."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._number > after or self.show.stop.is_set(), _QUIET)
            return self._result if self._number > after else None

    @property
    def _number(self) -> int:
        return 0 if self._result is None else self._result.number

    def handle_error(self, request, client_address) -> None:
        """Viewers come and go: nothing to tell."""

    def __enter__(self) -> "Page":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.show.stop.set()
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    server: Page
    server_version, sys_version = "jaxeit", ""
    timeout = _PATIENCE

    def do_GET(self) -> None:
        """The page, what it draws on, or the results."""
        if not self._ours():
            return
        if self.path == "/":
            self._reply(_PAGE.read_bytes(), "text/html; charset=utf-8")
        elif self.path == "/scene":
            self._reply(self.server.scene, "application/json")
        elif self.path == "/results":
            self._push()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Take the levels without contact anew; asked by our own page only."""
        if not self._ours():
            return
        origin = self.headers.get("Origin")
        if self.path != "/tare" or origin not in (None, f"http://{self.headers.get('Host')}"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        self.server.show.tare.set()
        self._reply(b"{}", "application/json")

    def _ours(self) -> bool:
        names = self.server.names
        if names is None or self.headers.get("Host") in names:
            return True
        self.send_error(HTTPStatus.FORBIDDEN)
        return False

    def _reply(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def _push(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number, stop = 0, self.server.show.stop
        while not stop.is_set():
            result = self.server.newest(number)
            show = self.server.show
            about = json.dumps({"state": show.state, "simulated": show.simulated, "lost": show.lost})
            text = result.to_json(image=True) if result is not None else "null"
            number = number if result is None else result.number
            self.wfile.write(f'data: {{"about": {about}, "result": {text}}}\n\n'.encode())
            self.wfile.flush()
            stop.wait(_FASTEST)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""
