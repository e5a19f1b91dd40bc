"""An arm, its controller, and a model of the controller's contract that checks every command."""

import math
from collections import Counter
from operator import mul

import numpy as np

from physai.deploy import Controller, JointState, State
from physai.signals import Quantity
from tests.deploy.troubled import Troubled

PERIOD = 0.02
NAMES = ("joint1", "joint2")
STILL = [0.0, 0.0]
WHOLE = ((0, 0), (1, 1))
LAGS = 8  # periods in 0.16 s
CLOSE = 1e-9  # rad; so near to a threshold of Motion, rounding decides


class Analytic:
    """A policy in few lines, for speed: by inverse kinematics straight to the goal, for links of 0.30 and 0.25 m."""

    def __init__(self, metadata):
        self.metadata, self.sha256 = metadata, ""

    def error(self, position, goal):
        q1, q2 = position.tolist()
        x, y = 0.3 * math.cos(q1) + 0.25 * math.cos(q1 + q2), 0.3 * math.sin(q1) + 0.25 * math.sin(q1 + q2)
        return np.array([math.hypot(x - goal[0], y - goal[1])])

    def __call__(self, position, velocity, goal, *last_command):
        x, y = goal.tolist()
        cosine = (x * x + y * y - 0.1525) / 0.15
        elbow = math.acos(min(1.0, max(-1.0, cosine)))
        shoulder = math.atan2(y, x) - math.atan2(0.25 * math.sin(elbow), 0.3 + 0.25 * math.cos(elbow))
        velocity = np.clip(4.0 * (np.array([shoulder, elbow]) - position), -2.0, 2.0)
        if last_command:
            return (last_command[0] + PERIOD * velocity).astype(np.float32)
        return velocity.astype(np.float32)


class Motion:
    """What ``Following`` promises, again and simply: where the arm should be and where it was, a period a row.

    How far something went in a window is the slope of the straight line that fits its rows best, times the window.
    """

    def __init__(self, config):
        self.config, count = config, round(config.following_window / PERIOD)
        self.rows, self.seconds, self.start = count + 1, count * PERIOD, None
        spread = sum((row - count / 2) ** 2 for row in range(count + 1))
        self.weights = [(row - count / 2) * count / spread for row in range(count + 1)]

    def _went(self, path, back=0):
        return sum(map(mul, self.weights, path[len(path) - self.rows - back :]))

    def commanded(self, now, velocity):
        """Until now, since the last call."""
        if self.start is None:
            self.start = self.at = now
            self.row, self.next, self.before = 0, None, None
            # Where each joint was told to be, was, and would be if it moved as it says; it stood until the start.
            self.told = [[0.0] * (self.rows + LAGS), [0.0] * (self.rows + LAGS)]
            self.was, self.says, self.last = [[], []], [[], []], [0.0, 0.0]
            self.target = STILL
            return
        (q1, q2), (v1, v2) = self.target, velocity
        while (at := self.start + (self.row + 1) * PERIOD) <= now:
            self.row += 1
            self.told[0].append(q1 + v1 * (at - self.at))
            self.told[1].append(q2 + v2 * (at - self.at))
        self.target = (q1 + v1 * (now - self.at), q2 + v2 * (now - self.at))
        self.at = now

    def heard(self, received, moved, velocity):
        """Return by how much commands are missed, and reported velocities contradict positions; None: nobody knows.

        Where either is below zero, it may be farther below.
        """
        if self.start is None or received < self.start:
            return None
        if self.before is None:
            self.first = self.next = math.ceil((received - self.start) / PERIOD - 1e-9)
            self.before = then, old, speed = received, tuple(moved), tuple(velocity)
        else:
            then, old, speed = self.before
            if received <= then:
                return None
        row = self.next
        while (at := self.start + self.next * PERIOD) <= received:
            share = (at - then) / (received - then) if received > then else 1.0
            for joint in (0, 1):
                was, says = self.was[joint], self.says[joint]
                v = speed[joint] + (velocity[joint] - speed[joint]) * share
                says.append(says[-1] + PERIOD * (self.last[joint] + v) / 2 if was else 0.0)
                was.append(old[joint] + (moved[joint] - old[joint]) * share)
                self.last[joint] = v
            self.next += 1
        self.before = received, tuple(moved), tuple(velocity)
        return self._compare() if self.next > row and self.next - self.first >= self.rows else None

    def _compare(self):
        config, back = self.config, self.row - self.next + 1  # rows that were commanded, and not yet seen
        went = [self._went(was) for was in self.was]
        says = [self._went(says) for says in self.says]
        told = [self._went(told, back) for told in self.told]
        missed = max(abs(one - other) for one, other in zip(went, told, strict=True)) - 0.015
        most = (
            max(abs(one - other) for one, other in zip(went, says, strict=True)) - config.velocity_error * self.seconds
        )
        if missed < -CLOSE and most < -CLOSE:  # without regard to delays and shares, which allow for more
            return missed, most
        told = [[self._went(path, back + lag) for lag in range(LAGS + 1)] for path in self.told]
        largest = [max(map(abs, each)) for each in told]
        missed = contradicted = -math.inf
        for joint in (0, 1):
            allowed = 0.015 + config.following_error * max(largest[joint], 0.5 * max(largest))
            missed = max(missed, min(told[joint]) - went[joint] - allowed, went[joint] - max(told[joint]) - allowed)
            allowed = config.velocity_error * self.seconds + 0.3 * max(abs(says[joint]), abs(went[joint]))
            contradicted = max(contradicted, abs(says[joint] - went[joint]) - allowed)
        return missed, contradicted


class World:
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
        # Of positions, what they stand for is looked at; their differences are rounded.
        self.positions = policy.metadata.command.quantity is Quantity.JOINT_POSITION
        self.rounding = 1e-9 if self.positions else 1e-12
        self.target, self.stands, self.bound = None, True, False
        self._take_config(config)
        self.lower, self.upper = policy.metadata.position_limit.T.tolist()
        self.turns = [math.isinf(upper) for upper in self.upper]
        self.strongest = policy.metadata.effort_limit.tolist()
        # The arm, and two clocks: that of the controller, and that of the stamps.
        self.position, self.velocity, self.last = list(position), STILL, STILL
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
        """Let the arm follow its last command."""
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
        self.last = self._slowed(self.last)
        self._see_position()

    def _slowed(self, velocities):
        share = min(1.0, self.config.max_velocity / max(*map(abs, velocities), 1e-9))
        return [velocity * share for velocity in velocities]

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
        now = self.now + step
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
            self.motion.commanded(now, self.last)
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
        if self.positions and command.value is not None:
            velocity = self._velocity_of(velocity, stop, elapsed)
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
        if not self.bound:  # where the arm is counts more than how fast
            self._check(velocity, elapsed, stop, "a joint" in said)
        self.bound = False
        self.velocity, self.last = velocity, self._slowed(velocity)
        return command

    def _velocity_of(self, target, stop, elapsed):
        """See that positions are where they may be; return the velocities that they stand for."""
        begins, before = self.stands, self.target
        self.target, self.stands = target, stop
        if stop:
            if not begins or before is None:  # where the arm is said to be, and from then on the same
                before = self.accepted
            assert target == before, (target, before)
            return STILL
        velocity, most = [], self.config.max_lead
        rows = zip(target, self.accepted if begins else before, self.turns, self._against_limits(), strict=True)
        for new, old, turns, (q, lower, upper) in rows:
            moved, ahead = new - old, new - q
            if turns:  # its count may have gone around
                moved = math.remainder(moved, math.tau)
            assert abs(ahead) <= most + 1e-9, (new, q)
            assert min(q, lower) - 1e-9 <= new <= max(q, upper) + 1e-9, (new, q)
            edges = (most, -most, max(0.0, upper - q), min(0.0, lower - q))  # beyond a limit: where it is
            bound = any(abs(ahead - edge) < 1e-6 for edge in edges)
            self.bound |= bound
            self.seen["held near the arm"] += bound
            assert elapsed or abs(moved) < 1e-9 or bound
            velocity.append(moved / elapsed if elapsed else self.last[len(velocity)])
        return velocity

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

    def _take_state(self, state, stop, verdict):
        """Return what is to be made of it."""
        before = min(self.heard)
        verdict = verdict or self._judge(state)
        if verdict == "good" and self._see(before):
            verdict = "implausible"
        self.seen[verdict] += 1
        if verdict == "good":
            if not stop and self.complete:
                self.needed = max(0, self.needed - 1)
        elif verdict == "implausible":
            self._hold()
        elif verdict == "malformed" and self.needed:
            self.needed = self.config.recovery_states
        return verdict

    def _judge(self, state):
        names, count = state.names, len(state.names)
        places = WHOLE if names == NAMES else [(j, names.index(name)) for j, name in enumerate(NAMES) if name in names]
        if not places:
            return "other"
        if names != NAMES and len(set(names)) < count:
            return "malformed"
        if len(state.position) != count or len(state.velocity) not in (0, count) or len(state.effort) not in (0, count):
            return "malformed"
        position = [state.position[i] for _, i in places]
        if not (math.isfinite(state.stamp) and all(map(math.isfinite, position))):
            return "malformed"
        received = self.now if state.received is None else min(state.received, self.now)
        velocity = [state.velocity[i] for _, i in places] if len(state.velocity) else [math.nan] * len(places)
        moves, times, plausible, stamp = [], [], True, state.stamp
        for (joint, _), q in zip(places, position, strict=True):
            told, self.told[joint] = self.told[joint], (q, stamp, received)
            if told is None:
                moves.append(0.0)
                times.append(math.inf)
                continue
            before, elapsed, passed = told[0], stamp - told[1], received - told[2]
            moved = q - before
            if self.turns[joint] and not -3 < moved < 3:  # the shorter way around
                moved = math.remainder(moved, math.tau)
                self.seen["around"] += abs(moved) < 3
            allowed = min(elapsed, max(0.0, passed) + self.config.state_timeout)
            plausible &= elapsed > 0 and abs(moved) <= self.plausible[joint] * allowed + 0.01
            moves.append(moved)
            times.append(elapsed)
        if not plausible:
            return "implausible"
        for (joint, _), moved in zip(places, moves, strict=True):
            self.moved[joint] += moved
        if not all(map(math.isfinite, velocity)):
            unknown = [row for row, speed in enumerate(velocity) if not math.isfinite(speed)]
            if (
                not self.config.allow_velocity_estimate
                or max(times[row] for row in unknown) > self.config.state_timeout
            ):
                return "malformed"
            for row in unknown:
                most = self.plausible[places[row][0]]
                velocity[row] = min(most, max(-most, moves[row] / times[row]))
        if any(abs(speed) > self.plausible[joint] for speed, (joint, _) in zip(velocity, places, strict=True)):
            return "implausible"
        if self.now - received > self.config.state_timeout:
            return "implausible"
        self.another = False
        if len(state.effort):
            self.feels = True
        for speed, q, (joint, i) in zip(velocity, position, places, strict=True):
            self.accepted[joint], self.speed[joint], self.heard[joint] = q, speed, received
            if self.feels:
                self.effort[joint] = state.effort[i] if len(state.effort) else math.nan
            if state.source is not None:
                self.another |= self.sources[joint] not in (None, state.source)
                self.sources[joint] = state.source
        self.fresh |= {joint for joint, _ in places}
        self.complete = len(self.fresh) == len(NAMES)
        if self.complete:
            self.fresh = set()
        return "good"

    def _see(self, before):
        """Look at a good state; return whether its velocities contradict its positions."""
        config, received = self.config, min(self.heard)
        if self.another or (before > -math.inf and received - before > config.resume_timeout):
            self._hold()
            if self.goal is not None:
                self.seen["goal forgotten"] += 1
                self.seen["goal forgotten after a silence"] += not self.another
                self._forget()
        self._see_position()
        if received == -math.inf:
            return False
        if self.feels:
            rows = zip(self.effort, self.strongest, self.too_strong, strict=True)
            self.too_strong = [min(since, received) if abs(e) > most else math.inf for e, most, since in rows]
            since = min(self.too_strong)
            if since < math.inf and received - since >= config.effort_time:
                self._fault("effort")
        differs = self.motion.heard(received, self.moved, self.speed)
        if differs is None:
            return False
        missed, contradicted = differs
        counters = self.controller.snapshot()["counters"] if min(map(abs, differs)) < CLOSE else {}
        if abs(missed) < CLOSE:
            missed = counters.get("faults: following", 0) - self.seen["faults: following"]
        if missed > 0:
            self._fault("following")
            return False
        if abs(contradicted) < CLOSE:
            name = "states rejected: velocity inconsistent"
            contradicted = counters.get(name, 0) - self.seen["contradicted"]
        self.seen["contradicted"] += contradicted > 0
        return contradicted > 0

    def _see_position(self):
        far = self.config.limit_fault
        if any(q < lower - far or q > upper + far for q, lower, upper in self._against_limits()):
            self._fault("position")

    def _see_age(self, now, reasons, said):
        oldest = min(self.heard)
        old = oldest > -math.inf and now - oldest > self.config.state_timeout
        if old:
            self._hold()
            one = max(self.heard) == oldest
            what = "joint state" if one else f"state of '{NAMES[self.heard.index(oldest)]}'"
            assert f"the last {what} is {now - oldest:.3f} s old" in reasons
        assert ("the last" in said) == old

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

    def _check(self, velocity, elapsed, stopped, held_back):
        """See that the limits hold."""
        change, margin = self.acceleration * elapsed, self.config.limit_margin
        sides = [(q >= upper - margin) - (q <= lower + margin) for q, lower, upper in self._against_limits()]
        beyond = any(sides) and any(q < lower or q > upper for q, lower, upper in self._against_limits())
        slowed = beyond and max(map(abs, self.last)) > self.slow
        for new, last, side in zip(velocity, self.last, sides, strict=True):
            assert abs(new) <= self.fastest  # so, it is finite
            self.seen["at a limit"] += side != 0 and not stopped
            assert new * side <= self.rounding, (new, side)
            if not stopped and last * side > self.rounding:
                self.seen["stopped at a limit"] += 1
                assert abs(new) <= self.rounding, (new, last)
            elif slowed:  # at once, but not to another direction
                assert (
                    stopped or min(0.0, last - change) - self.rounding <= new <= max(0.0, last + change) + self.rounding
                )
            else:
                assert stopped or abs(new - last) <= change + self.rounding, (new, last, change)
        if not stopped:
            assert any(sides) or not held_back
            assert held_back or not beyond
            if beyond:
                self.seen["beyond a limit"] += 1
                self.seen["slowed beyond a limit"] += slowed
                assert max(map(abs, velocity)) <= self.slow + self.rounding

    def _against_limits(self):
        return zip(self.accepted, self.lower, self.upper, strict=True)
