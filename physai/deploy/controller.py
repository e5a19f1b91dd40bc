"""The controller: from joint states and goals to safe commands. No ROS; time is an argument."""

import math
import operator
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from physai.deploy.checked import AnswerError, CheckedPolicy
from physai.deploy.clock import Clock
from physai.deploy.command import Command, State
from physai.deploy.following import Following, Progress, Strain
from physai.deploy.goals import Goal, GoalError, accept
from physai.deploy.guard import CollisionGuard
from physai.deploy.interfaces import interface_of
from physai.deploy.joints import Heard, JointReader, JointState, JointStateError
from physai.deploy.limits import VelocityLimits, check
from physai.deploy.metadata import GOAL, LAST_COMMAND, MEMORY, POSITION, VELOCITY
from physai.deploy.parameters import ControllerConfig
from physai.deploy.policy import Driver

STEP = 0.75  # periods; what is asked again sooner is the same step of a policy that remembers
_MOVED = 0.1  # tolerances; a goal that moves by less is still the same


class Controller:
    """Drives one robot: call ``update`` at the policy's control rate, and send what it returns.

    On any doubt it lets the arm stand still, by zero velocities or by the positions where it is: at once, whatever the
    acceleration limit. From a hold it recovers by itself; from a fault and an emergency stop only by ``reset``, and a
    new goal.

    What a policy remembers begins with zeros, as its episodes did: at a new goal, and after every tick at which it did
    not drive.

    Args:
        policy: From :func:`physai.deploy.load_policy`, or who else answers as one.
        config: Limits and timeouts.
        stopwatch: Measures how long the policy took, in s; no other decision depends on a clock.

    Raises:
        UserError: If the limits do not fit the robot, or the policy takes what this controller cannot tell it.
    """

    KNOWN: tuple[str, ...] = (POSITION, VELOCITY, GOAL, LAST_COMMAND, MEMORY)  # what it can tell a policy

    def __init__(
        self,
        policy: Driver,
        config: ControllerConfig | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.policy = policy
        metadata = policy.metadata
        self._asked = CheckedPolicy(policy, stopwatch, self.KNOWN)
        self._interface: Any = interface_of(metadata)
        self._period = 1.0 / metadata.control_rate
        self._clock = Clock(self._period)
        self._tolerances = [tolerance.value for tolerance in metadata.tolerances]
        self._counters: Counter[str] = Counter()
        self._latched: State | None = None
        self._latch_reason = ""
        config = config or ControllerConfig()
        self._robot = JointReader(metadata, config)
        self._progress, self._strain = Progress(), Strain(metadata)
        self.configure(config)
        self._now: float | None = None
        self._received = -math.inf  # when the robot was heard of: its joint that was not for longest
        self._goal: np.ndarray | None = None
        self._reached = self._guarded = False  # at the goal; held back by the collision guard
        self._memory = self._asked.nothing
        self._step = 0.0  # s since the memory's last one
        self._needed = 0  # good joint states until a hold ends
        self._hold_reason = ""
        self._gave_up = ""  # why this goal is not pursued any more
        self._failures = 0  # of the policy, in a row
        self._command = Command(None, State.WAITING, ())
        self._since = 0.0

    def configure(self, config: ControllerConfig) -> None:
        """Take other limits and timeouts; they hold from the next update on.

        Raises:
            UserError: If the limits do not fit the robot; those of before stay.
        """
        check(config, self.policy.metadata)
        guard = CollisionGuard(self.policy.metadata, config)
        self.config = config
        self._clock.jump = config.clock_jump
        self._robot.configure(config)
        self._limits = VelocityLimits(self.policy.metadata, config)
        self._interface.configure(config, self._limits)
        self._following = Following(self.policy.metadata, config)
        self._guard = guard
        self._check_position()

    def update(
        self,
        now: float,
        joint_state: JointState | list[JointState] | None = None,
        goal: Goal | None = None,
        interlocks: Sequence[str] = (),
    ) -> Command:
        """Take what is new, and return what to send.

        Args:
            now: The time, s, by a clock that does not jump.
            joint_state: A joint state that has come in since the last update; a list of them, where the robot tells
                of its joints in several messages.
            goal: A goal that has come in since then; the last good one stays until another comes.
            interlocks: Why the arm must not move now though nothing is wrong with it, such as "not enabled"; it waits
                until there is none.

        Returns:
            A command [n], or none before the first joint state; with state and reasons.
        """
        reasons: list[str] = []
        self._counters["updates"] += 1
        passed, stop = self._take_time(now, reasons)
        if goal is not None:
            self._take_goal(goal, reasons)
        if self._command.state in (State.ACTIVE, State.REACHED) and not stop:
            rests = self._command.state is State.REACHED
            self._following.commanded(now, self._interface.way(passed), rests)
        else:
            self._following.restart()
        if joint_state is not None and math.isfinite(now):
            for one in joint_state if isinstance(joint_state, list) else (joint_state,):
                self._take_state(now, one, not stop, reasons)
        self._sense(now, reasons)
        if self._received > -math.inf and now - self._received > self.config.state_timeout:
            oldest = self._robot.oldest()
            what = "joint state" if oldest is None else f"state of '{oldest}'"
            reasons.append(self._hold("state old", f"the last {what} is {now - self._received:.3f} s old"))
        state = self._state(interlocks, reasons)
        elapsed = min(passed, self._period)
        velocity, memory, self._guarded = None, self._asked.nothing, False
        if state is State.ACTIVE:
            if not stop:
                velocity, memory = self._drive(elapsed, reasons)
            holds = self._gave_up or self._guarded
            state = State.HOLD if holds else State.REACHED if self._reached else State.ACTIVE
        if self._latched not in (None, state):  # an emergency stop while the policy was asked, or a policy that failed
            velocity, memory, state = None, self._asked.nothing, self._latched
            reasons.append(self._latch_reason)
        if state is not self._command.state:
            self._since = self._now or 0.0
            self._counters[f"entered {state.value}"] += 1
        self._memory = memory
        value = self._send(velocity, elapsed, reasons)
        unheard = state is State.WAITING and self._received == -math.inf
        value = None if unheard or value is None else value.copy()
        self._command = Command(value, state, tuple(reasons))
        return self._command

    @property
    def standstill(self) -> np.ndarray:
        """The command [n] that stands still where the arm is now."""
        return self._interface.standstill(self._robot.position)

    def emergency_stop(self) -> None:
        """Stop at once; only ``reset`` ends it."""
        self._counters["emergency stops"] += 1
        self._latched, self._latch_reason = State.ESTOP, "emergency stop"

    def not_sent(self) -> None:
        """Take note that the last command did not reach the robot, which others may move meanwhile."""

    def reset(self) -> bool:
        """Leave a fault, an emergency stop or a goal given up for a hold, which ends when the robot is seen to be well.

        The goal is forgotten: a reset permits motion, a new goal starts it.

        Returns:
            Whether there was anything to leave.
        """
        if self._latched is None and not self._gave_up:
            return False
        self._latched = None
        self._strain.restart()
        self.forget_goal()
        self._failures = 0
        self._needed = self.config.recovery_states
        return True

    def forget_goal(self) -> bool:
        """Wait for a new goal; return whether there was one."""
        had = self._goal is not None
        self._goal, self._reached, self._gave_up = None, False, ""
        return had

    def snapshot(self) -> dict[str, Any]:
        """State, its reasons and counters, for diagnostics; plain values only."""
        age = None if self._received == -math.inf else (self._now or 0.0) - self._received
        return {
            "state": self._command.state.value,
            "state_since": self._since,
            "reasons": list(self._command.reasons),
            "joint_state_age": age,
            "recovery_states_needed": self._needed,
            "last_hold": self._hold_reason,
            "goal": None if self._goal is None else self._goal.tolist(),
            "command": None if self._command.value is None else self._command.value.tolist(),
            "policy_failures_in_a_row": self._failures,
            "policy_sha256": self.policy.sha256,
            "counters": dict(self._counters),
        }

    def _take_time(self, now: float, reasons: list[str]) -> tuple[float, bool]:
        """Return the time since the last update, and whether the arm must stand in this tick."""
        elapsed, doubt, late = self._clock.take(now)
        self._now = self._clock.now
        if doubt:
            reasons.append(self._hold("clock", doubt))
        if late:
            self._tell(reasons, "late updates", late)
        return elapsed, bool(doubt or late)

    def _take_goal(self, goal: Goal, reasons: list[str]) -> None:
        try:
            project = self.config.unreachable_goal == "project"
            new, projected = accept(goal, self.policy.metadata, project, self._guard.inside)
        except GoalError as rejected:
            self._tell(reasons, f"goals rejected: {rejected.kind}", str(rejected))
            return
        self._counters["goals"] += 1
        if projected:
            self._tell(reasons, "goals projected", f"goal out of reach: {new.tolist()} is the nearest in reach")
        if self._goal is None or np.abs(new - self._goal).max() > _MOVED * self._tolerances[0]:
            self._reached, self._gave_up = False, ""
            self._progress.restart()
            self._memory = self._asked.nothing
        self._goal = new

    def _take_state(self, now: float, joint_state: JointState, timely: bool, reasons: list[str]) -> None:
        try:
            heard = self._robot.read(joint_state, now)
            if heard is None:
                self._counters["states of other joints"] += 1
                return
            self._take_motion(heard, reasons)
        except (JointStateError, AttributeError) as error:
            rejected = error if isinstance(error, JointStateError) else JointStateError("malformed", "it is none")
            self._tell(reasons, f"states rejected: {rejected.kind}", str(rejected))
            if rejected.implausible:
                self._hold(rejected.kind, str(rejected))
            elif self._needed:
                self._needed = self.config.recovery_states
            return
        self._counters["states"] += 1
        if timely and heard.complete:
            self._needed = max(0, self._needed - 1)

    def _take_motion(self, heard: Heard, reasons: list[str]) -> None:
        """See whether the arm may be driven on after what was heard of it."""
        robot = self._robot
        before, self._received = self._received, robot.received
        silent = self._received - before if before > -math.inf else 0.0
        if silent > self.config.resume_timeout or heard.another is not None:
            kind, what = "silent", f"the robot was silent for {silent:.1f} s"
            if heard.another is not None:
                kind, what = "another source", f"'{heard.another}' is told by another source than before"
            self._hold(kind, what)
            if self._goal is not None:
                self._tell(reasons, f"goals forgotten: {kind}", f"goal forgotten: {self._hold_reason}")
                self.forget_goal()
        self._check_position()
        if self._received == -math.inf:
            return
        if robot.feels and (beyond := self._strain.heard(self._received, robot.effort, self.config.effort_time)):
            self._fault("effort", beyond)
        self._check_following()

    def _sense(self, now: float, reasons: list[str]) -> None:
        """Take what else the robot tells of itself."""

    def _check_following(self) -> None:
        """See whether the arm does what it is told, and tells what it does."""
        if (deviation := self._following.heard(self._received, self._robot.motion)) is not None:
            if not deviation.consistent:
                raise JointStateError("velocity inconsistent", deviation.text, implausible=True)
            self._fault("following", deviation.text)

    def _check_position(self) -> None:
        if (far := self._limits.far_beyond(self._robot.position)) is not None:
            joint, position = self.policy.metadata.joints[far], self._robot.position[far]
            self._fault("position", f"'{joint}' is far beyond its position limit, at {position:.3f} rad")

    def _hold(self, kind: str, reason: str) -> str:
        if not self._needed:
            self._counters[f"holds: {kind}"] += 1
        self._needed = self.config.recovery_states
        self._hold_reason = reason
        return reason

    def _fault(self, kind: str, reason: str) -> None:
        if self._latched is not None:
            return
        self._counters[f"faults: {kind}"] += 1
        self._latched, self._latch_reason = State.FAULT, reason

    def _state(self, interlocks: Sequence[str], reasons: list[str]) -> State:
        if self._latched is not None:
            reasons.append(self._latch_reason)
            return self._latched
        if self._received == -math.inf:
            missing = self._robot.oldest()
            reasons += ["no joint state yet" if missing is None else f"no state of '{missing}' yet", *interlocks]
            return State.WAITING
        waits = f"{self._needed} more good joint states are needed" if self._needed else self._gave_up
        if waits:
            reasons += [waits, *interlocks]
            return State.HOLD
        reasons += interlocks
        if self._goal is None:
            reasons.append("no goal yet")
        return State.WAITING if interlocks or self._goal is None else State.ACTIVE

    def _drive(self, elapsed: float, reasons: list[str]) -> tuple[np.ndarray | None, np.ndarray]:
        """Ask the policy, and limit what it wants; return the velocity, or None to stand, and the new memory."""
        assert self._goal is not None
        robot, config = self._robot, self.config
        try:
            error = self._asked.error(robot.turned, self._goal)
            far = max(map(operator.truediv, error, self._tolerances))
            self._reached = far < (config.reached_hysteresis if self._reached else 1.0)
            if self._reached:
                self._progress.restart()
                return None, self._asked.nothing
            if self._progress.waited(far, elapsed) > config.progress_timeout:
                return self._give_up(error, reasons)
            target = self._interface.begin(robot.position, robot.turned)
            known = {
                POSITION: robot.turned,
                VELOCITY: robot.velocity,
                GOAL: self._goal,
                MEMORY: self._memory,
                LAST_COMMAND: self._interface.last_command,
            }
            answer, memory = self._asked.answer(known, config.policy_timeout)
        except AnswerError as failure:
            return self._policy_failed(failure, reasons)
        self._failures = 0
        wanted = self._interface.wanted(answer)
        if self._limits.out_of_range(wanted, self._interface.rounding):
            self._tell(reasons, "commands clamped", "the policy's command was beyond its range")
        limited = partial(
            self._limits.apply, position=robot.position, target=target, last=self._interface.velocity, elapsed=elapsed
        )
        velocity, held_back = limited(wanted)
        if held_back is not None:
            self._tell(reasons, "ticks at a position limit", held_back)
        safe, nearing = self._guard.apply(velocity, robot.position, limited)
        if nearing is not None:
            self._tell(reasons, "ticks held back by the collision guard", nearing)
        if safe is None:
            self._guarded, self._hold_reason = True, str(nearing)
            return None, self._asked.nothing
        return safe, self._remember(memory, elapsed)

    def _send(self, velocity: np.ndarray | None, elapsed: float, reasons: list[str]) -> np.ndarray | None:
        """Return what makes the robot go on with a velocity, or stand; None where that is not known yet."""
        if velocity is None:
            return self._interface.stand(self._robot.position)
        value, waits = self._interface.drive(velocity, elapsed)
        if waits is not None:
            self._tell(reasons, "ticks at max_lead", waits)
        return value

    def _tell(self, reasons: list[str], event: str, reason: str) -> None:
        self._counters[event] += 1
        reasons.append(reason)

    def _give_up(self, error: list[float], reasons: list[str]) -> tuple[None, np.ndarray]:
        tolerances = self.policy.metadata.tolerances
        far = ", ".join(f"{each:.3f} {tolerance.unit}" for each, tolerance in zip(error, tolerances, strict=True))
        self._gave_up = self._hold_reason = (
            f"no progress for {self.config.progress_timeout:g} s, {far} from the goal: waiting for another"
        )
        self._tell(reasons, "holds: no progress", self._gave_up)
        return None, self._asked.nothing

    def _remember(self, memory: np.ndarray, elapsed: float) -> np.ndarray:
        """Return the new memory, or the old one: who asks more often than in training must not make time run faster."""
        self._step += elapsed
        if self._step < STEP * self._period:
            return self._memory
        self._step -= self._period
        return memory

    def _policy_failed(self, failure: AnswerError, reasons: list[str]) -> tuple[None, np.ndarray]:
        self._tell(reasons, f"policy failures: {failure.kind}", f"the policy {failure}")
        self._failures += 1
        if self._failures >= self.config.policy_failures:
            self._fault("policy", f"the policy failed {self._failures} times in a row; at last it {failure}")
        return None, self._asked.nothing
