"""A simulated robot behind the topics of a ros2_control controller: a real one's place, without its dangers."""

import sys
import time
from dataclasses import dataclass

from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import Float64MultiArray

from physai.deploy import JointState
from physai.deploy.parameters import parameter
from physai.errors import UserError
from physai.ros.node.run import StoppableNode, run
from physai.ros.topics import joint_states, qos
from physai.ros.topics.commands import controller_topic
from physai.ros.topics.unawaited import Unawaited, nobody, waiting
from physai.ros.virtual.arm import GroupController, VirtualArm
from physai.ros.virtual.base import BaseTopics
from physai.ros.virtual.faults import FaultConfig, Faults


@dataclass(frozen=True)
class VirtualRobotConfig(FaultConfig):
    """Parameters of the virtual robot."""

    env: str = parameter("reacher", "a file of conf/env, which names the robot", fixed=True)
    overrides: tuple[str, ...] = parameter(
        (), "Hydra overrides of it, such as env.robot.command=joint_position", fixed=True
    )
    randomization: str = parameter("none", "a file of conf/randomization: its dynamics, delay and sensors", fixed=True)
    physics: str = parameter("pybullet", "a file of conf/physics: the engine", fixed=True)
    seed: int = parameter(0, "draws one robot from the randomization", "", 0, 2**31 - 1, fixed=True)
    rate_hz: float = parameter(100.0, "joint states per second, and physics steps", "Hz", 1.0, 1000.0, fixed=True)
    joints: tuple[str, ...] = parameter((), "joints of the commands, in their order; empty: the robot's", fixed=True)
    state_joints: tuple[str, ...] = parameter(
        (), "joints in joint_states, in their order; unknown ones stand still; empty: as joints", fixed=True
    )
    command_timeout: float = parameter(0.0, "a command is over after this; 0: it holds for ever", "s", 0.0, 60.0)


_COMMANDS = QoSProfile(depth=100)  # of all that have come since the last step each counts: one alone may be a bad one
_LONGEST_PAUSE = 1.0  # s that the arm makes up for; in a longer one, such as a computer's sleep, it slept, too


class VirtualRobot(StoppableNode[VirtualRobotConfig]):
    """Publishes joint_states, and obeys the commands of its robot's controller as the real one does.

    Args:
        arguments: ROS arguments of this node alone; None takes those of the command line.

    Raises:
        UserError: If a parameter is wrong.
    """

    def __init__(self, arguments: list[str] | None = None) -> None:
        super().__init__("virtual_robot", VirtualRobotConfig, arguments)
        config = self.config
        self._arm = VirtualArm(
            config.env, config.randomization, config.seed, 1.0 / config.rate_hz, config.overrides, config.physics
        )
        known = self._arm.spec.joints
        joints = config.joints or known
        if sorted(joints) != sorted(known):
            raise UserError(f"joints: must be {list(known)} in some order, got {list(joints)}")
        self._order = [joints.index(joint) for joint in known]
        self._names = config.state_joints or joints
        if len(set(self._names)) != len(self._names):
            raise UserError(f"state_joints: must be distinct, got {list(self._names)}")
        self._shown = [(i, known.index(joint)) for i, joint in enumerate(self._names) if joint in known]
        rest = self._arm.rest[[known.index(joint) for joint in joints]]
        self._controller = GroupController(rest, self._arm.spec.command, config.command_timeout)
        self._faults = Faults(config, config.seed)
        self._states = self.create_publisher(JointStateMessage, joint_states.TOPIC, 10)
        floats = self._arm.spec.floating is not None
        self._base = BaseTopics(self, self._arm.spec.base) if floats else None
        commands = controller_topic(self._arm.spec.command)
        self._commands = self.create_subscription(
            Float64MultiArray, commands, nobody, _COMMANDS, callback_group=Unawaited()
        )
        self.offer("~/reset", self._reset)
        self._period, self._at = 1.0 / config.rate_hz, time.monotonic()  # of a step, and when the last one ended
        self.every(self._period, self._step)
        self.get_logger().info(f"'{self._arm.spec.name}' takes {self._arm.spec.command.value} of {list(joints)}")

    def configure(self, config: VirtualRobotConfig) -> None:
        """Take other faults, and another timeout."""
        self._faults.config = config
        self._controller.timeout = config.command_timeout

    def _take_command(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        was = self._controller.active
        self._controller.command(message.data, qos.received_at(info))
        if was and not self._controller.active:
            self.get_logger().error(
                f"{len(message.data)} numbers for {len(self._order)} joints: inactive until ~/reset"
            )

    def _reset(self) -> tuple[bool, str]:
        for _ in waiting(self._commands):  # of before
            pass
        self._controller.activate()
        self._arm.reset()
        return True, "at home"

    def _step(self) -> None:
        for command in waiting(self._commands):
            self._take_command(*command)
        now = time.monotonic()
        self._at = max(self._at, now - _LONGEST_PAUSE)
        # An arm does not slow down with the computer that plays it.
        for _ in range(max(1, round((now - self._at) / self._period))):
            self._at += self._period
            position, velocity = self._arm.step(self._controller.value(self._at)[self._order])
        positions, velocities, efforts = ([0.0] * len(self._names) for _ in range(3))
        for place, joint in self._shown:
            positions[place], velocities[place] = float(position[joint]), float(velocity[joint])
            efforts[place] = float(self._arm.effort[joint])
        clock = self.get_clock().now()
        if self._base is not None and self._arm.base is not None:
            self._base.publish(self._arm.base, clock)
        stamp = clock.nanoseconds * 1e-9
        for state in self._faults.apply(JointState(self._names, positions, velocities, stamp, effort=efforts), now):
            message = JointStateMessage(
                name=state.names, position=state.position, velocity=state.velocity, effort=state.effort
            )
            message.header.stamp = Time(nanoseconds=round(state.stamp * 1e9)).to_msg()
            self._states.publish(message)

    def finish(self) -> None:
        """Free the physics engine."""
        self._arm.close()


def main() -> int:
    """Run the node."""
    return run(VirtualRobot, "physai.ros.virtual_robot", __doc__ or "", VirtualRobotConfig)


if __name__ == "__main__":
    sys.exit(main())
