"""Live results in rerun (https://rerun.io), a viewer that is common in robotics: the optional extra ``viewer``.

Map, image and contacts are drawn in pixels, because the two-dimensional views of rerun are; forces are series, one for
each pad. A separate thread sends the forces of every frame and pictures of the newest, so that no frame waits for it.
"""

import socket
import threading
from collections import deque
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ...calibration.calibration import Calibration
from ...calibration.localisation.ellipses import confidence_ellipse
from ...calibration.logs.calibration import LogCalibration
from ..loop import LiveControl
from ..results import FrameResult, Result, TouchEstimates

VIEWER = "127.0.0.1:9876"
SERIES: tuple[str, ...] = ("force", "standard_error")  # of each pad
MIN_PICTURE_INTERVAL = 0.1  # s between two pictures, which take milliseconds to pack
MAX_WAITING_RESULTS = 4096  # while the thread gets no processor time
VIEWER_TIMEOUT = 2.0  # s for a viewer to answer, and to receive the last results
MIN_COLOUR_RANGE = 1e-30  # upper end of a range of colours, which must not be empty
MARK_COLOUR = (194, 47, 69)


class RerunError(ValueError):
    """Results cannot be sent to the viewer or the file."""


class RerunView:
    """Sends results to a viewer that runs at ``HOST:PORT``, or to a file ``*.rrd``; a context manager.

    `show_result` returns at once.

    Raises:
        RerunError: on entering, if no viewer answers, or the file exists.
    """

    def __init__(self, calibration: Calibration | LogCalibration, control: LiveControl, where: str = VIEWER):
        self._control, self._simulated = control, calibration.simulated
        if isinstance(calibration, LogCalibration):
            self._skin, self._pads, self._shown = calibration.stream, [calibration.stream], (*SERIES, "low", "high")
            self._grid: Grid | None = None
        else:
            self._skin, self._pads = calibration.skin.name, [pad.name for pad in calibration.skin.pads]
            self._shown, self._grid = SERIES, Grid(np.asarray(calibration.recon.centres), calibration.recon.shape)
        self._where = where
        self._stream = rr.RecordingStream("jaxeit")
        self._waiting: deque[Result] = deque(maxlen=MAX_WAITING_RESULTS)
        self._stop = threading.Event()
        self._first: int | None = None
        self._top = {"map": MIN_COLOUR_RANGE, "image": MIN_COLOUR_RANGE}
        self._thread = threading.Thread(target=self._work, name="rerun", daemon=True)

    def show_result(self, result: Result) -> None:
        """Hand over a result; returns at once."""
        self._waiting.append(result)

    def __enter__(self) -> "RerunView":
        _connect(self._stream, self._where)
        self._stream.send_blueprint(_blueprint(maps=self._grid is not None))
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()
        self._send()
        try:
            self._stream.flush(timeout_sec=VIEWER_TIMEOUT)
        except (RuntimeError, ValueError):  # the viewer was closed
            return
        self._stream.disconnect()

    def _work(self) -> None:
        while not self._stop.wait(MIN_PICTURE_INTERVAL):
            self._send()

    def _send(self) -> None:
        results = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if not results:
            return
        self._first = results[0].host if self._first is None else self._first
        self._series(results)
        self._stream.set_time("arrival", duration=(results[-1].host - self._first) / 1e9)
        self._about()
        if isinstance(results[-1], FrameResult) and self._grid is not None:
            self._picture(results[-1], self._grid)

    def _series(self, results: list[Result]) -> None:
        """Send the forces, latencies and counts of all results."""
        assert self._first is not None
        time = rr.TimeColumn("arrival", duration=np.array([r.host - self._first for r in results]) / 1e9)

        def send(path: str, values: np.ndarray) -> None:
            rr.send_columns(path, [time], rr.Scalars.columns(scalars=values), recording=self._stream)

        for number, pad in enumerate(self._pads):
            for name in self._shown:
                send(f"{name}/{_path(pad)}", np.array([getattr(r, name)[number] for r in results]))
        send("latency_ms", np.array([1e3 * r.latency for r in results]))
        send("dropped", np.array([float(r.dropped) for r in results]))

    def _about(self) -> None:
        simulated = ", SIMULATED" if self._simulated or self._control.simulated else ""
        state = "; ".join((self._control.state, *self._control.faults))
        self._stream.log("about", rr.TextDocument(f"{self._skin}{simulated}: {state}"))

    def _picture(self, result: FrameResult, grid: "Grid") -> None:
        for name, values in (("map", result.map), ("image", np.abs(result.image))):
            self._top[name] = max(0.98 * self._top[name], float(values.max()), MIN_COLOUR_RANGE)
            picture = rr.DepthImage(
                grid.picture(values),
                colormap=rr.components.Colormap.Viridis,
                depth_range=[0.0, self._top[name]],
            )
            self._stream.log(name, picture)
        self._stream.log("map/contacts", self._contacts(result.touches, grid))
        self._stream.log("map/centres", self._centres(result, grid))

    def _contacts(self, touches: TouchEstimates, grid: "Grid") -> rr.LineStrips2D:
        """Contacts as ellipses of 90 %, with coordinates as labels."""
        strips = [grid.pixels(confidence_ellipse(*at)) for at in zip(touches.position, touches.covariance, strict=True)]
        errors, names = np.sqrt(np.diagonal(touches.covariance, axis1=1, axis2=2)), _names(touches)
        labels = [
            f"{name}{1e3 * x:.1f}, {1e3 * y:.1f} mm ± {1e3 * dx:.1f}, {1e3 * dy:.1f}" + ("" if sure else ", a guess")
            for name, (x, y), (dx, dy), sure in zip(names, touches.position, errors, touches.sure, strict=True)
        ]
        return rr.LineStrips2D(strips, labels=labels, show_labels=False, colors=MARK_COLOUR)

    def _centres(self, result: FrameResult, grid: "Grid") -> rr.Points2D:
        """Centre and size of the force on each pressed pad."""
        pressed = np.isfinite(result.centre).all(1)
        labels = [f"{self._pads[n]} {result.force[n]:.1f} N" for n in np.flatnonzero(pressed)]
        return rr.Points2D(grid.pixels(result.centre[pressed]), labels=labels, colors=MARK_COLOUR, radii=0.3)


def _names(touches: TouchEstimates) -> list[str]:
    """Number and force of contacts that are followed, as the beginning of a label."""
    if touches.number is None:
        return [""] * len(touches.position)
    return [f"{number}: {force:.1f} N, " for number, force in zip(touches.number, touches.force, strict=True)]


class Grid:
    """Grid of pixels: `centres` (rows * columns, 2) m, the lowest row first; pictures have the highest row on top."""

    def __init__(self, centres: np.ndarray, shape: tuple[int, ...]):
        self.shape = shape
        self._low = centres.min(0)
        self._pitch = np.ptp(centres, axis=0) / np.maximum([shape[1] - 1, shape[0] - 1], 1)

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Values of pixels as a picture (rows, columns) f4, the highest row first."""
        return np.ascontiguousarray(values.reshape(self.shape)[::-1], np.float32)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 2) m in coordinates of a picture (n, 2), in pixels from its upper left corner."""
        column, row = ((points - self._low) / self._pitch + 0.5).T
        return np.stack([column, self.shape[0] - row], 1)


def _connect(stream: rr.RecordingStream, where: str) -> None:
    if where.endswith(".rrd"):
        if Path(where).exists():
            raise RerunError(f"{where}: exists already; choose another name")
        stream.save(where)
        return
    host, _, port = where.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), timeout=VIEWER_TIMEOUT):
            pass
    except (OSError, ValueError, OverflowError) as error:
        todo = "start it (rerun --bind 127.0.0.1), or name a file: --rerun show.rrd"
        raise RerunError(f"rerun: no viewer at {where!r} ({error}); {todo}") from error
    stream.connect_grpc(f"rerun+http://{where}/proxy")


def _path(name: str) -> str:
    """The name of a pad as one part of a path."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)


def _blueprint(*, maps: bool) -> rrb.Blueprint:
    """Layout of the viewer: map and image side by side, forces below; without maps forces alone."""
    pictures = rrb.Horizontal(
        rrb.Spatial2DView(origin="map", name="force map, N per pixel"),
        rrb.Spatial2DView(origin="image", name="change of conductivity, S"),
    )
    series = rrb.Horizontal(
        rrb.TimeSeriesView(origin="force", name="force, N"),
        rrb.TimeSeriesView(origin="latency_ms", name="latency, ms"),
        rrb.TextDocumentView(origin="about"),
        column_shares=[3, 2, 1],
    )
    whole = rrb.Vertical(pictures, series, row_shares=[2, 1]) if maps else series
    return rrb.Blueprint(whole, collapse_panels=True)
