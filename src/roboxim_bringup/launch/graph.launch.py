"""Launch the graph with ROS 2's own tools: ``ros2 launch roboxim_bringup graph.launch.py params_file:=params.yaml``.

The arguments are those of every ROS 2 package: a namespace and a file of parameters. `roboxim up` does the same without
an installed ROS 2, restarts nodes that die, and lets the commands of `roboxim` attach.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationEquals, LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

NODES = ("sim", "planner", "tasks", "recorder", "evaluator")


def generate_launch_description() -> LaunchDescription:
    """Return the five nodes, each in a process of its own."""
    namespace, file = LaunchConfiguration("namespace"), LaunchConfiguration("params_file")

    def node(name: str, condition: object, parameters: list) -> Node:
        return Node(
            package="roboxim_bringup",
            executable=name,
            name=name,
            namespace=namespace,
            parameters=parameters,
            condition=condition,
            output="screen",
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the whole graph."),
            DeclareLaunchArgument("params_file", default_value="", description="ROS 2 parameter file (YAML)."),
            *(node(name, LaunchConfigurationEquals("params_file", ""), []) for name in NODES),
            *(node(name, LaunchConfigurationNotEquals("params_file", ""), [file]) for name in NODES),
        ]
    )
