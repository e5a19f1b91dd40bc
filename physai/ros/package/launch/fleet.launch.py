"""Policies drive a fleet: ros2 launch physai fleet.launch.py policies:=/path/to/a.pt,/path/to/b.pt arms:=8.

Each arm has a namespace of its own, /arm1, /arm2 and so on, and gets the policies in turns.
"""

from itertools import cycle, islice

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

WATCHDOG = "command_watchdog"  # each robot's own: the name is relative


def generate_launch_description() -> LaunchDescription:
    """Tell what can be chosen."""
    parameters = get_package_share_directory("physai") + "/config/physai.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("policies", description="policy files, with commas between"),
            DeclareLaunchArgument("arms", default_value="8", description="how many"),
            DeclareLaunchArgument("params_file", default_value=parameters, description="parameters of all nodes"),
            DeclareLaunchArgument(
                "virtual_envs", default_value="", description="envs of virtual robots, one a policy; empty: real robots"
            ),
            OpaqueFunction(function=make_nodes),
        ]
    )


def make_nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes of all arms."""
    policies, arms, params_file, virtual_envs = (
        LaunchConfiguration(name).perform(context) for name in ("policies", "arms", "params_file", "virtual_envs")
    )
    paths = policies.split(",")
    envs = virtual_envs.split(",") if virtual_envs else [""] * len(paths)
    nodes = []
    for number, (path, env) in enumerate(islice(cycle(zip(paths, envs, strict=True)), int(arms)), 1):
        own = {"package": "physai", "output": "screen", "namespace": f"arm{number}"}
        policy = {"policy_path": path, "watchdog": WATCHDOG}
        nodes.append(Node(executable="inference_node", parameters=[params_file, policy], **own))
        nodes.append(Node(executable="command_watchdog", parameters=[params_file], **own))
        if env:
            robot = {"env": env, "seed": number}
            nodes.append(Node(executable="virtual_robot", parameters=[params_file, robot], **own))
    return nodes
