"""A robot behind ROS topics where a physics engine is expected: the same task, on what moves by itself."""

import math
import os
import time
import weakref
from typing import Annotated

import numpy as np
from pydantic import Field

from physai.config import PositiveFloat
from physai.errors import UserError
from physai.physics import DynamicsParameters, RobotState
from physai.robots import RobotSpec
from physai.ros.bridge.robot_link import RobotError, RobotLink
from physai.signals import Quantity

_HOME = 0.02  # rad; a joint this near to where it shall start is there
_SETTLED = 5  # control periods there, standing still, until the episode starts
_SILENCE = 0.1  # s, or two periods: a caller who pauses for longer does not look where the arm goes
_GAIN = 5.0  # 1/s; homing slows down in the last homing_speed / _GAIN rad


_in_charge: dict[tuple[str, ...], "weakref.ref[RosPhysics]"] = {}  # of each robot that this process has to do with


class RosPhysics:
    """One robot, simulated or real, in real time; the interface is :class:`physai.physics.Physics`.

    Commands are passed on as they are: limits are the robot's own. Whatever goes wrong ends with zero velocity, and so
    does a pause of the caller. No observation is ever made up: without a fresh joint state there is an error. There is
    one robot: another of these in the same process takes it over, and closes the one before.

    Args:
        spec: The robot; commands are in the order of its joints, joint states are mapped by name.
        num_robots: 1.
        control_dt: Control period, s.
        substeps: Of no meaning here: time passes by itself.
        homing_speed: Of the fastest joint on the way to the start of an episode, rad/s.
        state_timeout: For how long after the end of a period a joint state may keep us waiting, s.
        reset_service: A std_srvs/Trigger service that puts a virtual robot home, if anyone offers it; null for none.
        remap: ROS remap rules, such as ``/joint_states:=/left/joint_states``.

    Raises:
        UserError: If more robots are asked for, there is no robot, or somebody else commands it.
    """

    simulated = False

    def __init__(
        self,
        spec: RobotSpec,
        num_robots: int,
        control_dt: float,
        substeps: int,
        homing_speed: PositiveFloat,
        state_timeout: PositiveFloat,
        reset_service: str | None,
        remap: list[Annotated[str, Field(pattern="^.+:=.+$")]],
    ) -> None:
        if num_robots != 1:
            raise UserError(f"there is one robot behind ROS, not {num_robots}")
        spec.need_fixed_base("driving")
        if homing_speed > spec.velocity_limit.min():
            raise UserError(
                f"env.physics.homing_speed: {homing_speed} rad/s is beyond the limit of '{spec.name}', "
                f"{spec.velocity_limit.min():g} rad/s"
            )
        if spec.command is not Quantity.JOINT_VELOCITY:
            raise UserError(f"a robot behind ROS is driven by joint_velocity here, not by {spec.command.value}")
        self.num_robots = num_robots
        robot = (os.environ.get("ROS_DOMAIN_ID", "0"), *sorted(remap))
        if (before := _in_charge.get(robot, lambda: None)()) is not None:
            before.close()
        self._continuous = spec.continuous
        self._dt, self._speed, self._timeout = control_dt, homing_speed, state_timeout
        self._link = RobotLink(spec.joints, max(_SILENCE, 2 * control_dt), reset_service, remap)
        self._finalizer = weakref.finalize(self, self._link.close)  # also when Python ends
        try:
            self._link.wait_ready()
            self._state = self._link.state(-math.inf, state_timeout)
        except BaseException:
            self.close()
            raise
        self._deadline = -math.inf
        _in_charge[robot] = weakref.ref(self)

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        """Bring the arm to a pose [1, n], rad, where it stands; see :meth:`physai.physics.Physics.reset`.

        Raises:
            UserError: If velocities or dynamics are asked for.
            RobotError: If the arm does not get there in time.
        """
        if parameters is not None:
            raise UserError("the dynamics of a robot behind ROS cannot be set; choose randomization=none")
        if state.joint_velocity.any():
            raise UserError("a robot behind ROS starts from rest")
        if not len(rows):
            return
        self._check_open()
        self._link.wait_ready()
        after = self._link.stop()
        if self._link.reset():
            after = time.monotonic()
        self._state = self._link.state(after, self._timeout)
        self._drive(state.joint_position[0])

    def _drive(self, goal: np.ndarray) -> None:
        """Go to a pose [n], rad, in a straight line of joint space, and stand there."""
        limit = 5.0 + 2.0 * float(np.abs(self._way(goal)).max()) / self._speed
        end = time.monotonic() + limit
        settled = 0
        while settled < _SETTLED:
            way = self._way(goal)
            distance = float(np.abs(way).max())
            if time.monotonic() > end:
                self._link.stop()
                raise RobotError(f"the arm does not get to its start: {distance:.3f} rad off after {limit:.0f} s")
            settled = settled + 1 if distance <= _HOME else 0
            self.step(np.zeros((1, len(way))) if settled else way[None] * min(_GAIN, self._speed / distance))

    def _way(self, goal: np.ndarray) -> np.ndarray:
        way = goal - self._state[0]
        return np.where(self._continuous, np.remainder(way + math.pi, 2 * math.pi) - math.pi, way)

    def step(self, command: np.ndarray) -> RobotState:
        """See :meth:`physai.physics.Physics.step`.

        Periods follow each other without drift; a caller who is late by more than one starts them anew.

        Raises:
            UserError: If the command is not finite.
            RobotError: If another publisher commands the robot, nobody listens, or no joint state comes.
        """
        self._check_open()
        try:
            if not np.isfinite(command).all():
                raise UserError(f"a velocity command must be finite, got {command.tolist()}")
            if obstacle := self._link.obstacle:
                raise RobotError(obstacle)
            sent = self._link.send(command[0].tolist())
            self._deadline += self._dt
            if self._deadline < sent:
                self._deadline = sent + self._dt
            time.sleep(max(0.0, self._deadline - time.monotonic()))
            self._state = self._link.state(sent, self._timeout)
        except BaseException:  # Ctrl-C, too
            self._link.stop()
            raise
        return self.robot_state()

    def robot_state(self) -> RobotState:
        """See :meth:`physai.physics.Physics.robot_state`."""
        return RobotState(self._state[:1].copy(), self._state[1:].copy())

    def parameters(self) -> DynamicsParameters:
        """Not to be had."""
        raise UserError("the dynamics of a robot behind ROS are not known")

    def state(self) -> dict[str, np.ndarray]:
        """Not to be had."""
        raise UserError("a robot behind ROS cannot be put back into a state: training in it cannot be resumed")

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Not possible."""
        self.state()

    def _check_open(self) -> None:
        if not self._finalizer.alive:
            raise RobotError("this env is closed, or another one of this process has taken its robot over")

    def close(self) -> None:
        """Stop the robot, surely; may be called twice."""
        self._finalizer()
