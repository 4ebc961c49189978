"""Live results as messages of ROS 2: to a node of ROS (`ros`) or to Foxglove (`foxglove`).

The messages are those of `jaxeit export mcap`. Libraries are imported when a bridge is opened.
"""

from .bridge import AbstractLiveSink, Bridge, BridgeError
from .foxglove_server import FoxgloveServer
from .ros_node import RosNode

__all__ = ["AbstractLiveSink", "Bridge", "BridgeError", "FoxgloveServer", "RosNode"]
