"""A live show for rerun (https://rerun.io), which robotics people already use: the optional extra ``viewer``.

Map, image and contacts are drawn on pixels, as rerun's flat views are; forces are series, one for each pad. A thread of
its own does the work, so that no frame waits for it: forces of every frame, pictures of the newest.
"""

import socket
import threading
from collections import deque
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from calib.calibration import Calibration

from .live import Show
from .results import Result, Touches

VIEWER = "127.0.0.1:9876"
_FASTEST = 0.1  # s between two pictures, which take milliseconds to pack
_HELD = 4096  # results, for a thread that is not let in
_PATIENCE = 2.0  # s for a viewer to take the last of it
_CORNERS = np.linspace(0.0, 2.0 * np.pi, 49)
_LEAST = 1e-30  # of a range of colours, which must not be empty
_MARK = (194, 47, 69)


class RerunError(ValueError):
    """A viewer or a file that results cannot be sent to."""


class RerunView:
    """Sends results to a viewer that runs at ``HOST:PORT``, or to a file ``*.rrd``; a context manager.

    `show_result` returns at once.

    Raises:
        RerunError: on entering, if no viewer answers, or the file exists.
    """

    def __init__(self, calibration: Calibration, show: Show, where: str = VIEWER):
        recon = calibration.recon
        self._show, self._skin, self._simulated = show, calibration.skin.name, calibration.simulated
        self._pads = [pad.name for pad in calibration.skin.pads]
        self._grid = Grid(np.asarray(recon.centres), recon.shape)
        self._where = where
        self._stream = rr.RecordingStream("jaxeit")
        self._waiting: deque[Result] = deque(maxlen=_HELD)
        self._stop = threading.Event()
        self._first: int | None = None
        self._top = {"map": _LEAST, "image": _LEAST}
        self._thread = threading.Thread(target=self._work, name="rerun", daemon=True)

    def show_result(self, result: Result) -> None:
        """Take one more result."""
        self._waiting.append(result)

    def __enter__(self) -> "RerunView":
        _connect(self._stream, self._where)
        self._stream.send_blueprint(_blueprint())
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        self._send()
        try:
            self._stream.flush(timeout_sec=_PATIENCE)
        except (RuntimeError, ValueError):  # the viewer has gone
            return
        self._stream.disconnect()

    def _work(self) -> None:
        while not self._stop.wait(_FASTEST):
            self._send()

    def _send(self) -> None:
        results = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if not results:
            return
        self._first = results[0].host if self._first is None else self._first
        self._series(results)
        self._stream.set_time("arrival", duration=(results[-1].host - self._first) / 1e9)
        self._picture(results[-1])

    def _series(self, results: list[Result]) -> None:
        """Numbers of all results."""
        assert self._first is not None
        time = rr.TimeColumn("arrival", duration=np.array([r.host - self._first for r in results]) / 1e9)

        def send(path: str, values: np.ndarray) -> None:
            rr.send_columns(path, [time], rr.Scalars.columns(scalars=values), recording=self._stream)

        for number, pad in enumerate(self._pads):
            for name in ("force", "standard_error"):
                send(f"{name}/{_path(pad)}", np.array([getattr(r, name)[number] for r in results]))
        send("latency_ms", np.array([1e3 * r.latency for r in results]))
        send("dropped", np.array([float(r.dropped) for r in results]))

    def _picture(self, result: Result) -> None:
        simulated = ", SIMULATED" if self._simulated or self._show.simulated else ""
        self._stream.log("about", rr.TextDocument(f"{self._skin}{simulated}: {self._show.state}"))
        for name, values in (("map", result.map), ("image", np.abs(result.image))):
            self._top[name] = max(0.98 * self._top[name], float(values.max()), _LEAST)
            picture = rr.DepthImage(
                self._grid.picture(values),
                colormap=rr.components.Colormap.Viridis,
                depth_range=[0.0, self._top[name]],
            )
            self._stream.log(name, picture)
        self._stream.log("map/contacts", self._contacts(result.touches))
        self._stream.log("map/centres", self._centres(result))

    def _contacts(self, touches: Touches) -> rr.LineStrips2D:
        """Ellipses of two standard errors; numbers where one points."""
        strips = [self._grid.pixels(ellipse(*at)) for at in zip(touches.position, touches.covariance, strict=True)]
        labels = [
            f"{1e3 * x:.1f}, {1e3 * y:.1f} mm ± {1e3 * dx:.1f}, {1e3 * dy:.1f}" + ("" if sure else ", a guess")
            for (x, y), (dx, dy), sure in zip(
                touches.position, np.sqrt(np.diagonal(touches.covariance, axis1=1, axis2=2)), touches.sure, strict=True
            )
        ]
        return rr.LineStrips2D(strips, labels=labels, show_labels=False, colors=_MARK)

    def _centres(self, result: Result) -> rr.Points2D:
        """Where the pads are pressed, and how hard."""
        pressed = np.isfinite(result.centre).all(1)
        labels = [f"{self._pads[n]} {result.force[n]:.1f} N" for n in np.flatnonzero(pressed)]
        return rr.Points2D(self._grid.pixels(result.centre[pressed]), labels=labels, colors=_MARK, radii=0.3)


class Grid:
    """Where pixels lie: `centres` (rows * columns, 2) m, the lowest row first; pictures have the highest on top."""

    def __init__(self, centres: np.ndarray, shape: tuple[int, ...]):
        self.shape = shape
        self._low = centres.min(0)
        self._pitch = np.ptp(centres, axis=0) / np.maximum([shape[1] - 1, shape[0] - 1], 1)

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Values of pixels -> (rows, columns) f4, the highest row first."""
        return np.ascontiguousarray(values.reshape(self.shape)[::-1], np.float32)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 2) m -> (n, 2) in such a picture, whose corner is zero."""
        column, row = ((points - self._low) / self._pitch + 0.5).T
        return np.stack([column, self.shape[0] - row], 1)


def ellipse(position: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Points (49, 2) m of the ellipse of two standard errors."""
    scale, axes = np.linalg.eigh(covariance)
    unit = np.stack([np.cos(_CORNERS), np.sin(_CORNERS)], 1)
    return position + 2.0 * (unit * np.sqrt(np.maximum(scale, 0.0))) @ axes.T


def _connect(stream: rr.RecordingStream, where: str) -> None:
    if where.endswith(".rrd"):
        if Path(where).exists():
            raise RerunError(f"{where}: exists already; choose another name")
        stream.save(where)
        return
    host, _, port = where.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), timeout=_PATIENCE):
            pass
    except (OSError, ValueError) as error:
        todo = "start it (rerun --bind 127.0.0.1), or name a file: --rerun show.rrd"
        raise RerunError(f"rerun: no viewer at {where!r} ({error}); {todo}") from error
    stream.connect_grpc(f"rerun+http://{where}/proxy")


def _path(name: str) -> str:
    """A pad's name as one part of a path."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)


def _blueprint() -> rrb.Blueprint:
    """Map and image side by side, forces below."""
    maps = rrb.Horizontal(
        rrb.Spatial2DView(origin="map", name="force map, N per pixel"),
        rrb.Spatial2DView(origin="image", name="change of conductivity, S"),
    )
    series = rrb.Horizontal(
        rrb.TimeSeriesView(origin="force", name="force, N"),
        rrb.TimeSeriesView(origin="latency_ms", name="latency, ms"),
        rrb.TextDocumentView(origin="about"),
        column_shares=[3, 2, 1],
    )
    return rrb.Blueprint(rrb.Vertical(maps, series, row_shares=[2, 1]), collapse_panels=True)
