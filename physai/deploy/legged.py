"""The controller of a robot on legs: from its IMU, its joints and velocity commands to safe joint positions."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from physai.deploy.checked import AnswerError
from physai.deploy.command import Command, State
from physai.deploy.controller import STEP, Controller
from physai.deploy.goals import Goal, GoalError, accept
from physai.deploy.imu import Imu, ImuError, ImuReader
from physai.deploy.joints import JointState
from physai.deploy.metadata import GOAL, MEMORY, POSITION, VELOCITY, Metadata
from physai.deploy.parameters import ControllerConfig
from physai.deploy.policy import Driver
from physai.errors import UserError

_ROUNDING = 1e-5  # rad; of positions of single precision
# s, in which a robot keeps a stance in the midst of its walk and can still walk on. To stand up anew would topple it.
_PAUSE = 0.5
_STIFF = 0.2  # s, for which it may be kept in the midst of a step; then it would lean too far to sink down upright
_TO_A_STAND = 1.0  # s, after which a robot that was told to stand has no foot in the air


class LeggedController(Controller):
    """Drives one robot on legs: as :class:`Controller`, and what is different on legs.

    The goal is a velocity, and is out of date ``command_timeout`` s after it came; then the robot walks to a stand. A
    faster one than the policy was trained for counts as the fastest. A robot that begins to walk first stands up, in
    ``rise_time`` s.

    What stands on legs must not simply stop. In a HOLD it keeps the positions that it was told last. Where that is in
    the midst of its walk, it does so for 0.2 s only, and walks on from there if it can. Then each joint is told to be
    where it is, as in a FAULT and an emergency stop: only damping is left, and the robot sinks down upright, where its
    stance would topple it. After a longer pause it stands up first. To lean by more than ``max_tilt`` is a FAULT.

    Args:
        policy: From :func:`physai.deploy.load_policy`, of a robot whose base floats.
        config: Limits and timeouts.
        stopwatch: Measures how long the policy took, in s.

    Raises:
        UserError: If the limits do not fit the robot, or the policy takes what this controller cannot tell it.
    """

    KNOWN = (POSITION, VELOCITY, GOAL, MEMORY, "angular_velocity", "gravity", "last_action", "clock")

    def __init__(
        self,
        policy: Driver,
        config: ControllerConfig | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        metadata = policy.metadata
        self._imu = ImuReader(metadata.goal.frame, (config or ControllerConfig()).state_timeout)
        self._reading: Imu | None = None
        self._commanded = -math.inf  # when a good goal came
        self._turn = _checked_turn(metadata)
        self._walked = self._risen = self._rise = 0.0
        self._drove = -math.inf  # when the policy last did; never, where that does not count any more
        self._strode = -math.inf  # when it last was told to go somewhere
        self._kept = -math.inf  # since when it has what it was told last
        self._strides: bool | None = None  # whether it is paused in a walk; None while it is not paused
        self._start = metadata.home
        self._nothing = np.zeros(len(metadata.joints))
        self._last_action = self._nothing
        super().__init__(policy, config, stopwatch)

    def configure(self, config: ControllerConfig) -> None:
        """See :class:`Controller`."""
        super().configure(config)
        self._imu.timeout = config.state_timeout

    def update(
        self,
        now: float,
        joint_state: JointState | list[JointState] | None = None,
        goal: Goal | None = None,
        interlocks: Sequence[str] = (),
        imu: Imu | None = None,
    ) -> Command:
        """Take what is new, and return what to send; see :class:`Controller`.

        Args:
            now: The time, s, by a clock that does not jump.
            joint_state: What the joints tell.
            goal: A velocity command.
            interlocks: Why the robot must not walk.
            imu: What the IMU tells.
        """
        self._reading = imu
        return super().update(now, joint_state, goal, interlocks)

    def forget_goal(self) -> bool:
        """Wait for a new command; return whether there was one."""
        self._commanded = self._drove = -math.inf
        return super().forget_goal()

    def not_sent(self) -> None:
        """See :class:`Controller`: it then stands where it is, and not where it was told to be."""
        self._interface.release()

    def snapshot(self) -> dict[str, Any]:
        """See :class:`Controller`; with the age of the IMU's last reading, s, and how far the base leans, rad."""
        heard = self._imu.received > -math.inf
        age = (self._now or 0.0) - self._imu.received if heard else None
        return super().snapshot() | {"imu_age": age, "tilt": self._imu.tilt if heard else None}

    def _take_goal(self, goal: Goal, reasons: list[str]) -> None:
        try:
            self._goal, slower = accept(goal, self.policy.metadata, project=True)
        except GoalError as rejected:
            self._tell(reasons, f"goals rejected: {rejected.kind}", str(rejected))
            return
        self._counters["goals"] += 1
        self._counters["goals projected"] += slower
        self._commanded = self._now or 0.0

    def _hold(self, kind: str, reason: str) -> str:
        if kind in ("silent", "another source"):
            self._interface.release()
        elif kind == "clock":
            self._drove = -math.inf
        return super()._hold(kind, reason)

    def _sense(self, now: float, reasons: list[str]) -> None:
        reading, self._reading, imu = self._reading, None, self._imu
        if reading is not None and math.isfinite(now):
            try:
                imu.read(reading, now, float(np.abs(self._robot.velocity).max()))
                self._counters["IMU readings"] += 1
            except ImuError as rejected:
                self._tell(reasons, f"IMU readings rejected: {rejected.kind}", str(rejected))
                if rejected.implausible:
                    self._hold(f"IMU {rejected.kind}", str(rejected))
        if imu.received == -math.inf or not math.isfinite(now):
            return
        if not 0.0 <= now - imu.received <= self.config.state_timeout:  # nor of a time that has been set back
            reasons.append(self._hold("IMU old", f"the last reading of the IMU is {now - imu.received:.3f} s old"))
        if imu.tilt > self.config.max_tilt:
            self._fault("orientation", f"the base leans by {imu.tilt:.2f} rad")

    def _check_following(self) -> None:
        """Springs that carry a robot are never where they are told to be."""

    def _state(self, interlocks: Sequence[str], reasons: list[str]) -> State:
        state = super()._state(interlocks, reasons)
        if self._imu.received > -math.inf or state in (State.FAULT, State.ESTOP):
            return state
        reasons.append("no reading of the IMU yet")
        return State.WAITING

    def _drive(self, elapsed: float, reasons: list[str]) -> tuple[np.ndarray | None, np.ndarray]:
        """Ask the policy once in its period; return the positions to go to, or None to stand, and the new memory."""
        assert self._now is not None
        robot, stance = self._robot, self._interface
        before, walks = stance.target, stance.drives and 0.0 <= self._now - self._drove <= _PAUSE
        if before is None or not walks:
            self._begin(before := robot.position.copy() if before is None else before)
        else:
            self._step += elapsed
            self._walked = (self._walked + elapsed) % self._turn
            self._risen += elapsed
            if self._step < STEP * self._period:
                return before, self._memory
            self._step -= self._period
        known = {
            POSITION: robot.turned,
            VELOCITY: robot.velocity,
            "angular_velocity": self._imu.angular_velocity,
            "gravity": self._imu.gravity,
            GOAL: self._wanted(reasons),
            "last_action": self._last_action,
            "clock": [self._walked],
            MEMORY: self._memory,
        }
        self._asked.start()
        try:
            answer, memory = self._asked.answer(known, self.config.policy_timeout)
        except AnswerError as failure:
            return self._policy_failed(failure, reasons)
        self._failures = 0
        return self._limited(answer, before, reasons), memory

    def _begin(self, position: np.ndarray) -> None:
        self._start, self._last_action = position, self._nothing
        self._walked = self._risen = self._step = 0.0
        self._rise = self.config.rise_time

    def _wanted(self, reasons: list[str]) -> np.ndarray:
        """The velocity to walk with: zeros for a stand, while it rises and without a fresh command."""
        assert self._goal is not None
        assert self._now is not None
        age = self._now - self._commanded
        if not 0.0 <= age <= self.config.command_timeout:
            self._tell(reasons, "steps without a fresh command", f"the last command is {age:.1f} s old: it stands")
        elif self._risen >= self._rise:
            if self._goal.any():
                self._strode = self._now
            return self._goal
        else:
            reasons.append("it stands up")
        return np.zeros_like(self._goal)

    def _limited(self, answer: np.ndarray, before: np.ndarray, reasons: list[str]) -> np.ndarray:
        """Keep what the policy wants, rad, within its range, within what joints can do, and gentle at the start."""
        metadata = self.policy.metadata
        low, high = metadata.command.bounds
        if ((answer < low - _ROUNDING) | (answer > high + _ROUNDING)).any():
            self._tell(reasons, "commands clamped", "the policy's command was beyond its range")
        target = np.clip(answer, low, high)
        self._last_action = np.clip((target - metadata.home) / metadata.command_limit, -1.0, 1.0)
        if self._risen < self._rise:
            target = self._start + self._risen / self._rise * (target - self._start)
        most = metadata.velocity_limit * self._period
        return np.clip(target, before - most, before + most)

    def _send(self, velocity: np.ndarray | None, elapsed: float, reasons: list[str]) -> np.ndarray | None:
        now = self._now or 0.0
        if velocity is not None:
            self._drove = self._kept = now
            self._strides = None
        elif self._latched is not None:
            self._strides = False
            return self._interface.give_way(self._robot.position)
        elif self._strides is None:  # also if that is late: it may walk on with the next update
            self._strides = self._kept - self._strode <= _TO_A_STAND
        elif self._strides and not 0.0 <= now - self._kept <= _STIFF:
            reasons.append("it sinks down: it was in the midst of a step")
            return self._interface.give_way(self._robot.position)
        return super()._send(velocity, elapsed, reasons)


def _checked_turn(metadata: Metadata) -> float:
    """Return after how many s the policy's clock begins again; raises a UserError for signals of another shape."""
    sizes = {"angular_velocity": 3, "gravity": 3, "last_action": len(metadata.joints), "clock": 1}
    turn = math.inf
    for signal in metadata.inputs:
        if signal.name in sizes and signal.shape != (sizes[signal.name],):
            raise UserError(f"the policy takes '{signal.name}' of the shape {list(signal.shape)}")
        if signal.name == "clock":
            turn = float(signal.bounds[1][0])
    if not turn > 0:
        raise UserError(f"the policy's clock begins again after {turn:g} s")
    return turn


def make_controller(
    policy: Driver, config: ControllerConfig | None = None, stopwatch: Callable[[], float] = time.perf_counter
) -> Controller:
    """Return the controller that fits a policy: :class:`LeggedController` where its robot's base floats."""
    kind = LeggedController if policy.metadata.floats else Controller
    return kind(policy, config, stopwatch)
