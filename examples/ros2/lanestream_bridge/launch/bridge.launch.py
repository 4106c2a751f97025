"""Starts the bridge for one camera: ros2 launch lanestream_bridge bridge.launch.py camera:=/front."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Returns the node with its parameter file, in the namespace of the camera."""
    shipped = PathJoinSubstitution([FindPackageShare("lanestream_bridge"), "config", "bridge.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("camera", default_value="/camera", description="Namespace of the camera's topics."),
            DeclareLaunchArgument("parameters", default_value=shipped, description="Parameter file."),
            Node(
                package="lanestream_bridge",
                executable="bridge",
                name="lanestream_bridge",
                namespace=LaunchConfiguration("camera"),
                parameters=[LaunchConfiguration("parameters")],
                output="screen",
            ),
        ]
    )
