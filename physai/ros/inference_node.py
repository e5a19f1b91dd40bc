"""The node that drives a robot: joint states and goals in, joint commands out, 50 times a second."""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import NameValidationException
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool

from physai.deploy import Command, ControllerConfig, Driver, Goal, State, load_policy, make_controller
from physai.deploy.goals import GoalError, accept
from physai.deploy.metadata import describe_goal
from physai.deploy.parameters import parameter
from physai.errors import UserError
from physai.ros.node import outlet
from physai.ros.node.estop_file import EmergencyStopFile
from physai.ros.node.run import StoppableNode, brief, run
from physai.ros.topics import description, goals, qos
from physai.ros.topics.commands import JointCommands
from physai.ros.topics.diagnostics import Timing, diagnose, summary
from physai.ros.topics.emergency_stop import EmergencyStopTopics
from physai.ros.topics.imu import ImuTopic
from physai.ros.topics.joint_states import JointStates
from physai.ros.topics.watched_commands import WatchedCommands
from physai.signals import Quantity

# Nodes without our settings of Fast DDS may be found only by its second heartbeat: 2.9 s were measured. And when a
# controller returns, an emergency stop or another node that commands may be found after it.
_DISCOVERY, _REDISCOVERY = 3.0, 0.5  # s
_DISK = 1.0  # s that the file of an emergency stop may take at the end
_ANY = "any"


@dataclass(frozen=True)
class InferenceConfig(ControllerConfig):
    """Parameters of the inference node: those of the controller, and these."""

    policy_path: str = parameter("", "policy.pt of a run (required)", fixed=True)
    policy_sha256: str = parameter(_ANY, "its hash, which proves where it comes from", fixed=True)
    joints: tuple[str, ...] = parameter(
        (), "joints of the commands, in the controller's order; empty: the policy's", fixed=True
    )
    rate_hz: float = parameter(50.0, "commands per second; at least the policy's rate", "Hz", 1.0, 1000.0, fixed=True)
    trigger: str = parameter("timer", "what a command answers to", choices=("timer", "joint_state"), fixed=True)
    autostart: bool = parameter(False, "drive without waiting for ~/enable", fixed=True)
    goal: tuple[float, ...] = parameter(
        (), "a goal to start with, in the policy's unit, order and frame; empty: none", "", -100.0, 100.0, fixed=True
    )
    watchdog: str = parameter(
        "", "the command_watchdog that passes commands on, such as command_watchdog; empty: none", fixed=True
    )
    watchdog_timeout: float = parameter(0.1, "a watchdog silent for this long does not answer", "s", 0.01, 10.0)


class InferenceNode(StoppableNode[InferenceConfig]):
    """A thin shell of ROS around :class:`physai.deploy.Controller`; docs/ros2.md lists its topics and services.

    Args:
        kind: Its parameters.
        arguments: ROS arguments of this node alone; None takes those of the command line.

    Raises:
        UserError: If a parameter or the policy file is wrong.
    """

    def __init__(self, kind: type[InferenceConfig] = InferenceConfig, arguments: list[str] | None = None) -> None:
        super().__init__("inference_node", kind, arguments)
        config = self.config
        self._known = time.monotonic() + _DISCOVERY  # when who else commands the robot will surely have been found
        self._arrived = time.monotonic()  # when commands reached the robot, for the last time
        policy = self.load()
        self._controller = make_controller(policy, config)
        self._goal = self.first_goal(policy)
        answers = config.trigger == "joint_state"  # else they wait for the tick, and need not wake this node
        self._robot = JointStates(self, policy.metadata.joints, self._on_joint_states if answers else None)
        self._imu = ImuTopic(self) if policy.metadata.floats else None
        self._command = Command(None, State.WAITING, ())
        self._stop_file = EmergencyStopFile(self.get_fully_qualified_name(), self.context.get_domain_id())
        self._enabled = config.autostart and not self._stop_file.unusable
        self._disabled = "not enabled"
        self._publishing = False  # whether this node has a say in what the arm does
        self._contested = False
        self._blocked: list[str] = []  # by interlocks
        self._untold, self._stopped_by = False, ""  # whether the state has changed since it was announced; and by whom
        self._answered = -math.inf  # when a joint state was answered, for the last time
        self._timing = Timing()
        joints = config.joints or policy.metadata.joints
        self._index = [joints.index(joint) for joint in policy.metadata.joints]
        self._joints = len(joints)
        self._takes_positions = policy.metadata.command.quantity is Quantity.JOINT_POSITION

        self._commands = _commands(self, len(joints), policy.metadata.command.quantity, config)
        self._states = self.create_publisher(String, "~/state", qos.LATCHED)
        self._estopped = self.create_publisher(Bool, "~/estopped", qos.LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._descriptions = self.create_publisher(String, description.TOPIC, qos.LATCHED)
        self._asked = self.create_publisher(String, goals.DESCRIPTION, qos.LATCHED)
        goal = policy.metadata.goal
        taken = self.create_subscription(goals.goal_type(goal), goals.topic(goal), self._take_goal, 1)
        self._goal_topic = taken.topic_name
        self._stop_topics = EmergencyStopTopics(self, lambda topic: self._emergency_stop(f"by {topic}"))
        self.create_service(SetBool, "~/enable", self._enable)
        self.offer("~/estop", self._estop)
        self.offer("~/reset", self._reset)
        self.offer("~/shutdown", self._shutdown)
        self.every(1.0 / config.rate_hz, self._on_timer)
        self.every(1.0, self._diagnose)
        if self._stop_file.unusable and config.autostart:
            self._disabled += f": no autostart, as an emergency stop would not outlive it: {self._stop_file.unusable}"
            self.get_logger().error(self._disabled)
        if self._stop_file.stopped:
            self._emergency_stop("before this start")
        self._announce()
        self._descriptions.publish(String(data=description.urdf(policy.metadata, self._frames())))
        self._asked.publish(String(data=describe_goal(policy.metadata)))
        self.get_logger().info(
            f"{config.policy_path} drives {list(policy.metadata.joints)} of '{policy.metadata.robot}'"
            f"{'' if self._imu else f', at most {config.max_velocity:g} rad/s'}; {self._waits_for()}"
        )

    def _frames(self) -> str:
        """What the names of this robot's frames begin with."""
        namespace = self.get_namespace().strip("/")
        return f"{namespace}/" if namespace else ""

    def _waits_for(self) -> str:
        if self._stop_file.stopped:
            return f"stopped until ~/reset ({self._stop_file.path})"
        return "starting by itself" if self._enabled else "waiting for ~/enable"

    def load(self) -> Driver:
        """Return what drives; may raise a UserError."""
        return _load(self.config)

    def first_goal(self, policy: Driver) -> Goal | None:
        """Return the goal to start with; may raise a UserError."""
        return _first_goal(self.config, policy)

    def configure(self, config: InferenceConfig) -> None:
        """Have the controller and the way to the robot take other values."""
        self._controller.configure(config)
        self._commands.timeout = config.watchdog_timeout

    # What comes in

    def _on_joint_states(self) -> None:
        self._answered = time.monotonic()
        self._timing.tick(self._answered)
        self._tick()
        self._announce_changes()

    def _take_goal(self, message: Any) -> None:
        self._goal = goals.from_message(message, self._controller.policy.metadata.goal)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not request.data:
            self._enabled, self._disabled = False, "not enabled"
            self._tick()
            self._announce_changes()
            response.success, response.message = True, "disabled: the arm stands"
            return response
        permitted, self._enabled = self._enabled, True
        obstacles = self._interlocks(time.monotonic())
        if self._command.state in (State.FAULT, State.ESTOP):
            obstacles.append(f"{self._command.state.value}: call ~/reset first")
        response.success = not obstacles
        self._enabled = permitted or response.success  # to refuse is not to take away
        response.message = "; ".join(obstacles) or "enabled"
        return response

    def _estop(self) -> tuple[bool, str]:
        self._emergency_stop("by ~/estop")
        self._stop_file.wait()
        self._announce_changes()
        return True, "stopped until ~/reset"

    def _reset(self) -> tuple[bool, str]:
        if (held := self._stop_topics.held()) is not None:
            return False, held
        self._stop_file.wait()
        self._announce_changes()  # also of a stop that has just come
        latched = self._controller.reset()
        if latched:
            self._goal = None
        self._robot.hear()
        self._tick()
        self._announce_changes()
        self._stop_file.forget()
        said = "waiting for a new goal" if latched else "nothing to reset"
        return True, "; ".join([said, *self._blocked])

    def _shutdown(self) -> tuple[bool, str]:
        self.stopped = True
        return True, ""

    def _emergency_stop(self, source: str) -> None:
        if self._command.state is State.ESTOP:  # several subscriptions hear the same message
            return
        self._publishing = True
        self._controller.emergency_stop()
        self._stopped_by = source
        try:
            self._tick()  # what tells of it comes with the next one, after the zeros of other robots on this computer
        finally:
            self._stop_file.remember()

    # What goes out

    def _on_timer(self) -> None:
        now = time.monotonic()
        if now - self._answered > 1.5 / self.config.rate_hz:
            self._timing.tick(now)
            self._robot.hear()
            self._tick()
        self._announce_changes()

    def _tick(self) -> None:
        now = time.monotonic()
        interlocks = self._interlocks(now)
        goal, self._goal = self._goal, None
        felt = {} if self._imu is None else {"imu": self._imu.take()}
        command = self._controller.update(now, self._robot.take(), goal, interlocks, **felt)
        if not self._publish(command) or self._commands.lost:
            self._controller.not_sent()
        self._forget_old_goal(now)
        before, self._command = self._command, command
        if command.state is not before.state or interlocks != self._blocked:
            self._blocked = interlocks
            self._untold = True
        if goal is not None and self._imu is None:  # velocities come many times a second
            self.get_logger().info(f"goal {goals.describe(goal, self._controller.policy.metadata.goal)}")
        for reason in command.reasons:
            if reason.startswith("goal") and self._imu is None:
                self.get_logger().warning(reason)
            elif reason.startswith(("goal", "joint state rejected", "IMU rejected")):
                self.get_logger().warning(reason, throttle_duration_sec=1.0)

    def _interlocks(self, now: float) -> list[str]:
        """Why the arm must not move, beside what the controller knows."""
        found = [] if self._enabled else [self._disabled]
        rival = self._commands.rival
        if rival is not None:
            found.append(rival)
            if self._publishing:  # it shall not go on by itself when the other one leaves
                self._controller.forget_goal()
                self._goal = None
        self._contested = rival is not None
        rivals = self._robot.rivals(now), self._imu.rivals(now) if self._imu is not None else None
        found += filter(None, rivals)
        if (silence := self._commands.silence(now)) is not None:
            found.append(silence)
        if (unheard := self._commands.unheard) is not None:
            found.append(unheard)
            self._known = max(self._known, now + _REDISCOVERY)
        elif now < self._known:
            found.append("looking for other nodes")
        elif self._enabled and not self._contested:
            self._publishing = True
        if silence is None and unheard is None:
            self._arrived = now
        return found

    def _forget_old_goal(self, now: float) -> None:
        """Who takes the arm elsewhere while no command reaches it does not expect it to go on by itself."""
        longest = self._controller.config.resume_timeout
        if not self._publishing or now - self._arrived <= longest:
            return
        forgotten = self._controller.forget_goal() or self._goal is not None
        self._goal = None
        if forgotten:
            self.get_logger().warning(f"goal forgotten: commands have not reached the robot for {longest:g} s")

    def _publish(self, command: Command) -> bool:
        # A disabled node does not disturb another one, once it stands still, and unless there is an emergency.
        stands = self._contested and not self._enabled and self._command.state is not State.ACTIVE
        silent = stands and command.state is not State.ESTOP
        if command.value is None or silent or not self._publishing:
            return False
        if self._takes_positions:
            moves = command.state is State.ACTIVE
            self._commands.still = self._in_order(self._controller.standstill if moves else command.value)
        self._commands.send(self._in_order(command.value))
        return True

    def _in_order(self, values: np.ndarray) -> list[float]:
        """Values of the policy's joints, in the controller's order; other joints stand still."""
        ordered = np.zeros(self._joints)
        ordered[self._index] = values
        return ordered.tolist()

    def _announce_changes(self) -> None:
        if self._untold and not self._stop_file.pending:
            self._announce()

    def _announce(self) -> None:
        self._untold = False
        command = self._command
        if command.state is State.ESTOP and self._stopped_by:
            self.get_logger().error(f"emergency stop {self._stopped_by}")
            self._stopped_by = ""
        self._states.publish(String(data=command.state.value))
        self._estopped.publish(Bool(data=command.state is State.ESTOP))
        self._diagnose()
        text = summary(command.state.value, command.reasons)
        if command.state in (State.FAULT, State.ESTOP):
            self.get_logger().error(text)
        elif command.state is State.HOLD:
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)

    def _diagnose(self) -> None:
        values = {
            **self._controller.snapshot(),
            **self._timing.summary(),
            "enabled": self._enabled,
            "stamp_age": self._robot.stamp_age,
            "log lines dropped": outlet.dropped_lines(),
            "emergency stop file": self._stop_file.failure or self._stop_file.unusable or self._stop_file.path,
        }
        values["counters"]["states of other joints"] = self._robot.others
        values["counters"]["emergency stop file failures"] = self._stop_file.failures
        values["counters"]["watchdog silences"] = self._commands.silences
        goal = self._controller.policy.metadata.goal
        if unheard := goals.other_types(self, self._goal_topic, goal):
            wanted = goals.goal_type(goal).__name__
            said = f"goals of this policy are a {wanted}; unheard on {self._goal_topic}: {', '.join(unheard)}"
            values["goals of another type"] = said
            self.get_logger().warning(said, throttle_duration_sec=10.0)
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(
            diagnose(self.get_fully_qualified_name().lstrip("/"), now, self._controller.policy, values)
        )

    def finish(self) -> None:
        """See that the last command that the robot got stands still."""
        try:
            if self._publishing:
                self._commands.finish()
        finally:
            self._stop_file.close(_DISK)
        self._announce_changes()


def _commands(node: InferenceNode, joints: int, quantity: Quantity, config: InferenceConfig) -> JointCommands:
    if not config.watchdog:
        return JointCommands(node, joints, quantity)
    try:
        return WatchedCommands(node, joints, quantity, config.watchdog, config.watchdog_timeout)
    except (NameValidationException, RuntimeError) as error:  # RuntimeError: RCLError
        raise UserError(f"watchdog: must be the name of a node, got '{config.watchdog}': {brief(error)}") from error


def _load(config: InferenceConfig) -> Driver:
    if not config.policy_path:
        raise UserError("policy_path: required, such as -p policy_path:=outputs/<run>/policy.pt")
    if not config.policy_sha256:
        raise UserError(f"policy_sha256: is empty; '{_ANY}' takes every file")
    policy = load_policy(config.policy_path, sha256=None if config.policy_sha256 == _ANY else config.policy_sha256)
    metadata = policy.metadata
    if config.joints and (
        len(set(config.joints)) != len(config.joints) or not set(metadata.joints) <= set(config.joints)
    ):
        raise UserError(
            f"joints: {list(config.joints)} must be distinct and hold all joints of the policy, {list(metadata.joints)}"
        )
    if metadata.command.quantity is Quantity.JOINT_POSITION and set(config.joints) - set(metadata.joints):
        raise UserError(f"joints: the policy commands positions, of {list(metadata.joints)} alone: name no others")
    if config.rate_hz < metadata.control_rate:
        raise UserError(
            f"rate_hz: must be at least that of the policy, {metadata.control_rate:g}, got {config.rate_hz}"
        )
    return policy


def _first_goal(config: InferenceConfig, policy: Driver) -> Goal | None:
    if not config.goal:
        return None
    if policy.metadata.floats:
        raise UserError("goal: a velocity is out of date before the robot stands: send them on ~/cmd_vel")
    goal = Goal(list(config.goal), policy.metadata.goal.frame)
    try:
        accept(goal, policy.metadata, config.unreachable_goal == "project")
    except GoalError as error:
        raise UserError(f"goal: {error}") from error
    return goal


def main() -> int:
    """Run the node."""
    return run(InferenceNode, "physai.ros.inference_node", __doc__ or "", InferenceConfig)


if __name__ == "__main__":
    sys.exit(main())
