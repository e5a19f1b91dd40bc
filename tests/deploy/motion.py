"""A policy in few lines, and what a controller promises about arms that do not follow."""

import math
from operator import mul

import numpy as np

PERIOD = 0.02
STILL = [0.0, 0.0]
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

    def commanded(self, now, way):
        """How far until now, since the last call."""
        if self.start is None:
            self.start = self.at = now
            self.row, self.next, self.before = 0, None, None
            # Where each joint was told to be, was, and would be if it moved as it says; it stood until the start.
            self.told = [[0.0] * (self.rows + LAGS), [0.0] * (self.rows + LAGS)]
            self.was, self.says, self.last = [[], []], [[], []], [0.0, 0.0]
            self.target = STILL
            return
        (q1, q2), (way1, way2) = self.target, way
        while (at := self.start + (self.row + 1) * PERIOD) <= now:
            self.row += 1
            share = (at - self.at) / (now - self.at) if now > self.at else 1.0
            self.told[0].append(q1 + way1 * share)
            self.told[1].append(q2 + way2 * share)
        self.target = (q1 + way1, q2 + way2)
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
