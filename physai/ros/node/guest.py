"""A node in a program that is none: other Python code, which only wants to use topics."""

from collections.abc import Sequence

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from physai.errors import UserError
from physai.ros.node.executor import Executor
from physai.ros.node.run import brief, prepare_middleware


class Guest:
    """A node and what spins it, in a ROS context of their own; signals are left alone.

    Args:
        name: Of the node.
        remap: ROS remap rules, such as ``/joint_states:=/left/joint_states``.

    Attributes:
        node: The node.
        executor: What spins it.

    Raises:
        UserError: If ROS cannot start.
    """

    def __init__(self, name: str, remap: Sequence[str] = ()) -> None:
        prepare_middleware()
        rules = [part for rule in remap for part in ("-r", rule)]
        self._context = Context()
        try:
            rclpy.init(
                args=["--ros-args", *rules], context=self._context, signal_handler_options=SignalHandlerOptions.NO
            )
        except RuntimeError as error:  # RCLError
            raise UserError(brief(error)) from error
        self.node = Node(name, context=self._context, start_parameter_services=False, enable_rosout=False)
        self.executor = Executor([self.node])

    def close(self) -> None:
        """Leave ROS."""
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self._context.try_shutdown()
