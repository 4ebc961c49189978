"""Where messages of ROS 2 go: a bag, a node of ROS, or a server."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any


class AbstractMessageSink(ABC):
    """Takes messages of ROS 2. ``types`` has the classes of `rosbags` for messages, by name."""

    types: Mapping[str, Any]

    @abstractmethod
    def topic(self, name: str, kind: str, *, latched: bool = False) -> str:
        """Declare a topic of messages such as ``sensor_msgs/msg/Image``; returns its name.

        Args:
            latched: whether whoever subscribes later still receives the last message, as of /tf_static.
        """

    @abstractmethod
    def write(self, topic: str, time: int, message: Any) -> None:
        """Add a message at a time, ns since 1970."""
