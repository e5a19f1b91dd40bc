"""Walking a robot on legs around a square over ROS 2, by velocity commands and its odometry."""

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nav_msgs.msg import Odometry

from physai.deploy import Policy, State
from physai.ros.driving.client import Client
from physai.ros.topics import qos

SIDE = 2.0  # m
CORNERS = ((SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 0.0))  # in the frame of the odometry
NEAR = 0.5  # m; a corner that it came as close to has been reached
_TURN_AT = 0.25  # m from a corner, where the next one begins
_PER_CORNER = 60.0  # s
_PERIOD = 0.05  # s between commands
_STEER, _AHEAD = 1.5, 0.6  # rad/s of yaw for each rad that it looks away; and how many rad still count as ahead


@dataclass
class Corner:
    """One corner.

    Attributes:
        place: x and y, m.
        seconds: Until the robot turned to the next one, or until it was given up.
        distance: How close it came, m.
    """

    place: tuple[float, float]
    seconds: float
    distance: float

    @property
    def kept(self) -> bool:
        """Whether it came near."""
        return self.distance <= NEAR

    def describe(self) -> str:
        """One line."""
        x, y = self.place
        how = f"{'passed' if self.kept else 'MISSED'} by {self.distance:.2f} m"
        return f"({x:+.2f}, {y:+.2f}) m  {how}, after {self.seconds:.1f} s"


@dataclass
class Walk:
    """What happened.

    Attributes:
        corners: In order.
        times: Of the odometry, s.
        poses: x, y, m, and yaw, rad, [3] each.
    """

    corners: list[Corner] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)


class SquareClient(Client):
    """Steers a robot from corner to corner.

    Args:
        policy: The one that walks.

    Attributes:
        walk: What happened so far.
    """

    def __init__(self, policy: Policy) -> None:
        metadata = policy.metadata
        super().__init__(metadata, "square_client")
        self.walk = Walk()
        low, high = metadata.region.bounds
        # As fast as the policy was trained for, about: in the midst of its range, and it turns as fast as it can.
        self._speed, self._slow, self._turn = 0.6 * high[0], 0.4 * high[0], min(-low[2], high[2])
        self.node.create_subscription(Odometry, "odom", self._take_odometry, qos.SENSOR)

    def wait_until_ready(self) -> None:
        """Wait for odometry, and for a node that waits for a command.

        Raises:
            UserError: If they do not come.
        """
        self.wait_until("odometry", lambda: self.walk.times, (State.WAITING.value, State.ACTIVE.value))

    def drive(self, goals: int, hold: float, seed: int) -> Iterator[tuple[str, bool]]:
        """See :class:`Client`; goals are the corners of a square, again and again, and at the end it stands."""
        for place in itertools.islice(itertools.cycle(CORNERS), goals):
            corner = self.go(place)
            yield corner.describe(), corner.kept
        self.stand(hold)

    def done(self, hold: float) -> str:
        """See :class:`Client`."""
        return f"corners passed within {NEAR:g} m"

    def draw(self, output: Path) -> None:
        """See :class:`Client`."""
        from physai.plots.walk import draw_walk

        draw_walk(self.walk, self._metadata.robot, NEAR, output)

    def go(self, place: tuple[float, float]) -> Corner:
        """Walk to a place.

        Raises:
            UserError: If the node stops the robot for good, or one of the processes has ended.
        """
        start, first = time.monotonic(), len(self.walk.poses)
        while (distance := self._away(place, -1)[0]) > _TURN_AT and time.monotonic() - start < _PER_CORNER:
            _, away = self._away(place, -1)
            ahead = self._speed if abs(away) < _AHEAD else self._slow
            self.publish([ahead, 0.0, min(self._turn, max(-self._turn, _STEER * away))])
            self.spin(lambda: False, _PERIOD)
        nearest = min([distance, *(self._away(place, index)[0] for index in range(first, len(self.walk.poses)))])
        corner = Corner(place, time.monotonic() - start, nearest)
        self.walk.corners.append(corner)
        return corner

    def stand(self, seconds: float) -> None:
        """Walk to a stand, by commands of zero."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.publish([0.0, 0.0, 0.0])
            self.spin(lambda: False, _PERIOD)

    def _away(self, place: tuple[float, float], index: int) -> tuple[float, float]:
        """How far a place was, m, and in which direction the robot had to turn, rad."""
        x, y, yaw = self.walk.poses[index].tolist()
        dx, dy = place[0] - x, place[1] - y
        return math.hypot(dx, dy), (math.atan2(dy, dx) - yaw + math.pi) % (2 * math.pi) - math.pi

    def _take_odometry(self, message: Odometry) -> None:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y * turn.y + turn.z * turn.z))
        self.walk.times.append(time.monotonic())
        self.walk.poses.append(np.array([place.x, place.y, yaw]))
