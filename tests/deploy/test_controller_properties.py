"""What holds whatever happens: random sequences of states, goals, faults and times against a model of the contract."""

import math
import random
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State
from tests.deploy.conftest import FAILURES, Troubled

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
        self.policy, self.config, self.log = Troubled(policy), config, log
        self.controller = Controller(self.policy, config, self.policy.stopwatch)
        metadata = policy.metadata
        self.lower, self.upper = metadata.position_limit.T.tolist()
        self.plausible = [speed * config.jump_factor for speed in metadata.velocity_limit.tolist()]
        self.acceleration = config.max_acceleration
        self.fastest = config.max_velocity * (1 + 1e-12)
        self.slow = min(config.limit_velocity, config.max_velocity)
        # The arm, and two clocks: that of the controller, and that of the stamps.
        self.position, self.velocity = list(position), STILL
        self.now, self.stamp, self.started = 1000.0, 50.0, False
        # The model.
        self.before = self.accepted = self.goal = self.latched = None
        self.received = 0.0
        self.needed = self.failures = 0
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
        self.controller.emergency_stop()
        self.latched = State.ESTOP
        if self.log is not None:
            self.log.append(("emergency_stop",))

    def reset(self):
        self.controller.reset()
        if self.latched:
            self.latched, self.failures, self.needed = None, 0, self.config.recovery_states
        if self.log is not None:
            self.log.append(("reset",))

    def tick(self, step=PERIOD, state=None, goal=None):
        config, policy = self.config, self.policy
        now = self.now + step
        policy.forget()
        command = self.controller.update(now, state, goal)
        if self.log is not None:
            velocity = None if command.velocity is None else command.velocity.tobytes()
            self.log.append(("update", now, state, goal, policy.trouble, velocity, command.state, command.reasons))
        # The time.
        stop, elapsed, first = True, 0.0, not self.started
        if math.isfinite(now):
            elapsed = PERIOD if first else now - self.now
            self.now, self.started = now, True
            stop = not 0 <= elapsed <= 3 * PERIOD
            if not 0 <= elapsed <= config.clock_jump:
                self.needed = config.recovery_states
            elapsed = min(max(elapsed, 0.0), PERIOD)
        else:
            self.needed = config.recovery_states
        # What came in.
        if goal is not None:
            self._take_goal(goal)
        if state is not None and math.isfinite(now):
            verdict = self._judge(state)
            assert (verdict != "good") == any(reason.startswith("joint state rejected") for reason in command.reasons)
            self.seen[verdict] += 1
            if verdict == "good":
                self.needed = max(0, self.needed - 1)
                far = config.limit_fault
                if any(not lo - far <= q <= hi + far for q, lo, hi in self._against_limits()) and not self.latched:
                    self.latched = State.FAULT
            elif verdict == "implausible" or self.needed:
                self.needed = config.recovery_states
        if self.accepted and now - self.received > config.state_timeout:
            self.needed = config.recovery_states
        # The state that follows.
        velocity = STILL if command.velocity is None else command.velocity.tolist()
        assert (command.velocity is None) == (self.accepted is None and not self.latched)
        if self.latched:
            expected = self.latched
        elif self.accepted is None or (self.goal is None and not self.needed):
            expected = State.WAITING
        elif self.needed:
            expected = State.HOLD
        else:
            expected, stopped = self._drive(stop)
            if stop:  # which of the two, is not said
                expected = command.state if command.state in (State.ACTIVE, State.REACHED) else expected
            stop |= stopped
        assert command.state is expected, (command, expected)
        self.seen[command.state] += 1
        if expected is not State.ACTIVE or stop:
            assert velocity == STILL, command
        elif velocity != STILL:
            self.seen["moving"] += 1
        self._check(velocity, elapsed)
        self.velocity = velocity
        return command

    def _take_goal(self, goal):
        numbers = tuple(float(number) for number in goal.position)
        if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or goal.frame != "base":
            return
        radius = math.hypot(*numbers)
        if not 0.3 <= radius <= 0.53:
            if self.config.unreachable_goal == "reject" or radius < 1e-6:
                return
            scale = min(max(radius, 0.3), 0.53) / radius
            numbers = (numbers[0] * scale, numbers[1] * scale)
        if numbers != self.goal:
            self.goal, self.reached = numbers, False

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
        before, self.before = self.before, (position, state.stamp)
        elapsed = 0.0
        if before is not None:
            elapsed = state.stamp - before[1]
            moves = zip(position, before[0], self.plausible, strict=True)
            if elapsed <= 0 or any(abs(q - p) > speed * elapsed + 0.01 for q, p, speed in moves):
                return "implausible"
        velocity = [state.velocity[i] for i in index] if len(state.velocity) else [math.nan] * 2
        if not all(map(math.isfinite, velocity)):
            if not self.config.allow_velocity_estimate or before is None or elapsed > self.config.state_timeout:
                return "malformed"
            pairs = zip(velocity, position, before[0], strict=True)
            velocity = [v if math.isfinite(v) else (q - p) / elapsed for v, q, p in pairs]
        if any(abs(v) > speed for v, speed in zip(velocity, self.plausible, strict=True)):
            return "implausible"
        received = self.now if state.received is None else min(state.received, self.now)
        if self.now - received > self.config.state_timeout:
            return "implausible"
        self.accepted, self.received = position, received
        return "good"

    def _drive(self, stop):
        """Return the state, and whether a failure of the policy stops the arm."""
        if stop:
            assert not self.policy.called
            return State.ACTIVE, True
        assert math.dist(self.policy.goal.tolist(), self.goal) < 1e-9
        self.reached = self.policy.measured < 0.05 * (self.config.reached_hysteresis if self.reached else 1.0)
        if self.reached:
            return State.REACHED, True
        assert self.policy.called
        self.failures = self.failures + 1 if self.policy.failed else 0
        if self.failures >= self.config.policy_failures:
            self.latched = State.FAULT
        return self.latched or State.ACTIVE, self.policy.failed

    def _check(self, velocity, elapsed):
        """See that the limits hold."""
        change = self.acceleration * elapsed
        for new, last in zip(velocity, self.velocity, strict=True):
            assert abs(new) <= self.fastest  # so, it is finite
            assert new == 0 or abs(new - last) <= change + 1e-12, (new, last, change)
        if self.accepted and velocity != STILL:
            beyond, margin = False, self.config.limit_margin
            for new, (q, lower, upper) in zip(velocity, self._against_limits(), strict=True):
                if q >= upper - margin or q <= lower + margin:
                    self.seen["at a limit"] += 1
                    assert new * q <= 0, (new, q)
                    beyond |= not lower <= q <= upper
            if beyond:  # as slow as the acceleration limit allows
                self.seen["beyond a limit"] += 1
                fastest = max(map(abs, self.velocity))
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
    world.tick(0.0, None)


def silence(world, rng, tick):
    world.flow(PERIOD)
    world.tick()


def sends(make):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        world.tick(PERIOD, world.message(**make(world, rng)))

    return happen


def offset(world, rng):
    q = list(world.position)
    q[rng.randrange(2)] += rng.choice((-1, 1)) * rng.uniform(0.2, 5.0)
    return {"position": q}


def teleport(place):
    def happen(world, rng, tick):
        world.flow(PERIOD)
        if not tick:
            world.position = place(world, rng)
        world.tick(PERIOD, world.message())

    return happen


def at_limit(low, high):
    def place(world, rng):
        side, joint = rng.choice((-1, 1)), rng.randrange(2)
        q = [rng.uniform(-3, 3), rng.uniform(-2, 2)]
        q[joint] = side * (world.upper[joint] + rng.uniform(low, high))
        return q

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
    world.flow(PERIOD, (rng.gauss(0, 1e-2), rng.gauss(0, 1e-2)))
    world.tick(PERIOD, world.message(), Goal(world.goal, "base") if world.goal else None)


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


NOT_FINITE = (math.nan, math.inf, -math.inf)
EVENTS = {
    "well": well,
    "jitter": jitter,
    "update twice at a time": again_at_once,
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
    "velocity implausible": sends(lambda w, rng: {"velocity": rng.choice(([7.6, 0.0], [0.0, -1e9]))}),
    "position jump": sends(offset),
    "stamp backwards": sends(lambda w, rng: {"stamp": w.stamp - rng.choice((PERIOD + 1e-3, 1.0, 1e6))}),
    "stamp repeated": sends(lambda w, rng: {"stamp": w.before[1] if w.before else 0.0}),
    "stamp not finite": sends(lambda w, rng: {"stamp": rng.choice(NOT_FINITE)}),
    "stamp ahead": sends(lambda w, rng: {"stamp": w.stamp + rng.choice((0.05, 1.0))}),
    "arm elsewhere": teleport(anywhere),
    "arm in a margin": teleport(at_limit(-0.12, 0.0)),
    "arm beyond a limit": teleport(at_limit(0.0, 0.15)),
    "arm far beyond a limit": teleport(at_limit(0.25, 1.0)),
    "goal": goal(on_ring),
    "goal again": goal_again,
    "goal not finite": goal(lambda rng: ([rng.choice(NOT_FINITE), 0.4], "base")),
    "goal of wrong size": goal(lambda rng: ([0.4] * rng.choice((0, 1, 3)), "base")),
    "goal in wrong frame": goal(lambda rng: (on_ring(rng)[0], "world")),
    "goal too far": goal(lambda rng: on_ring(rng, 0.54, 100.0)),
    "goal too near": goal(lambda rng: on_ring(rng, 0.0, 0.29)),
    "policy fails": troubled(*FAILURES),
    "policy beyond its range": troubled(lambda rng: lambda command: command * 1e3),
    "policy pushes outward": troubled(push),
    "policy shakes": troubled(shake),
    "late": late,
    "clock back": clock(lambda rng: -rng.choice((1e-3, PERIOD, 1.0, 500.0))),
    "clock ahead": clock(lambda rng: rng.choice((1.01, 60.0, 1e6))),
    "clock not finite": clock(lambda rng: rng.choice(NOT_FINITE)),
    "emergency stop": emergency,
    "reset": reset,
}
LENGTHS = {
    "policy pushes outward": 300,
    "policy shakes": 100,
    "arm in a margin": 50,
    "arm beyond a limit": 100,
    "reset": 1,
}


def random_config(rng):
    usual = rng.random() < 0.5
    return ControllerConfig(
        max_velocity=0.3 if usual else rng.choice((0.05, 0.3, 1.0)),
        max_acceleration=2.0 if usual else rng.choice((0.5, 2.0, 20.0)),
        recovery_states=5 if usual else rng.choice((2, 5, 9)),
        allow_velocity_estimate=rng.random() < 0.5,
        unreachable_goal=rng.choice(("reject", "project")),
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
        for _ in range(100):
            event, left = None, 0
            for tick in range(50):
                chance = rng.random()
                if not left and chance < 0.025:
                    name = rng.choice(names)
                    left = rng.choice((1, 1, 2, 3, 6, LENGTHS.get(name, 20)))
                    event, begun = EVENTS[name], tick
                    seen[name] += 1
                elif world.latched and chance > 0.9:
                    if rng.random() < 0.5:
                        world.position = anywhere(world, rng)
                    world.reset()
                if left:
                    left -= 1
                    event(world, rng, tick - begun)
                else:
                    world.policy.trouble = None
                    well(world, rng, tick)
            if chance < 0.3 or world.goal is None:
                world.policy.trouble = None
                EVENTS["goal"](world, rng, 0)
                done += 1
            done += 50
        seen += world.seen
    seen["updates"] = done
    return seen


SEEDS, UPDATES = range(8), 126_000


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_million_updates_keep_the_contract(policy, seed):
    real = seed % 2 == 0
    seen = drive(policy if real else Analytic(policy.metadata), seed, UPDATES)
    assert seen["updates"] >= UPDATES
    assert seen["moving"] >= 0.4 * UPDATES
    for state in State:
        assert seen[state] >= 0.001 * UPDATES, state
    for event in EVENTS:
        assert seen[event] >= 10, event
    for sight in ("good", "malformed", "implausible", "at a limit", "beyond a limit"):
        assert seen[sight] >= 200, sight


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
        elif kind == "update":
            now, state, new_goal, troubled_policy.trouble, *expected = entry
            command = controller.update(now, state, new_goal)
            velocity = None if command.velocity is None else command.velocity.tobytes()
            assert [velocity, command.state, command.reasons] == expected
        else:
            getattr(controller, kind)()


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
