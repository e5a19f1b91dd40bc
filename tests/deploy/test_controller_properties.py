"""What holds whatever happens: random sequences of states, goals, faults and times against a model of the contract."""

import dataclasses
import math
import random
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from physai.errors import UserError
from tests.deploy.conftest import ALL_FAILURES, Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")
STILL = [0.0, 0.0]


class Analytic:
    """A policy in few lines, for speed: by inverse kinematics straight to the goal, for links of 0.30 and 0.25 m."""

    def __init__(self, metadata):
        self.metadata, self.sha256 = metadata, ""

    def distance(self, position, goal):
        q1, q2 = position.tolist()
        x, y = 0.3 * math.cos(q1) + 0.25 * math.cos(q1 + q2), 0.3 * math.sin(q1) + 0.25 * math.sin(q1 + q2)
        return math.hypot(x - goal[0], y - goal[1])

    def __call__(self, position, velocity, goal):
        x, y = goal.tolist()
        cosine = (x * x + y * y - 0.1525) / 0.15
        elbow = math.acos(min(1.0, max(-1.0, cosine)))
        shoulder = math.atan2(y, x) - math.atan2(0.25 * math.sin(elbow), 0.3 + 0.25 * math.cos(elbow))
        return np.clip(4.0 * (np.array([shoulder, elbow]) - position), -2.0, 2.0).astype(np.float32)


class World:
    """An arm that follows its commands, a controller, and a model of what the contract demands of it.

    ``tick`` checks every command against the model; ``log`` keeps what went in and came out.
    """

    def __init__(self, policy, config, position, log=None):
        self.policy, self.log = Troubled(policy), log
        self.controller = Controller(self.policy, config, self.policy.stopwatch)
        self.policy.stop = self.controller.emergency_stop
        self._take_config(config)
        self.moved = 0.1 * policy.metadata.goal_tolerance
        self.lower, self.upper = policy.metadata.position_limit.T.tolist()
        # The arm, and two clocks: that of the controller, and that of the stamps.
        self.position, self.velocity, self.last = list(position), STILL, STILL
        self.now, self.stamp, self.started = 1000.0, 50.0, False
        # The model.
        self.before = self.accepted = self.goal = self.latched = None
        self.received = 0.0
        self.needed = self.failures = self.still = 0
        self.reached = False
        self.seen = Counter()

    def flow(self, elapsed, noise=(0.0, 0.0)):
        """Let the arm follow its last command."""
        self.position = [q + v * elapsed + e for q, v, e in zip(self.position, self.velocity, noise, strict=True)]
        self.stamp += elapsed

    def message(self, names=NAMES, position=None, velocity=None, stamp=None, received=None):
        return JointState(
            names,
            self.position if position is None else position,
            self.velocity if velocity is None else velocity,
            self.stamp if stamp is None else stamp,
            received,
        )

    def emergency_stop(self):
        self._tell("emergency_stop")
        self.latched = State.ESTOP

    def reset(self):
        self._tell("reset")
        if self.latched:
            self.latched, self.failures, self.needed = None, 0, self.config.recovery_states
            self.goal, self.reached = None, False

    def forget_goal(self):
        self._tell("forget_goal")
        self.goal, self.reached = None, False

    def configure(self, config):
        self._tell("configure", config)
        self._take_config(config)
        share = min(1.0, config.max_velocity / max(*map(abs, self.last), 1e-9))
        self.last = [velocity * share for velocity in self.last]

    def _take_config(self, config):
        self.config = config
        self.plausible = [speed * config.jump_factor for speed in self.policy.metadata.velocity_limit.tolist()]
        self.acceleration = config.max_acceleration
        self.fastest = config.max_velocity * (1 + 1e-12)
        self.slow = min(config.limit_velocity, config.max_velocity)

    def _tell(self, what, *arguments):
        getattr(self.controller, what)(*arguments)
        if self.log is not None:
            self.log.append((what, *arguments))

    def tick(self, step=PERIOD, state=None, goal=None, verdict=None, interlocks=()):
        """Update once; a verdict on the state is only given where it is no list of numbers."""
        config, policy, counted = self.config, self.policy, self.seen
        now = self.now + step
        policy.forget()
        command = self.controller.update(now, state, goal, interlocks)
        if self.log is not None:
            velocity = None if command.velocity is None else command.velocity.tobytes()
            inputs = (now, state, goal, interlocks)
            self.log.append(("update", inputs, policy.trouble, velocity, command.state, command.reasons))
        stop, elapsed = self._take_time(now)
        said = [" ".join(reason.split()[:2]) for reason in command.reasons]
        # What came in.
        if goal is not None:
            verdict_on_goal = self._take_goal(goal)
            assert ("goal rejected:" in said) == (verdict_on_goal == "rejected")
            assert ("goal out" in said) == (verdict_on_goal == "projected")
            counted[f"goal {verdict_on_goal}"] += 1
        if state is not None and math.isfinite(now):
            verdict = verdict or self._judge(state)
            assert ("joint state" in said) == (verdict != "good")
            counted[verdict] += 1
            if verdict == "good":
                if not stop:
                    self.needed = max(0, self.needed - 1)
                far = config.limit_fault
                if any(not lo - far <= q <= hi + far for q, lo, hi in self._against_limits()) and not self.latched:
                    self.latched = State.FAULT
            elif verdict == "implausible":
                self._hold()
            elif self.needed:
                self.needed = config.recovery_states
        if self.accepted and now - self.received > config.state_timeout:
            self._hold()
        # The state that follows.
        velocity = STILL if command.velocity is None else command.velocity.tolist()
        assert (command.velocity is None) == (self.accepted is None and not self.latched)
        if self.latched:
            expected = self.latched
        elif self.accepted is None:
            expected = State.WAITING
        elif self.needed:
            expected = State.HOLD
        elif interlocks or self.goal is None:
            expected = State.WAITING
            counted["interlocked"] += self.goal is not None
            assert set(interlocks) <= set(command.reasons)
            assert ("no goal" in said) == (self.goal is None)
        else:
            expected = None
        if expected:
            stop = True
            assert policy.measured is None
            assert not policy.called
        else:
            expected, stop = self._drive(stop)
        assert command.state is expected, (command, expected)
        counted[command.state] += 1
        counted["moving"] += velocity != STILL
        counted["held back"] += "a joint" in said
        if stop:
            assert velocity == STILL, command
            assert command.reasons or expected is State.REACHED
        self._check(velocity, elapsed, stop, "a joint" in said)
        self.velocity = self.last = velocity
        return command

    def finish(self):
        """Compare the controller's counters with the model's."""
        counters = self.controller.snapshot()["counters"]
        for kind, names in {
            "good": ["states"],
            "malformed or implausible": [name for name in counters if name.startswith("states rejected: ")],
            "holds": [name for name in counters if name.startswith("holds: ")],
            "goal taken or projected": ["goals"],
            "goal projected": ["goals projected"],
            "goal rejected": [name for name in counters if name.startswith("goals rejected: ")],
            "held back": ["ticks at a position limit"],
        }.items():
            prefix = "goal " if kind.startswith("goal ") else ""
            expected = sum(self.seen[prefix + part] for part in kind.removeprefix(prefix).split(" or "))
            assert sum(counters.get(name, 0) for name in names) == expected, (kind, counters, self.seen)

    def _hold(self):
        self.seen["holds"] += not self.needed
        self.needed = self.config.recovery_states

    def _take_time(self, now):
        """Return whether the time alone makes this tick zero, and what the acceleration limit counts."""
        if not math.isfinite(now):
            self._hold()
            return True, 0.0
        elapsed = now - self.now if self.started else PERIOD
        self.now, self.started = now, True
        self.still = 0 if elapsed else self.still + 1
        if self.still >= 3 or not 0 <= elapsed <= self.config.clock_jump:
            self._hold()
            return True, 0.0
        return elapsed > 3 * PERIOD, min(elapsed, PERIOD)

    def _take_goal(self, goal):
        numbers, verdict = tuple(float(number) for number in goal.position), "taken"
        if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or goal.frame != "base":
            return "rejected"
        radius = math.hypot(*numbers)
        if not 0.3 - 1e-6 <= radius <= 0.53 + 1e-6:
            if self.config.unreachable_goal == "reject" or radius < 1e-6 or math.isinf(radius):
                return "rejected"
            scale, verdict = min(max(radius, 0.3), 0.53) / radius, "projected"
            numbers = (numbers[0] * scale, numbers[1] * scale)
        if not self.goal or max(abs(new - old) for new, old in zip(numbers, self.goal, strict=True)) > self.moved:
            self.reached = False
        self.goal = numbers
        return verdict

    def _judge(self, state):
        names, count = state.names, len(state.names)
        if names != NAMES and (len(set(names)) < count or not set(NAMES) <= set(names)):
            return "malformed"
        if len(state.position) != count or len(state.velocity) not in (0, count):
            return "malformed"
        index = (0, 1) if names == NAMES else [names.index(name) for name in NAMES]
        position = [state.position[i] for i in index]
        if not all(map(math.isfinite, (*position, state.stamp))):
            return "malformed"
        received = self.now if state.received is None else min(state.received, self.now)
        before, self.before = self.before, (position, state.stamp, received)
        elapsed = 0.0
        if before is not None:
            elapsed = state.stamp - before[1]
            allowed = min(elapsed, max(0.0, received - before[2]) + self.config.state_timeout)
            moved = self._moved(position, before[0])
            far = any(abs(by) > speed * allowed + 0.01 for by, speed in zip(moved, self.plausible, strict=True))
            if elapsed <= 0 or far:
                return "implausible"
            self.seen["around"] += any(abs(q - p) > 3 for q, p in zip(position, before[0], strict=True))
        velocity = [state.velocity[i] for i in index] if len(state.velocity) else [math.nan] * 2
        if not all(map(math.isfinite, velocity)):
            if not self.config.allow_velocity_estimate or before is None or elapsed > self.config.state_timeout:
                return "malformed"
            rows = zip(velocity, moved, self.plausible, strict=True)
            velocity = [v if math.isfinite(v) else min(most, max(-most, by / elapsed)) for v, by, most in rows]
        if any(abs(v) > speed for v, speed in zip(velocity, self.plausible, strict=True)):
            return "implausible"
        if self.now - received > self.config.state_timeout:
            return "implausible"
        self.accepted, self.received = position, received
        return "good"

    def _moved(self, position, before):
        """By how much: a joint without limits the shorter way around."""
        moves = [q - p for q, p in zip(position, before, strict=True)]
        return [
            math.remainder(by, math.tau) if math.isinf(upper) else by
            for by, upper in zip(moves, self.upper, strict=True)
        ]

    def _drive(self, stop):
        """Return the state, and whether the arm stands in this tick."""
        policy, standing = self.policy, State.REACHED if self.reached else State.ACTIVE
        if stop:
            assert policy.measured is None
            assert not policy.called
            return standing, True
        assert math.dist(policy.goal.tolist(), self.goal) < 1e-9
        if policy.measured is not None:
            self.reached = policy.measured < 0.05 * (self.config.reached_hysteresis if self.reached else 1.0)
            if self.reached:
                assert not policy.called
                return State.REACHED, True
            assert policy.called
            standing = State.ACTIVE
        self.failures = self.failures + 1 if policy.failed else 0
        if policy.stopped:
            self.latched = State.ESTOP
        elif self.failures >= self.config.policy_failures:
            self.latched = State.FAULT
        return self.latched or standing, policy.failed or policy.stopped

    def _check(self, velocity, elapsed, stopped, held_back):
        """See that the limits hold."""
        change = self.acceleration * elapsed
        sides = [0, 0]  # of the limit that a joint is at
        if self.accepted:
            margin = self.config.limit_margin
            sides = [(q >= upper - margin) - (q <= lower + margin) for q, lower, upper in self._against_limits()]
        beyond = any(sides) and any(not lower <= q <= upper for q, lower, upper in self._against_limits())
        for new, last, side in zip(velocity, self.last, sides, strict=True):
            assert abs(new) <= self.fastest  # so, it is finite
            self.seen["at a limit"] += side != 0 and not stopped
            assert new * side <= 0, (new, side)
            if not stopped and last * side > 0:
                self.seen["stopped at a limit"] += 1
                assert new == 0, (new, last)
            else:
                assert stopped or abs(new - last) <= change + 1e-12, (new, last, change)
        if not stopped:
            assert any(sides) or not held_back
            assert held_back or not beyond
            if beyond:  # as slow as the acceleration limit allows
                self.seen["beyond a limit"] += 1
                fastest = max(map(abs, self.last))
                share = min(1.0, change / (fastest + self.slow))
                allowed = self.slow + max(0.0, fastest - self.slow) * (1 - share)
                assert max(map(abs, velocity)) <= allowed + 1e-12

    def _against_limits(self):
        return zip(self.accepted, self.lower, self.upper, strict=True)


# What can happen: each function makes one tick of it. ``tick`` counts from zero while it lasts.


def well(world, rng, tick):
    world.flow(PERIOD, (rng.gauss(0, 1e-4), rng.gauss(0, 1e-4)))
    world.tick(PERIOD, world.message())


def jitter(world, rng, tick):
    elapsed = rng.uniform(0.01, 2.9) * PERIOD
    world.flow(elapsed)
    world.tick(elapsed, world.message())


def again_at_once(world, rng, tick):
    if tick % 3:
        world.tick(0.0)
    else:
        well(world, rng, tick)


def clock_stands_still(world, rng, tick):
    world.flow(PERIOD)
    world.tick(0.0, world.message() if rng.random() < 0.8 else None)


def silence(world, rng, tick):
    world.flow(PERIOD)
    world.tick()


def sends(make, verdict=None):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(PERIOD, world.message(**make(world, rng)), verdict=verdict)

    return happen


def offset(world, rng):
    q = list(world.position)
    q[rng.randrange(2)] += rng.choice((-1, 1)) * rng.uniform(0.2, 5.0)
    return {"position": q}


def counted_to_half_a_turn(world, rng, tick):
    """As drivers do that know no turns; the first joint goes to and fro where it jumps from one half to the other."""
    if not tick:
        world.position = [rng.choice((-1, 1)) * rng.uniform(3.1, 3.14), rng.uniform(-2, 2)]
    world.flow(PERIOD)
    world.position[0] = math.remainder(world.position[0], math.tau)
    onward = np.array([math.copysign(2.0, world.position[0]), 0.0])
    world.policy.trouble = lambda command: onward
    world.tick(PERIOD, world.message())


def teleport(place):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        if not tick:
            world.position = place(world, rng)
        world.tick(PERIOD, world.message())

    return happen


def at_limit(low, high):
    def place(world, rng):
        return [rng.uniform(-9, 9), rng.choice((-1, 1)) * (world.upper[1] + rng.uniform(low, high))]

    return place


def anywhere(world, rng):
    return [rng.uniform(-6, 6), rng.uniform(-2.5, 2.5)]


def troubled(*troubles):
    def happen(world, rng, tick):
        if not tick:
            trouble = rng.choice(troubles)
            world.policy.trouble = trouble(rng) if callable(trouble) else trouble
        well(world, rng, tick)

    return happen


def push(rng):
    vector = np.array([rng.choice((-2.0, 2.0)), rng.choice((-2.0, 0.0, 2.0))])
    return lambda command: vector


def shake(rng):
    phase = rng.uniform(0, 6)
    return lambda command: 3 * np.sin(1e5 * command.astype(float) + phase)


def to_and_fro_at_limit(world, rng, tick):
    """Into the margin, back, and in again."""
    if not tick:
        world.position = at_limit(-0.15, -0.126)(world, rng)
    if not tick % 10:
        outward = np.sign(world.position) * rng.choice((2.0, 2.0, -2.0))
        world.policy.trouble = lambda command: outward
    well(world, rng, tick)


def clock(step):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(step(rng), world.message() if rng.random() < 0.7 else None)

    return happen


def late(world, rng, tick):
    elapsed = rng.uniform(3.05 * PERIOD, 0.95)
    world.flow(elapsed)
    world.tick(elapsed, world.message() if rng.random() < 0.8 else None)


def goal(make):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(PERIOD, world.message(), Goal(*make(rng)))

    return happen


def goal_again(world, rng, tick):
    """The arm drifts, and the goal is said again: exactly, or about."""
    world.flow(PERIOD, (rng.gauss(0, 1e-2), rng.gauss(0, 1e-2)))
    aside = rng.choice((0.0, 0.002, 0.01))
    about = [number + rng.uniform(-aside, aside) for number in world.goal or ()]
    world.tick(PERIOD, world.message(), Goal(about, "base") if about else None)


def on_ring(rng, low=0.3001, high=0.5299):
    radius, angle = rng.uniform(low, high), rng.uniform(-math.pi, math.pi)
    return [radius * math.cos(angle), radius * math.sin(angle)], "base"


def emergency(world, rng, tick):
    if not tick:
        world.emergency_stop()
    well(world, rng, tick)


def reset(world, rng, tick):
    if not tick:
        world.reset()
    well(world, rng, tick)


def forget_goal(world, rng, tick):
    if not tick:
        world.forget_goal()
    well(world, rng, tick)


def interlocked(world, rng, tick):
    """With all that may come in meanwhile."""
    world.flow(PERIOD, (rng.gauss(0, 1e-3), 0.0))
    state = world.message() if rng.random() < 0.9 else None
    new = Goal(*on_ring(rng)) if rng.random() < 0.1 else None
    world.tick(PERIOD, state, new, interlocks=rng.choice((("not enabled",), ["not enabled", "a person is near"])))


def configured(world, rng, tick):
    if not tick:
        world.configure(other_config(rng))
    well(world, rng, tick)


def configured_wrongly(world, rng, tick):
    """What is refused changes nothing, as the ticks that follow show."""
    bad = rng.choice(({"max_velocity": 2.6}, {"clock_jump": 0.05}, {"limit_margin": 2.7}, {"state_timeout": 10.0}))
    with pytest.raises(UserError):
        world.controller.configure(dataclasses.replace(other_config(rng), **bad))
    well(world, rng, tick)


def reset_with_goal(world, rng, tick):
    if not tick:
        world.reset()
    EVENTS["goal" if tick == 1 else "well"](world, rng, tick)


NOT_FINITE = (math.nan, math.inf, -math.inf)
NO_STATES = [
    *({"names": bad} for bad in (None, 7, (["joint1"], "joint2"))),
    *({key: bad} for key in ("position", "velocity") for bad in (("0.1", "0.2"), (None, 0.1), (10**400, 0.1), 0.1)),
    *({"stamp": bad} for bad in ("now", (), 10**400)),
]
EVENTS = {
    "well": well,
    "jitter": jitter,
    "updates three at a time": again_at_once,
    "clock stands still": clock_stands_still,
    "no state": silence,
    "old on arrival": sends(lambda w, rng: {"received": w.now + PERIOD - rng.uniform(0.11, 5.0)}),
    "some age on arrival": sends(lambda w, rng: {"received": w.now + PERIOD - rng.uniform(0.0, 0.09)}),
    "from the future": sends(lambda w, rng: {"received": w.now + rng.uniform(0.1, 5.0)}),
    "reordered": sends(
        lambda w, rng: {"names": NAMES[::-1], "position": w.position[::-1], "velocity": w.velocity[::-1]}
    ),
    "extra joints": sends(
        lambda w, rng: {
            "names": ("x", "joint2", "joint1"),
            "position": (rng.choice(NOT_FINITE), *w.position[::-1]),
            "velocity": (9e9, *w.velocity[::-1]),
        }
    ),
    "joint missing": sends(
        lambda w, rng: {"names": rng.choice((("joint1", "x"), ("x", "joint2"), ("joint1",), ("x",)))}
    ),
    "duplicate name": sends(lambda w, rng: {"names": rng.choice((("joint1", "joint1"), (*NAMES, "joint2")))}),
    "lengths disagree": sends(lambda w, rng: {rng.choice(("position", "velocity")): [0.1] * rng.choice((1, 3))}),
    "position not finite": sends(
        lambda w, rng: {"position": rng.choice(([rng.choice(NOT_FINITE), 0.0], [0.0, math.nan]))}
    ),
    "velocity missing": sends(
        lambda w, rng: {"velocity": rng.choice(((), [math.nan, 0.0], [0.0, math.inf], [math.nan] * 2))}
    ),
    "no lists of numbers": sends(lambda w, rng: rng.choice(NO_STATES), "malformed"),
    "velocity implausible": sends(lambda w, rng: {"velocity": rng.choice(([7.6, 0.0], [0.0, -1e9]))}),
    "position jump": sends(offset),
    "stamp backwards": sends(lambda w, rng: {"stamp": w.stamp - rng.choice((PERIOD + 1e-3, 1.0, 1e6))}),
    "stamp repeated": sends(lambda w, rng: {"stamp": w.before[1] if w.before else 0.0}),
    "stamp not finite": sends(lambda w, rng: {"stamp": rng.choice(NOT_FINITE)}),
    "stamp ahead": sends(lambda w, rng: {"stamp": w.stamp + rng.choice((0.05, 1.0))}),
    "stamp ahead and position jump": sends(
        lambda w, rng: {"stamp": w.stamp + rng.choice((0.1, 1.0, 3600.0)), **offset(w, rng)}
    ),
    "counted to half a turn": counted_to_half_a_turn,
    "arm elsewhere": teleport(anywhere),
    "arm in a margin": teleport(at_limit(-0.12, 0.0)),
    "arm beyond a limit": teleport(at_limit(0.0, 0.15)),
    "arm far beyond a limit": teleport(at_limit(0.25, 1.0)),
    "goal": goal(on_ring),
    "goal again": goal_again,
    "goal not finite": goal(lambda rng: ([rng.choice((*NOT_FINITE, 1.7e308)), rng.choice((0.4, 1.7e308))], "base")),
    "goal of wrong size": goal(lambda rng: ([0.4] * rng.choice((0, 1, 3)), "base")),
    "goal in wrong frame": goal(lambda rng: (on_ring(rng)[0], "world")),
    "goal too far": goal(lambda rng: on_ring(rng, 0.54, 100.0)),
    "goal too near": goal(lambda rng: on_ring(rng, 0.0, 0.29)),
    "policy fails": troubled(*ALL_FAILURES),
    "emergency stop in the policy": troubled("emergency stop"),
    "policy beyond its range": troubled(lambda rng: lambda command: command * 1e3),
    "policy pushes outward": troubled(push),
    "policy shakes": troubled(shake),
    "policy to and fro at a limit": to_and_fro_at_limit,
    "late": late,
    "clock back": clock(lambda rng: -rng.choice((1e-3, PERIOD, 1.0, 500.0))),
    "clock ahead": clock(lambda rng: rng.choice((1.01, 60.0, 1e6))),
    "clock not finite": clock(lambda rng: rng.choice(NOT_FINITE)),
    "emergency stop": emergency,
    "reset": reset,
    "reset, then a goal": reset_with_goal,
    "goal forgotten": forget_goal,
    "interlocked": interlocked,
    "configured": configured,
    "configured wrongly": configured_wrongly,
}
LENGTHS = {
    "policy pushes outward": 300,
    "policy shakes": 100,
    "policy to and fro at a limit": 300,
    "counted to half a turn": 120,
    "arm in a margin": 50,
    "arm beyond a limit": 100,
    "reset": 1,
    "goal forgotten": 1,
    "configured wrongly": 1,
}


def random_config(rng):
    usual = rng.random() < 0.5
    fastest = 0.3 if usual else rng.choice((0.05, 0.3, 1.0))
    return ControllerConfig(
        max_velocity=fastest,
        limit_margin=0.165 if fastest == 1.0 else 0.1,
        max_acceleration=2.0 if usual else rng.choice((0.5, 2.0, 20.0)),
        recovery_states=5 if usual else rng.choice((2, 5, 9)),
        allow_velocity_estimate=rng.random() < 0.5,
        unreachable_goal=rng.choice(("reject", "project")),
    )


def other_config(rng):
    """One that differs in what usually stays, too."""
    return dataclasses.replace(
        random_config(rng),
        state_timeout=rng.choice((0.05, 0.07, 0.1)),
        jump_factor=rng.choice((1.5, 3.0)),
        limit_margin=rng.choice((0.165, 0.2)),
        limit_velocity=rng.choice((0.02, 0.05, 1.0)),
        limit_fault=rng.choice((0.16, 0.2)),
        reached_hysteresis=rng.choice((1.0, 1.5, 3.0)),
        policy_failures=rng.choice((1, 3, 5)),
    )


def drive(policy, seed, updates, log=None):
    """Let things happen to one world after another, and return what was seen."""
    rng, names, seen = random.Random(seed), sorted(EVENTS), Counter()
    done = 0
    while done < updates:
        config = random_config(rng)
        if log is not None:
            log.append(("new", config))
        world = World(policy, config, anywhere(None, rng), log)
        event, left = None, 0
        for tick in range(5000):
            chance = rng.random()
            if not left and chance < 0.025:
                name = rng.choice(names)
                left = LENGTHS.get(name) or rng.choice((1, 1, 2, 3, 6, 20))
                event, begun = EVENTS[name], tick
                seen[name] += 1
            elif world.latched and chance > 0.9:
                if rng.random() < 0.5:
                    world.position = anywhere(world, rng)
                world.reset()
            if left:
                left -= 1
                event(world, rng, tick - begun)
            elif chance > 0.99 or (world.goal is None and chance > 0.9):
                EVENTS["goal"](world, rng, 0)
            else:
                world.policy.trouble = None
                well(world, rng, tick)
        done += 5000
        world.finish()
        seen += world.seen
    seen["updates"] = done
    return seen


SEEDS, UPDATES = range(8), 126_000


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_million_updates_keep_the_contract(policy, seed):
    real = seed == 0  # the others need a third of the time, and what is tested is the controller
    seen = drive(policy if real else Analytic(policy.metadata), seed, UPDATES)
    assert seen["updates"] >= UPDATES
    assert seen["moving"] >= 0.6 * UPDATES
    for state in State:
        assert seen[state] >= 0.001 * UPDATES, state
    for event in EVENTS:
        assert seen[event] >= 10, event
    sights = ("at a limit", "stopped at a limit", "beyond a limit", "held back", "goal projected", "goal rejected")
    for sight in ("good", "malformed", "implausible", "holds", "interlocked", "around", *sights):
        assert seen[sight] >= 100, sight


@pytest.mark.slow
@pytest.mark.parametrize("real", [True, False])
def test_the_same_inputs_give_the_same_outputs_bit_for_bit(policy, real):
    driver, log = policy if real else Analytic(policy.metadata), []
    drive(driver, 99, 20_000, log)
    assert sum(entry[0] == "update" for entry in log) >= 20_000
    for kind, *entry in log:
        if kind == "new":
            troubled_policy = Troubled(driver)
            controller = Controller(troubled_policy, *entry, troubled_policy.stopwatch)
            troubled_policy.stop = controller.emergency_stop
        elif kind == "update":
            inputs, troubled_policy.trouble, *expected = entry
            command = controller.update(*inputs)
            velocity = None if command.velocity is None else command.velocity.tobytes()
            assert [velocity, command.state, command.reasons] == expected
        else:
            getattr(controller, kind)(*entry)


happenings = st.lists(
    st.tuples(st.sampled_from(list(EVENTS)), st.integers(1, 25), st.integers(0, 9)), min_size=1, max_size=40
)


@pytest.mark.slow
@settings(max_examples=600, deadline=None)
@given(st.sampled_from(range(6)), happenings, st.booleans())
def test_whatever_happens_in_whatever_order_the_contract_is_kept(policy, world_seed, happened, known_goal):
    rng = random.Random(world_seed)
    world = World(Analytic(policy.metadata), random_config(rng), anywhere(None, rng))
    if known_goal:
        EVENTS["goal"](world, rng, 0)
    for name, ticks, seed in happened:
        rng = random.Random(seed)
        world.policy.trouble = None
        for tick in range(ticks):
            EVENTS[name](world, rng, tick)
    world.finish()
