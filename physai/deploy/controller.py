"""The controller: from joint states and goals to safe velocity commands. No ROS; time is an argument."""

import enum
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.deploy.goals import Goal, GoalRejected, accept
from physai.deploy.joints import JointReader, JointState, StateRejected
from physai.deploy.limits import VelocityLimits
from physai.deploy.parameters import ControllerConfig
from physai.deploy.policy import Policy
from physai.errors import UserError

_LATE = 3.0  # periods


class State(enum.Enum):
    """What the controller does, and how it ends."""

    WAITING = "waiting"  # for a joint state or a goal
    ACTIVE = "active"  # the policy drives
    REACHED = "reached"  # zero velocity at the goal, until it moves or the arm drifts
    HOLD = "hold"  # zero velocity, until enough good joint states have come in a row
    FAULT = "fault"  # zero velocity, until reset
    ESTOP = "estop"  # zero velocity, until reset


@dataclass(frozen=True)
class Command:
    """What to send to the arm.

    Attributes:
        velocity: rad/s, in the order of the policy's joints; None: send nothing, the arm has not been heard of yet.
        state: The controller's state.
        reasons: Why the arm does not do what the policy wants, or what was refused; empty when all is well.
    """

    velocity: np.ndarray | None
    state: State
    reasons: tuple[str, ...]


class Controller:
    """Drives one robot: call ``update`` at ``config.rate_hz``, and send what it returns.

    On any doubt it commands zero velocity: at once, whatever the acceleration limit. From a hold it recovers by
    itself; from a fault and an emergency stop only by ``reset``.

    Args:
        policy: From :func:`physai.deploy.load_policy`.
        config: Limits and timeouts.
        stopwatch: Measures how long the policy took, in s; no other decision depends on a clock.

    Raises:
        UserError: If the limits do not fit the robot.
    """

    def __init__(
        self,
        policy: Policy,
        config: ControllerConfig | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.config = config = config or ControllerConfig()
        self.policy = policy
        metadata = policy.metadata
        slowest = metadata.velocity_limit.min()
        if config.max_velocity > slowest:
            raise UserError(f"max_velocity: {config.max_velocity} rad/s is beyond the robot's limit, {slowest:g} rad/s")
        spans = metadata.position_limit[:, 1] - metadata.position_limit[:, 0]
        if 2 * config.limit_margin >= spans.min():
            raise UserError(f"limit_margin: {config.limit_margin} rad leaves no room between the position limits")
        self._stopwatch = stopwatch
        self._reader = JointReader(metadata, config)
        self._limits = VelocityLimits(metadata, config)
        self._zeros = np.zeros(len(metadata.joints))
        self._now: float | None = None
        self._position: np.ndarray | None = None
        self._velocity = self._zeros
        self._received = -math.inf
        self._goal: np.ndarray | None = None
        self._reached = False
        self._needed = 0  # good joint states until a hold ends
        self._failures = 0  # of the policy, in a row
        self._latched: State | None = None
        self._latch_reason = ""
        self._last = self._zeros
        self._command = Command(None, State.WAITING, ())
        self._since = 0.0
        self._counters: Counter[str] = Counter()

    def update(self, now: float, joint_state: JointState | None = None, goal: Goal | None = None) -> Command:
        """Take what is new, and return what to send.

        Args:
            now: The time, s, by a clock that does not jump.
            joint_state: A joint state that has come in since the last update.
            goal: A goal that has come in since then; the last good one stays until another comes.
        """
        reasons: list[str] = []
        self._counters["updates"] += 1
        elapsed, stop = self._take_time(now, reasons)
        if goal is not None:
            self._take_goal(goal, reasons)
        if joint_state is not None and math.isfinite(now):
            self._take_state(now, joint_state, reasons)
        if self._position is not None and now - self._received > self.config.state_timeout:
            self._hold("state old", f"the last joint state is {now - self._received:.3f} s old", reasons)
        state = self._state(reasons)
        velocity = self._zeros
        if state is State.ACTIVE and not stop:
            velocity = self._drive(elapsed, reasons)
            state = self._latched or (State.REACHED if self._reached else State.ACTIVE)
        if state is not self._command.state:
            self._since = self._now or 0.0
            self._counters[f"entered {state.value}"] += 1
        self._last = velocity
        self._command = Command(None if self._unheard(state) else velocity.copy(), state, tuple(reasons))
        return self._command

    def emergency_stop(self) -> None:
        """Stop at once; only ``reset`` ends it."""
        self._counters["emergency stops"] += 1
        self._latched, self._latch_reason = State.ESTOP, "emergency stop"

    def reset(self) -> None:
        """Leave a fault or an emergency stop for a hold, which ends when the robot is seen to be well."""
        if self._latched is not None:
            self._latched = None
            self._failures = 0
            self._needed = self.config.recovery_states

    def snapshot(self) -> dict[str, Any]:
        """State, its reasons and counters, for diagnostics; plain values only."""
        at = self._now if self._now is not None else 0.0
        known = self._position is not None
        return {
            "state": self._command.state.value,
            "state_since": self._since,
            "reasons": list(self._command.reasons),
            "joint_state_age": at - self._received if known else None,
            "recovery_states_needed": self._needed,
            "goal": None if self._goal is None else self._goal.tolist(),
            "velocity": None if self._command.velocity is None else self._command.velocity.tolist(),
            "policy_failures_in_a_row": self._failures,
            "policy_sha256": self.policy.sha256,
            "counters": dict(self._counters),
        }

    def _take_time(self, now: float, reasons: list[str]) -> tuple[float, bool]:
        """Return the time since the last update, at most a period, and whether this tick must be zero."""
        period = 1.0 / self.config.rate_hz
        if not math.isfinite(now):
            self._hold("clock", "the time is not finite", reasons)
            return 0.0, True
        before, self._now = self._now, now
        elapsed = period if before is None else now - before
        if elapsed < 0 or elapsed > self.config.clock_jump:
            self._hold("clock", f"the clock jumped by {elapsed:.3f} s", reasons)
            return 0.0, True
        if elapsed > _LATE * period:
            self._counters["late updates"] += 1
            reasons.append(f"update came after {elapsed:.3f} s, {elapsed / period:.1f} periods")
            return period, True
        return min(elapsed, period), False

    def _take_goal(self, goal: Goal, reasons: list[str]) -> None:
        try:
            new = accept(goal, self.policy.metadata, self.config.unreachable_goal == "project")
        except GoalRejected as rejected:
            self._counters[f"goals rejected: {rejected.kind}"] += 1
            reasons.append(str(rejected))
            return
        self._counters["goals"] += 1
        if self._goal is None or not np.array_equal(new, self._goal):
            self._goal, self._reached = new, False

    def _take_state(self, now: float, joint_state: JointState, reasons: list[str]) -> None:
        received = now if joint_state.received is None else min(joint_state.received, now)
        try:
            position, velocity = self._reader.read(joint_state)
            if not now - received <= self.config.state_timeout:  # also where it is NaN
                raise StateRejected("old on arrival", f"it is {now - received:.3f} s old", implausible=True)
        except StateRejected as rejected:
            self._counters[f"states rejected: {rejected.kind}"] += 1
            reasons.append(str(rejected))
            if rejected.implausible or self._needed:
                self._needed = self.config.recovery_states
            return
        self._counters["states"] += 1
        self._position, self._velocity, self._received = position, velocity, received
        self._needed = max(0, self._needed - 1)
        far = self._limits.far_beyond(position)
        if far is not None and self._latched is None:
            joint = self.policy.metadata.joints[far]
            self._fault("position", f"'{joint}' is far beyond its position limit, at {position[far]:.3f} rad")

    def _hold(self, kind: str, reason: str, reasons: list[str]) -> None:
        self._counters[f"holds: {kind}"] += 1
        self._needed = self.config.recovery_states
        reasons.append(reason)

    def _fault(self, kind: str, reason: str) -> None:
        self._counters[f"faults: {kind}"] += 1
        self._latched, self._latch_reason = State.FAULT, reason

    def _state(self, reasons: list[str]) -> State:
        if self._latched is not None:
            reasons.append(self._latch_reason)
            return self._latched
        if self._position is None:
            reasons.append("no joint state yet")
            return State.WAITING
        if self._needed:
            reasons.append(f"{self._needed} more good joint states are needed")
            return State.HOLD
        if self._goal is None:
            reasons.append("no goal yet")
            return State.WAITING
        return State.ACTIVE

    def _drive(self, elapsed: float, reasons: list[str]) -> np.ndarray:
        """Ask the policy, and limit what it wants."""
        assert self._position is not None
        assert self._goal is not None
        started = self._stopwatch()
        try:
            tolerance = self.policy.metadata.goal_tolerance
            distance = self.policy.distance(self._position, self._goal)
            self._reached = distance < tolerance * (self.config.reached_hysteresis if self._reached else 1.0)
            if self._reached:
                return self._zeros
            wanted = np.asarray(self.policy(self._position, self._velocity, self._goal), dtype=np.float64)
        except Exception as error:  # a policy is a foreign program
            return self._policy_failed("exception", f"raised {type(error).__name__}: {str(error)[:80]}", reasons)
        took = self._stopwatch() - started
        if wanted.shape != self._zeros.shape:
            return self._policy_failed("shape", f"gave the shape {list(wanted.shape)}", reasons)
        if not np.isfinite(wanted).all():
            return self._policy_failed("not finite", "gave a velocity that is not finite", reasons)
        if took > self.config.policy_timeout:
            return self._policy_failed("slow", f"took {took * 1e3:.1f} ms", reasons)
        self._failures = 0
        if self._limits.out_of_range(wanted):
            self._counters["commands clamped"] += 1
            reasons.append("the policy's command was beyond its range")
        return self._limits.apply(wanted, self._position, self._last, elapsed)

    def _policy_failed(self, kind: str, what: str, reasons: list[str]) -> np.ndarray:
        self._counters[f"policy failures: {kind}"] += 1
        self._failures += 1
        reasons.append(f"the policy {what}")
        if self._failures >= self.config.policy_failures:
            self._fault("policy", f"the policy failed {self._failures} times in a row; at last it {what}")
        return self._zeros

    def _unheard(self, state: State) -> bool:
        return state is State.WAITING and self._position is None
