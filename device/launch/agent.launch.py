"""`ros2 launch iort_agent agent.launch.py config:=/etc/iort/car.yaml`."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

# Longer than the agent takes to get its last acknowledgements.
END_S = "15"


def generate_launch_description() -> LaunchDescription:
    """The agent as one node, which remappings and namespaces of a launch file around this one reach."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="the agent's YAML file, car.yaml"),
            DeclareLaunchArgument("node_name", default_value="iort_agent", description="the node's name"),
            DeclareLaunchArgument("namespace", default_value="", description="the node's namespace"),
            DeclareLaunchArgument(
                "log_level",
                default_value="",
                description="debug, info, warning or error, instead of the file's",
            ),
            Node(
                package="iort_agent",
                executable="iort-agent",
                name=LaunchConfiguration("node_name"),
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    {"config": LaunchConfiguration("config"), "log_level": LaunchConfiguration("log_level")}
                ],
                output="screen",
                sigterm_timeout=END_S,
            ),
        ]
    )
