"""ros2 launch specshield_ros shield.launch.py [params:=my.yaml] [logits:=/model/logits] [map:=/map]"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

DEFAULTS = str(Path(get_package_share_directory("specshield_ros")) / "config" / "shield.yaml")


def generate_launch_description():
    arguments = {"params": DEFAULTS, "logits": "/model/logits", "map": "/map"}
    node = Node(
        package="specshield_ros",
        executable="shield",
        name="shield",
        output="screen",
        parameters=[LaunchConfiguration("params")],
        remappings=[(f"~/{name}", LaunchConfiguration(name)) for name in ("logits", "map")],
    )
    return LaunchDescription(
        [*(DeclareLaunchArgument(k, default_value=v) for k, v in arguments.items()), node]
    )
