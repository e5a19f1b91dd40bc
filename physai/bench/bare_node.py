"""What rclpy alone can do: a node that publishes by a 50 Hz timer, and one message for each joint state."""

import contextlib
import sys
from array import array

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from physai.ros.node.run import prepare_middleware
from physai.ros.topics import qos


def main() -> None:
    """Run it until a signal comes."""
    prepare_middleware()
    rclpy.init(args=sys.argv)
    node = rclpy.create_node("bare_node")
    message = Float64MultiArray(data=array("d", [0.0, 0.0]))
    by_timer = node.create_publisher(Float64MultiArray, "~/by_timer", qos.COMMAND)
    by_state = node.create_publisher(Float64MultiArray, "~/by_state", qos.COMMAND)
    node.create_timer(0.02, lambda: by_timer.publish(message), clock=Clock(clock_type=ClockType.STEADY_TIME))
    node.create_subscription(JointState, "/joint_states", lambda _: by_state.publish(message), qos.SENSOR)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    main()
