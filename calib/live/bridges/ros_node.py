"""A node of ROS 2 that publishes live results. Needs ROS, from Python of the version for which ROS was built.

Messages go to ROS as bytes, as they stand in a bag, so of rclpy only a node and its publishers are used.
"""

from importlib import import_module
from types import ModuleType
from typing import Any

from .bridge import AbstractLiveSink, BridgeError

NODE = "jaxeit"
QUEUE = 10  # messages that ROS keeps for a slow subscriber


class RosNode(AbstractLiveSink):
    """A node with one publisher for each topic; a context manager.

    Raises:
        BridgeError: on entering, without ROS.
        ImportError: without `rosbags`.
    """

    keeps = True

    def __init__(self, name: str = NODE):
        super().__init__("tables")
        self._name = name
        self._publishers: dict[str, Any] = {}
        self._node: Any = None

    def __enter__(self) -> "RosNode":
        rclpy, signals = ros_module("rclpy"), ros_module("rclpy.signals")
        # The command line ends by its own handlers of signals.
        rclpy.init(args=[], signal_handler_options=signals.SignalHandlerOptions.NO)
        self._node = rclpy.create_node(self._name)
        return self

    def __exit__(self, *error: object) -> None:
        self._publishers.clear()
        self._node.destroy_node()
        ros_module("rclpy").shutdown()

    def open_topic(self, name: str, kind: str, latched: bool) -> None:
        package, _, message = kind.split("/")
        qos = ros_module("rclpy.qos")
        profile: Any = QUEUE
        if latched:
            profile = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers[name] = self._node.create_publisher(
            getattr(ros_module(f"{package}.msg"), message), name, profile
        )

    def send(self, topic: str, time: int, data: bytes) -> None:
        self._publishers[topic].publish(data)


def ros_module(name: str) -> ModuleType:
    """A module of ROS; raises `BridgeError` that says what to do if it is not there."""
    try:
        return import_module(name)
    except ImportError as error:
        raise BridgeError(
            f"--ros2: no module {name} ({error}); source the setup of ROS 2, and install jaxeit for the Python of ROS"
        ) from error
