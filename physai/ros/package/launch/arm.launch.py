"""A policy drives an arm: ros2 launch physai arm.launch.py policy_path:=/path/to/policy.pt use_virtual_robot:=true."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

WATCHDOG = "/command_watchdog"


def generate_launch_description() -> LaunchDescription:
    """Tell what can be chosen."""
    parameters = get_package_share_directory("physai") + "/config/physai.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("policy_path", description="policy.pt of a run"),
            DeclareLaunchArgument("params_file", default_value=parameters, description="parameters of all nodes"),
            switch("use_virtual_robot", "false", "instead of a real one"),
            switch("use_watchdog", "true", "a relay that stops the arm when commands stop"),
            OpaqueFunction(function=make_nodes),
        ]
    )


def switch(name: str, default: str, description: str) -> DeclareLaunchArgument:
    """Return an argument that is true or false."""
    return DeclareLaunchArgument(name, default_value=default, choices=["true", "false"], description=description)


def make_nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes that were chosen."""
    policy_path, params_file, use_virtual_robot, use_watchdog = (
        LaunchConfiguration(name).perform(context)
        for name in ("policy_path", "params_file", "use_virtual_robot", "use_watchdog")
    )
    watchdog = {"watchdog": WATCHDOG} if use_watchdog == "true" else {}
    node = {"package": "physai", "output": "screen"}
    policy = {"policy_path": policy_path} | watchdog
    nodes = [Node(executable="inference_node", parameters=[params_file, policy], **node)]
    if use_watchdog == "true":
        nodes.append(Node(executable="command_watchdog", parameters=[params_file], **node))
    if use_virtual_robot == "true":
        nodes.append(Node(executable="virtual_robot", parameters=[params_file], **node))
    return nodes
