"""Messages of ROS 2 for a force map: pictures, points, wrenches, frames of coordinates and labelled numbers."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .mcap_writer import stamp_of
from .message_sink import AbstractMessageSink

IMAGE = "sensor_msgs/msg/Image"
POINTS = "sensor_msgs/msg/PointCloud2"
WRENCH = "geometry_msgs/msg/WrenchStamped"
NUMBERS = "std_msgs/msg/Float64MultiArray"
FLAGS = "std_msgs/msg/UInt16"
FRAMES = "tf2_msgs/msg/TFMessage"


class LabelledAxis(NamedTuple):
    """An axis of labelled numbers."""

    label: str
    size: int


def header(sink: AbstractMessageSink, time: int, frame: str) -> Any:
    """Stamp, from ns since 1970, and frame of coordinates."""
    return sink.types["std_msgs/msg/Header"](stamp_of(sink, time), frame)


def image(sink: AbstractMessageSink, head: Any, values: Float[np.ndarray, "rows columns"]) -> Any:
    """A picture of the encoding 32FC1, the first row on top."""
    data = np.ascontiguousarray(values, "<f4")
    rows, columns = data.shape
    return sink.types[IMAGE](head, rows, columns, "32FC1", 0, 4 * columns, data.view(np.uint8).ravel())


def point_cloud(sink: AbstractMessageSink, head: Any, points: np.ndarray) -> Any:
    """Points from an array of records (n,) whose fields are all float32; NaN is allowed."""
    field = sink.types["sensor_msgs/msg/PointField"]
    names = points.dtype.names or ()
    fields = [field(name, 4 * place, field.FLOAT32, 1) for place, name in enumerate(names)]
    step, data = points.dtype.itemsize, points.view(np.uint8)
    return sink.types[POINTS](head, 1, len(points), fields, False, step, step * len(points), data, False)


def wrench(sink: AbstractMessageSink, head: Any, push: float) -> Any:
    """A load of so many N that pushes into the sheet: against z of its frame, which points out of the sheet."""
    vector = sink.types["geometry_msgs/msg/Vector3"]
    load = sink.types["geometry_msgs/msg/Wrench"](vector(0.0, 0.0, -push), vector(0.0, 0.0, 0.0))
    return sink.types[WRENCH](head, load)


def numbers(sink: AbstractMessageSink, values: np.ndarray, *axes: LabelledAxis) -> Any:
    """Float64 numbers with a label for each axis, the last of which runs fastest."""
    kind, stride = sink.types["std_msgs/msg/MultiArrayDimension"], 1
    dims: list[Any] = []
    for axis in reversed(axes):
        stride *= axis.size
        dims.insert(0, kind(axis.label, axis.size, stride))
    layout = sink.types["std_msgs/msg/MultiArrayLayout"](dims, 0)
    return sink.types[NUMBERS](layout, np.ascontiguousarray(values, np.float64).ravel())


def flags(sink: AbstractMessageSink, value: int) -> Any:
    """Flags of a sample."""
    return sink.types[FLAGS](value)


def frames(sink: AbstractMessageSink, head: Any, names: list[str], points: np.ndarray, normals: np.ndarray) -> Any:
    """Frames of coordinates at points (n, 3) m, z along the normals (n, 3)."""
    vector, turn = sink.types["geometry_msgs/msg/Vector3"], sink.types["geometry_msgs/msg/Quaternion"]
    kind, place = sink.types["geometry_msgs/msg/TransformStamped"], sink.types["geometry_msgs/msg/Transform"]
    found = [
        kind(head, name, place(vector(*point.tolist()), turn(*turn_to(normal).tolist())))
        for name, point, normal in zip(names, points, normals, strict=True)
    ]
    return sink.types[FRAMES](found)


def turn_to(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """The smallest rotation that takes z to this direction, as a quaternion x, y, z, w; a half turn about x for -z.

    The quaternion of the rotation from a to b is (a x b, 1 + a . b), normalised.
    """
    x, y, z = normal / np.linalg.norm(normal)
    turn = np.array([-y, x, 0.0, 1 + z])
    length = np.linalg.norm(turn)
    return np.array([1.0, 0.0, 0.0, 0.0]) if length < 1e-7 else turn / length
