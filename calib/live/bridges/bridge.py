"""Live results as messages of ROS 2, sent by a thread of their own so that no frame waits for them."""

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from ...calibration.application.places_in_space import normals_in_space, pad_centres, points_in_space
from ...calibration.calibration import Calibration
from ...calibration.logs.calibration import LogCalibration
from ...export.force_map_topics import ForceMapTopics, SkinLayout
from ...export.mcap_writer import require_frame, topic_prefix
from ...export.message_sink import AbstractMessageSink
from ...session.importers.child import library
from ..results import FrameResult, Result, TouchEstimates

MAX_WAITING_RESULTS = 1024  # while the thread gets no processor time; the oldest are dropped
PLACES_INTERVAL = 1.0  # s after which the places of the pads are sent again to sinks that keep no message


class BridgeError(ValueError):
    """Results cannot be sent to the other program."""


class AbstractLiveSink(AbstractMessageSink):
    """A sink of messages as bytes in CDR, the encoding of ROS 2; a context manager.

    ``keeps`` says whether the sink gives its last message of a latched topic to whoever subscribes later.

    Raises:
        ImportError: without `rosbags`, which encodes the messages.
    """

    keeps: bool

    def __init__(self, extra: str):
        typesys = library("rosbags.typesys", extra)
        self.store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self.types = self.store.types
        self._kinds: dict[str, str] = {}

    def topic(self, name: str, kind: str, *, latched: bool = False) -> str:
        self._kinds[name] = kind
        self.open_topic(name, kind, latched)
        return name

    def write(self, topic: str, time: int, message: Any) -> None:
        self.send(topic, time, bytes(self.store.serialize_cdr(message, self._kinds[topic])))

    @abstractmethod
    def open_topic(self, name: str, kind: str, latched: bool) -> None:
        """Open a topic for messages of a kind."""

    @abstractmethod
    def send(self, topic: str, time: int, data: bytes) -> None:
        """Send an encoded message at a time, ns since 1970."""

    @abstractmethod
    def __enter__(self) -> "AbstractLiveSink": ...

    @abstractmethod
    def __exit__(self, *error: object) -> None: ...


class Bridge:
    """Sends results to a sink as the topics of a force map (docs/ros.md); a context manager.

    `show_result` returns at once. Numbers of every result are sent; pictures only of the newest one that waits. The
    stamp of a message is the arrival of its frame. What live results do not tell is NaN: the standard errors of pixels,
    whether the shape comes from the image, and the force of contacts that are not followed.

    Args:
        prefix: the topics' first part.
        frame_id: the frame of coordinates in which the skin lies.
        track: whether contacts are followed.
        warn: called with one line if the sink fails; nothing more is then sent.

    Raises:
        BridgeError: for the calibration of a log, which has no force map.
        ValueError: for a prefix or a frame that ROS does not take.
    """

    def __init__(
        self,
        calibration: Calibration | LogCalibration,
        sink: AbstractLiveSink,
        *,
        prefix: str = "/skin",
        frame_id: str = "skin",
        track: bool = False,
        warn: Callable[[str], object] = lambda line: None,
    ):
        if isinstance(calibration, LogCalibration):
            raise BridgeError("live: the calibration of a log has no force map to send; use --publish or --rerun")
        self._sink, self._track, self._warn = sink, track, warn
        self._contacts = calibration.locator is not None and not track
        self._pixels, self._pads = len(calibration.masks.areas), len(calibration.skin.pads)
        prefix, frame_id = topic_prefix(prefix), require_frame(frame_id)
        self._topics = ForceMapTopics(sink, layout_of(calibration), prefix, frame_id)
        self._waiting: deque[Result] = deque(maxlen=MAX_WAITING_RESULTS)
        self._news, self._stop = threading.Event(), threading.Event()
        self._since_monotonic = time.time_ns() - time.monotonic_ns()
        self._places_sent = -np.inf
        self._thread = threading.Thread(target=self._work, name="bridge", daemon=True)

    def show_result(self, result: Result) -> None:
        """Hand over a result; returns at once."""
        self._waiting.append(result)
        self._news.set()

    def __enter__(self) -> "Bridge":
        with ExitStack() as opened:
            opened.enter_context(self._sink)
            self._topics.declare(contacts=self._contacts, tracks=self._track)
            self._send_places()
            self._close = opened.pop_all().close
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._news.set()
        self._thread.join()
        self._close()

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                self._news.wait(PLACES_INTERVAL)
                self._news.clear()
                self._send()
            self._send()
        except Exception as error:  # of whatever library: the force maps go on without it
            self._warn(f"{type(self._sink).__name__}: {error}; nothing more is sent")

    def _send(self) -> None:
        if not self._sink.keeps and time.monotonic() - self._places_sent > PLACES_INTERVAL:
            self._send_places()
        results = [self._waiting.popleft() for _ in range(len(self._waiting))]
        for number, result in enumerate(results):
            assert isinstance(result, FrameResult)
            self._send_result(result, pictures=number + 1 == len(results))

    def _send_places(self) -> None:
        self._topics.write_places(time.time_ns())
        self._places_sent = time.monotonic()

    def _send_result(self, result: FrameResult, *, pictures: bool) -> None:
        stamp = result.host + self._since_monotonic
        unknown = np.full(self._pads, np.nan)
        pads = {
            "pad_force": result.force,
            "pad_force_se": result.standard_error,
            "pad_force_half": result.half_width,
            "pad_valid": result.valid,
            "shape_valid": unknown,
        }
        self._topics.write_pads(stamp, pads)
        if self._contacts:
            found = result.touches.position
            places = {"contact_position": found, "contact_force": np.full(len(found), np.nan)}
            self._topics.write_contacts(stamp, places)
        if self._track:
            self._topics.write_tracks(stamp, tracks_of(result.touches))
        if pictures:
            maps = {"force": result.map, "force_se": np.full(self._pixels, np.nan)}
            self._topics.write_pictures(stamp, maps)


def layout_of(calibration: Calibration) -> SkinLayout:
    """Where the skin of a calibration lies."""
    skin, recon = calibration.skin, calibration.recon
    areas, pads = np.asarray(recon.areas, float), pad_centres(skin)
    rows, columns = recon.shape
    return SkinLayout(
        rows,
        columns,
        areas,
        points_in_space(skin.surface, np.asarray(recon.centres, float), areas > 0),
        [pad.name for pad in skin.pads],
        points_in_space(skin.surface, pads),
        normals_in_space(skin.surface, pads),
    )


def tracks_of(touches: TouchEstimates) -> dict[str, np.ndarray]:
    """Contacts that are followed under the names of `calib.export.force_map_topics.TRACK_COLUMNS`."""
    number = np.zeros(0) if touches.number is None else np.asarray(touches.number, float)
    count = len(number)
    known = {
        "position": touches.position,
        "position_covariance": touches.covariance,
        "force": touches.force,
        "force_se": touches.force_error,
        "half": touches.half,
    }
    found = {name: np.asarray(values, float)[:count] for name, values in known.items()}
    return found | {"number": number, "width": np.full(count, np.nan), "velocity": np.full((count, 2), np.nan)}
