"""The ROS 2 node. Topics, all below its own name:

in   ~/map      nav_msgs/OccupancyGrid (latched)     the map
     ~/logits   std_msgs/Float64MultiArray           one number an action; asks for a decision
     TF         map_frame -> base_frame              where the robot is
out  ~/action   std_msgs/Int32                       the action to run, -1: stand
     ~/witness  nav_msgs/Path                        the certified continuation
     ~/markers  visualization_msgs/MarkerArray       regions and verdict
     /diagnostics

The robot runs an action, stops, and asks again: a step is one action, however long it takes.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import Float64MultiArray, Int32
from tf2_ros import Buffer, TransformException, TransformListener
from visualization_msgs.msg import MarkerArray

from specshield.errors import SpecshieldError
from specshield_ros import messages
from specshield_ros.logic import Logic, Pose, Told, yaw_of

TEXTS = {"rule": "", "regions": "{}", "robot": "{}", "map_frame": "map", "base_frame": "base_link"}


def types(name: str) -> Any:
    """The class of "nav_msgs/msg/Path"."""
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


class ShieldNode(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("shield")
        said = {name: self.declare_parameter(name, value).value for name, value in TEXTS.items()}
        self.frame, self.base = said["map_frame"], said["base_frame"]
        patience = float(self.declare_parameter("patience", 2.0).value)
        self.logic = Logic(said["rule"], said["regions"], said["robot"])
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(OccupancyGrid, "~/map", self.on_map, latched)
        self.create_subscription(Float64MultiArray, "~/logits", self.on_logits, 1)
        self.action = self.create_publisher(Int32, "~/action", 1)
        self.witness = self.create_publisher(Path, "~/witness", latched)
        self.markers = self.create_publisher(MarkerArray, "~/markers", latched)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.timer = self.create_timer(patience, self.on_silence)

    def on_map(self, message: OccupancyGrid) -> None:
        try:
            if self.logic.on_map(message):
                self.get_logger().info("a policy is made for the map")
        except SpecshieldError as error:
            self.get_logger().error(f"the map cannot be used: {error}")

    def on_logits(self, message: Float64MultiArray) -> None:
        pose = self.pose()
        if pose is None:
            return
        try:
            told = self.logic.on_logits(pose, list(message.data))
        except SpecshieldError as error:  # the model has said nothing, as far as patience goes
            self.get_logger().error(str(error))
            return
        self.timer.reset()
        self.tell(told)

    def on_silence(self) -> None:
        """No logits that led to a decision for `patience` seconds."""
        pose = self.pose() if self.logic.session is not None else None
        if pose is not None:
            self.tell(self.logic.silent(pose))

    def pose(self) -> Pose | None:
        try:
            found = self.buffer.lookup_transform(self.frame, self.base, Time()).transform
        except TransformException as error:
            self.get_logger().warning(f"where the robot is, is not known: {error}")
            return None
        return found.translation.x, found.translation.y, yaw_of(found.rotation)

    def tell(self, told: Told) -> None:
        stamp, shield = self.get_clock().now().to_msg(), self.logic.shield
        regions = {} if shield is None else shield.task.regions
        self.action.publish(messages.action_of(types, told))
        self.witness.publish(messages.path_of(types, told, self.frame, stamp))
        self.markers.publish(messages.markers_of(types, regions, told, self.frame, stamp))
        self.diagnostics.publish(messages.diagnostics_of(types, told, stamp))


def main() -> None:
    rclpy.init()
    node = ShieldNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
