"""An arm, its controller, and a model of the controller's contract that checks every command."""

import math
from collections import Counter

from physai.deploy import Controller, JointState, State
from physai.signals import Quantity
from tests.deploy.hearing import NAMES, Hearing
from tests.deploy.motion import PERIOD, STILL, Analytic, Motion
from tests.deploy.targets import Targets
from tests.deploy.troubled import Troubled

__all__ = ["NAMES", "PERIOD", "Analytic", "World"]


class World(Hearing):
    """An arm that follows its commands, a controller, and a model of what the contract demands of it.

    ``tick`` checks every command against the model; ``log`` keeps what went in and came out.

    Args:
        way: How the arm tells of its joints: "whole", both in a message; "list", a message each, two an update;
            "alternating", a message each, one an update.
    """

    def __init__(self, policy, config, position, log=None, way="whole"):
        self.policy, self.log, self.way = Troubled(policy), log, way
        self.controller = Controller(self.policy, config, self.policy.stopwatch)
        self.policy.stop = self.controller.emergency_stop
        self.tolerance = policy.metadata.tolerances[0].value
        self.lower, self.upper = policy.metadata.position_limit.T.tolist()
        # Of positions, what they stand for is looked at; their differences are rounded.
        self.positions = policy.metadata.command.quantity is Quantity.JOINT_POSITION
        self.rounding = 1e-9 if self.positions else 1e-12
        self.targets, self.broken_drives = Targets(self.lower, self.upper), None
        self._take_config(config)
        self.turns = [math.isinf(upper) for upper in self.upper]
        self.strongest = policy.metadata.effort_limit.tolist()
        # The arm, and two clocks: that of the controller, and that of the stamps.
        self.position, self.velocity, self.last = list(position), STILL, [(0.0, 0.0)] * 2
        self.now, self.stamp, self.started = 1000.0, 50.0, False
        self.source, self.turn = None, 0
        # The model, of the controller,
        self.state, self.goal, self.latched = State.WAITING, None, None
        self.needed = self.failures = self.still = 0
        self.reached = self.gave_up = False
        self.nearest, self.waited = math.inf, 0.0
        self.too_strong = [math.inf, math.inf]  # since when
        # and of what has been heard, by joint: last well-formed states, last good ones.
        self.told = [None, None]
        self.accepted, self.speed, self.effort = ([math.nan, math.nan] for _ in range(3))
        self.moved, self.heard, self.sources = [0.0, 0.0], [-math.inf, -math.inf], [None, None]
        self.feels, self.fresh = False, set()
        self.seen = Counter()

    def flow(self, elapsed, noise=(0.0, 0.0)):
        """Let the arm follow its last command, as far as its drives do what they are told."""
        if self.positions:
            self.velocity = self.targets.velocity(self.position, elapsed, 1.2 * self.config.max_velocity)
        if self.broken_drives is not None:
            joints, factor, bias = self.broken_drives
            self.velocity = [factor * v + bias if joint in joints else v for joint, v in enumerate(self.velocity)]
            self.broken_drives = None
        self.position = [q + v * elapsed + e for q, v, e in zip(self.position, self.velocity, noise, strict=True)]
        self.stamp += elapsed

    def message(self, names=NAMES, position=None, velocity=None, stamp=None, received=None, effort=()):
        return JointState(
            names,
            self.position if position is None else position,
            self.velocity if velocity is None else velocity,
            self.stamp if stamp is None else stamp,
            received,
            effort,
            self.source,
        )

    def part(self, joint):
        return self.message((NAMES[joint],), self.position[joint : joint + 1], self.velocity[joint : joint + 1])

    def report(self):
        """What the arm says of itself in a period, in its way."""
        if self.way == "whole":
            return self.message()
        self.turn = 1 - self.turn
        return [self.part(0), self.part(1)] if self.way == "list" else self.part(self.turn)

    def emergency_stop(self):
        self._tell("emergency_stop")
        self.latched = State.ESTOP

    def reset(self):
        needed = self.latched is not None or self.gave_up
        assert self._tell("reset") is needed
        if needed:
            self.latched, self.failures, self.needed = None, 0, self.config.recovery_states
            self.too_strong = [math.inf, math.inf]
            self._forget()

    def forget_goal(self):
        self._tell("forget_goal")
        self._forget()

    def configure(self, config):
        self._tell("configure", config)
        self._take_config(config)
        self.last = self._slowed(self.last, self.config.max_velocity)
        self._see_position()

    @staticmethod
    def _slowed(ranges, fastest):
        """Ranges of velocities that are slowed down together, if one of them is too fast."""
        share = min(1.0, fastest / max(abs(v) for pair in (*ranges, (1e-9,)) for v in pair))
        exact = all(low == high for low, high in ranges)
        return [
            (low * share, high * share)
            if exact
            else (max(-fastest, min(low, low * share)), min(fastest, max(high, high * share)))
            for low, high in ranges
        ]

    def _take_config(self, config):
        self.config, self.motion = config, Motion(config)
        self.plausible = [speed * config.jump_factor for speed in self.policy.metadata.velocity_limit.tolist()]
        self.acceleration = config.max_acceleration
        self.fastest = config.max_velocity + self.rounding
        self.slow = min(config.limit_velocity, config.max_velocity)

    def _tell(self, what, *arguments):
        answer = getattr(self.controller, what)(*arguments)
        if self.log is not None:
            self.log.append((what, *arguments))
        return answer

    def tick(self, step=PERIOD, state=None, goal=None, verdict=None, interlocks=()):
        """Update once, with one joint state or a list; a verdict is only given on one that is no list of numbers."""
        policy, counted = self.policy, self.seen
        now, before = self.now + step, self.now
        policy.forget()
        command = self.controller.update(now, state, goal, interlocks)
        if self.log is not None:
            velocity = None if command.value is None else command.value.tobytes()
            inputs = (now, state, goal, interlocks)
            self.log.append(("update", inputs, policy.trouble, velocity, command.state, command.reasons))
        stop, elapsed = self._take_time(now)
        said = [" ".join(reason.split(None, 2)[:2]) for reason in command.reasons]
        # What came in.
        if goal is not None:
            verdict_on_goal = self._take_goal(goal)
            assert ("goal rejected:" in said) == (verdict_on_goal == "rejected")
            assert ("goal out" in said) == (verdict_on_goal == "projected")
            counted[f"goal {verdict_on_goal}"] += 1
        if stop or self.state is not State.ACTIVE:
            self.motion.start = None
        else:
            told = self.targets.way if self.positions else [v * (now - before) for v, _ in self.last]
            self.motion.commanded(now, told)
        refused = 0
        if state is not None and math.isfinite(now):
            forgotten = counted["goal forgotten"]
            for one in state if isinstance(state, list) else (state,):
                refused += self._take_state(one, stop, verdict) in ("malformed", "implausible")
            assert ("goal forgotten:" in said) == (counted["goal forgotten"] > forgotten)
        assert said.count("joint state") == refused
        self._see_age(now, command.reasons, said)
        # The state that follows.
        unheard = min(self.heard) == -math.inf
        assert (command.value is None) == (unheard and (self.positions or not self.latched))
        if self.latched:
            expected = self.latched
        elif unheard:
            expected, missing = State.WAITING, NAMES[self.heard.index(-math.inf)]
            nothing = max(self.heard) == -math.inf
            assert ("no joint state yet" if nothing else f"no state of '{missing}' yet") in command.reasons
        elif self.needed or self.gave_up:
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
            assert policy.error_told is None
            assert not policy.called
        else:
            expected, stop = self._drive(stop, elapsed)
        assert command.state is expected, (command, expected)
        velocity = STILL if command.value is None else command.value.tolist()
        sides = self._sides()
        if self.positions and command.value is not None:
            velocity = self._velocity_of(velocity, stop, elapsed, sides)
        assert ("no progress" in said) == (expected is State.HOLD and not self.needed)
        if expected is not self.state:
            self.state = expected
            counted[f"entered {expected.value}"] += 1
        counted[command.state] += 1
        counted["moving"] += velocity != STILL
        counted["held back"] += "a joint" in said
        if stop:
            assert velocity == STILL, command
            assert command.reasons or expected is State.REACHED
        self._check(velocity, elapsed, stop, "a joint" in said, sides)
        self.velocity, self.last = velocity, self._ranges(velocity, stop, elapsed, sides)
        return command

    def _velocity_of(self, target, stop, elapsed, sides):
        """See that positions are where they may be; return the velocities that they stand for."""
        targets, lead = self.targets, self.config.max_lead
        if stop:
            self.seen["stood elsewhere"] += targets.stood(target, self.accepted, lead)
            return STILL
        targets.moved(target, self.accepted, lead)
        self.seen["held near the arm"] += len(targets.held)
        if elapsed:
            return [way / elapsed for way in targets.way]
        assert all(abs(way) < 1e-9 or joint in targets.held for joint, way in enumerate(targets.way))
        return STILL

    def _ranges(self, velocity, stop, elapsed, sides):
        """Between which velocities each joint goes on: those of a target that was held back are not seen."""
        if stop or not self.positions:
            return [(v, v) for v in velocity]
        if elapsed:
            rows = enumerate(velocity)
            return [(min(0.0, v), max(0.0, v)) if joint in self.targets.held else (v, v) for joint, v in rows]
        inward = [
            (low * (low * side <= 0), high * (high * side <= 0))
            for (low, high), side in zip(self.last, sides, strict=True)
        ]
        return self._slowed(inward, self.slow) if self._beyond() else inward

    def finish(self):
        """Compare the controller's counters and what it remembers with the model's."""
        snapshot, seen = self.controller.snapshot(), self.seen
        counters = Counter(snapshot["counters"])

        def total(prefix):
            return sum(count for name, count in counters.items() if name.startswith(prefix))

        assert total("states rejected: ") == seen["malformed"] + seen["implausible"]
        assert total("holds: ") == seen["holds"] + seen["holds: no progress"]
        assert total("goals forgotten: ") == seen["goal forgotten"]
        assert total("goals rejected: ") == seen["goal rejected"]
        assert total("faults: ") == sum(count for name, count in seen.items() if str(name).startswith("faults: "))
        exact = {name: seen[name] for name in counters if name.startswith(("faults", "entered"))}
        exact |= {
            "states": seen["good"],
            "states of other joints": seen["other"],
            "states rejected: velocity inconsistent": seen["contradicted"],
            "goals": seen["goal taken"] + seen["goal projected"],
            "goals projected": seen["goal projected"],
            "ticks at a position limit": seen["held back"],
            "holds: no progress": seen["holds: no progress"],
        }
        for name, count in exact.items():
            assert counters[name] == count, (name, counters, seen)
        assert snapshot["recovery_states_needed"] == self.needed
        assert (snapshot["goal"] is None) == (self.goal is None)

    def _hold(self):
        self.seen["holds"] += not self.needed
        self.needed = self.config.recovery_states

    def _fault(self, kind):
        if not self.latched:
            self.latched = State.FAULT
            self.seen[f"faults: {kind}"] += 1

    def _forget(self):
        self.goal, self.reached, self.gave_up = None, False, False
        self.nearest, self.waited = math.inf, 0.0

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
        numbers, verdict = tuple(float(number) for number in goal.value), "taken"
        if len(numbers) != 2 or not all(map(math.isfinite, numbers)) or goal.frame != "base":
            return "rejected"
        radius = math.hypot(*numbers)
        if not 0.3 - 1e-6 <= radius <= 0.53 + 1e-6:
            if self.config.unreachable_goal == "reject" or radius < 1e-6 or math.isinf(radius):
                return "rejected"
            scale, verdict = min(max(radius, 0.3), 0.53) / radius, "projected"
            numbers = (numbers[0] * scale, numbers[1] * scale)
        moved = 0.1 * self.tolerance
        if not self.goal or max(abs(new - old) for new, old in zip(numbers, self.goal, strict=True)) > moved:
            self._forget()
        self.goal = numbers
        return verdict

    def _drive(self, stop, elapsed):
        """Return the state, and whether the arm stands in this tick."""
        policy, standing = self.policy, State.REACHED if self.reached else State.ACTIVE
        if stop:
            assert policy.error_told is None
            assert not policy.called
            return standing, True
        assert math.dist(policy.goal.tolist(), self.goal) < 1e-9
        if policy.error_told is not None:
            hysteresis = self.config.reached_hysteresis if self.reached else 1.0
            self.reached = policy.error_told < self.tolerance * hysteresis
            if self.reached:
                self.nearest, self.waited = math.inf, 0.0
                assert not policy.called
                return State.REACHED, True
            if policy.error_told < self.nearest - 0.1 * self.tolerance:
                self.nearest, self.waited = policy.error_told, 0.0
            else:
                self.waited += elapsed
            if self.waited > self.config.progress_timeout:
                self.gave_up = True
                self.seen["holds: no progress"] += 1
                assert not policy.called
                return State.HOLD, True
            assert policy.called
            standing = State.ACTIVE
        self.failures = self.failures + 1 if policy.failed else 0
        if policy.stopped:
            self.latched = State.ESTOP
        elif self.failures >= self.config.policy_failures:
            self._fault("policy")
        return self.latched or standing, policy.failed or policy.stopped

    def _check(self, velocity, elapsed, stopped, held_back, sides):
        """See that the limits hold."""
        change, beyond = self.acceleration * elapsed, any(sides) and self._beyond()
        slowed = beyond and max(abs(v) for pair in self.last for v in pair) > self.slow
        for joint, (new, (low, high), side) in enumerate(zip(velocity, self.last, sides, strict=True)):
            if joint in self.targets.held or (self.positions and not elapsed):  # where the arm is counts more
                continue
            assert abs(new) <= self.fastest  # so, it is finite
            self.seen["at a limit"] += side != 0 and not stopped
            assert new * side <= self.rounding, (new, side)
            if not stopped and min(low * side, high * side) > self.rounding:
                self.seen["stopped at a limit"] += 1
                assert abs(new) <= self.rounding, (new, low)
            elif not stopped and max(low * side, high * side) <= self.rounding:
                low, high = low - change, high + change
                if slowed:  # at once, but not to another direction
                    low, high = min(0.0, low), max(0.0, high)
                assert low - self.rounding <= new <= high + self.rounding, (new, low, high, change)
        if not stopped:
            assert any(sides) or not held_back
            assert held_back or not beyond
            if beyond:
                self.seen["beyond a limit"] += 1
                self.seen["slowed beyond a limit"] += slowed
                free = [abs(v) for joint, v in enumerate(velocity) if joint not in self.targets.held]
                assert max(free, default=0.0) <= self.slow + self.rounding

    def _sides(self):
        """At which limit each joint is, or is told to be: 1, -1 or 0."""
        begins = self.targets.begins(self.accepted)
        margin, rows = self.config.limit_margin, zip(begins, self._against_limits(), strict=True)
        return [(max(q, told) >= upper - margin) - (min(q, told) <= lower + margin) for told, (q, lower, upper) in rows]

    def _beyond(self):
        return any(q < lower or q > upper for q, lower, upper in self._against_limits())

    def _against_limits(self):
        return zip(self.accepted, self.lower, self.upper, strict=True)
