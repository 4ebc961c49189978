"""Topics of ROS 2 for a force map: pictures, points, wrenches and tables of each frame, for a bag or a live bridge."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from . import mcap_messages as ros
from .mcap_writer import topic_names
from .message_sink import AbstractMessageSink

PAD_COLUMNS = {
    "pad_force": "force_N",
    "pad_force_se": "standard_error_N",
    "pad_force_half": "half_90_percent_N",
    "pad_valid": "pressure_valid",
    "shape_valid": "shape_valid",
}
"""Arrays of a force map with a row of pads for each frame, and what the raw message calls them."""

PLACE_COLUMNS = {"contact_position": ("x_m y_m", (2,)), "contact_force": ("force_N", ())}
"""The same for contacts that a correction by location finds in each frame alone, with the shape of an entry."""

TRACK_COLUMNS = {
    "number": ("number", ()),
    "position": ("x_m y_m", (2,)),
    "position_covariance": ("xx_m2 xy_m2 yx_m2 yy_m2", (2, 2)),
    "width": ("width_m", ()),
    "force": ("force_N", ()),
    "force_se": ("standard_error_N", ()),
    "half": ("half_x_m half_y_m", (2,)),
    "velocity": ("velocity_x_m_s velocity_y_m_s", (2,)),
}
"""The same for contacts that were followed (`apply --track`)."""

PICTURES = ("force", "force_se")
POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "force", "force_se", "pressure")])


class SkinLayout(NamedTuple):
    """Where a skin lies.

    | meaning                                                     | shape       | unit |
    |-------------------------------------------------------------|-------------|------|
    | rows, columns of the map                                    | ()          |      |
    | areas of the pixels; 0: off the sheet                       | (pixels,)   | m^2  |
    | points: centres of the pixels in space                      | (pixels, 3) | m    |
    | pads: names                                                 | (pads,)     |      |
    | pad_points, pad_normals: centres of the pads, and normals   | (pads, 3)   | m, 1 |
    """

    rows: int
    columns: int
    areas: np.ndarray
    points: np.ndarray
    pads: list[str]
    pad_points: np.ndarray
    pad_normals: np.ndarray


class ForceMapTopics:
    """Writes force maps to a sink, frame by frame. `declare` comes first."""

    def __init__(self, sink: AbstractMessageSink, layout: SkinLayout, prefix: str, frame: str):
        self._sink, self._layout, self._frame = sink, layout, frame
        self._on = layout.areas > 0
        self._areas, self._cloud = layout.areas[self._on], np.zeros(int(self._on.sum()), POINT)
        for name, values in zip("xyz", layout.points[self._on].T, strict=True):
            self._cloud[name] = values
        self._topics = {
            name: f"{prefix}/{name}" for name in ("force_map", "taxels", "pad_forces", "contacts", "tracks")
        }
        pads = topic_names(layout.pads, "pad")
        self._wrenches = [f"{prefix}/pads/{pad}/wrench" for pad in pads]
        self._frame_names = [f"{frame}_{pad}" for pad in pads]

    def declare(self, *, contacts: bool, tracks: bool) -> None:
        """Declare the topics.

        Args:
            contacts: whether contacts are found in each frame alone.
            tracks: whether contacts are followed.
        """
        self._sink.topic("/tf_static", ros.FRAMES, latched=True)
        kinds = {"force_map": ros.IMAGE, "taxels": ros.POINTS, "pad_forces": ros.NUMBERS}
        kinds |= {"contacts": ros.NUMBERS} if contacts else {}
        kinds |= {"tracks": ros.NUMBERS} if tracks else {}
        for name, kind in kinds.items():
            self._sink.topic(self._topics[name], kind)
        for name in self._wrenches:
            self._sink.topic(name, ros.WRENCH)

    def write_places(self, time: int) -> None:
        """Write the frames of coordinates of the pads, at a time in ns since 1970 as all others."""
        head = ros.header(self._sink, time, self._frame)
        layout = self._layout
        message = ros.frames(self._sink, head, self._frame_names, layout.pad_points, layout.pad_normals)
        self._sink.write("/tf_static", time, message)

    def write_pictures(self, time: int, values: Mapping[str, np.ndarray]) -> None:
        """Write the map as a picture and as points, from the arrays `PICTURES`, (pixels,) N each."""
        sink, head, layout = self._sink, ros.header(self._sink, time, self._frame), self._layout
        # Rows of the map go along +y, rows of a picture downwards: +y is up on the screen.
        picture = values["force"].reshape(layout.rows, layout.columns)[::-1]
        sink.write(self._topics["force_map"], time, ros.image(sink, head, picture))
        cloud = self._cloud
        for name in PICTURES:
            cloud[name] = values[name][self._on]
        cloud["pressure"] = values["force"][self._on] / self._areas
        sink.write(self._topics["taxels"], time, ros.point_cloud(sink, head, cloud))

    def write_pads(self, time: int, values: Mapping[str, np.ndarray]) -> None:
        """Write the wrenches and the table of the pads, from the arrays of `PAD_COLUMNS`, (pads,) each."""
        table = _table([values[name] for name in PAD_COLUMNS])
        self._write_table("pad_forces", time, table, "pad", PAD_COLUMNS.values())
        for topic, frame, force in zip(self._wrenches, self._frame_names, table[:, 0].tolist(), strict=True):
            head = ros.header(self._sink, time, frame)
            self._sink.write(topic, time, ros.wrench(self._sink, head, force))

    def write_contacts(self, time: int, values: Mapping[str, np.ndarray]) -> None:
        """Write contacts that were found in the frame alone, from the arrays of `PLACE_COLUMNS`, (contacts, ...)."""
        found = _table([values[name] for name in PLACE_COLUMNS])
        self._write_table("contacts", time, found, "contact", [label for label, _ in PLACE_COLUMNS.values()])

    def write_tracks(self, time: int, values: Mapping[str, np.ndarray]) -> None:
        """Write contacts that are followed, from the arrays of `TRACK_COLUMNS`; a table of no rows: there is none."""
        table = _table([values[name] for name in TRACK_COLUMNS])
        self._write_table("tracks", time, table, "contact", [label for label, _ in TRACK_COLUMNS.values()])

    def _write_table(self, name: str, time: int, table: np.ndarray, rows: str, columns: Iterable[str]) -> None:
        axes = (ros.LabelledAxis(rows, len(table)), ros.LabelledAxis(" ".join(columns), table.shape[1]))
        self._sink.write(self._topics[name], time, ros.numbers(self._sink, table, *axes))


def _table(columns: list[np.ndarray]) -> np.ndarray:
    """Arrays (rows, ...) side by side as float64 (rows, columns)."""
    rows = len(columns[0])
    parts = [column.astype(np.float64).reshape(rows, int(np.prod(column.shape[1:]))) for column in columns]
    return np.concatenate(parts, 1)
