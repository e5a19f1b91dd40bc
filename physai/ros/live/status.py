"""What is known of a robot that an inference node drives, and what people are told of it: words, and no ROS."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from physai.deploy import State

SILENT = 3.0  # s without a word after which nobody knows what it does: it tells of itself once a second
_SAID = 15.0  # s that an answer is shown
_USUAL = ("updates", "entered ", "ticks ", "states of other joints")  # counters that say nothing of trouble


class Level(Enum):
    """How urgent it is: its value is a colour, red green blue."""

    FINE = (40, 160, 80)
    WARNING = (230, 150, 0)
    ERROR = (215, 40, 40)
    GONE = (130, 130, 130)


_LEVELS = {State.HOLD.value: Level.WARNING, State.FAULT.value: Level.ERROR, State.ESTOP.value: Level.ERROR}


@dataclass
class Status:
    """A robot, as it tells of itself; times are s on the clock of whoever fills it in.

    Attributes:
        namespace: Where its inference node is; empty for none.
        since: When that node came or went.
        present: Whether it is there.
        state: Its state, a value of :class:`physai.deploy.State`.
        words: The state with its reasons.
        told: When it said these.
        values: What else it says of itself, as text.
        joint_position: rad, by name.
        moved: When these came.
        rate: How often they come, Hz.
        turn: Of the base of a robot on legs, as its IMU says, a quaternion x, y, z, w; None while it has said nothing.
        description: Its URDF; empty while it has told none.
        goal_description: What its goals are, JSON; the same.
        said: What became of the last thing that it was asked.
        said_at: Since when.
        goal_sent: The goal that it was sent last by this page, and when; None for none.
    """

    namespace: str
    since: float = -math.inf
    present: bool = False
    state: str = ""
    words: str = ""
    told: float = -math.inf
    values: Mapping[str, str] = field(default_factory=dict)
    joint_position: Mapping[str, float] = field(default_factory=dict)
    moved: float = -math.inf
    rate: float = 0.0
    turn: np.ndarray | None = None
    description: str = ""
    goal_description: str = ""
    said: str = ""
    said_at: float = -math.inf
    goal_sent: tuple[np.ndarray, float] | None = None

    @property
    def name(self) -> str:
        """What people call it."""
        return self.namespace.strip("/") or "robot"

    @property
    def goal(self) -> np.ndarray | None:
        """What its controller goes for; None if it has no goal."""
        try:
            goal = np.array(json.loads(self.values.get("goal", "")), dtype=np.float64)
        except (ValueError, TypeError):
            return None
        return goal if goal.ndim == 1 and goal.size and np.isfinite(goal).all() else None

    def headline(self, now: float) -> tuple[Level, str]:
        """Say in one line what it does, and why."""
        if not self.present:
            return Level.GONE, f"GONE {_ago(now - self.since)}; its node is not there"
        age = now - self.told
        if not self.state or math.isinf(age):
            return Level.GONE, "it has not said anything yet"
        if age > SILENT:
            return Level.GONE, f"SILENT: its last words, {_ago(age)}: {self.words}"
        state, _, reasons = self.words.partition(": ")
        if state != self.state:  # its state travels faster than the words
            reasons = ""
        return _LEVELS.get(self.state, Level.FINE), self.state.upper() + (f": {reasons}" if reasons else "")

    def details(self, now: float) -> list[tuple[str, str]]:
        """What else there is to know: pairs of what it is, and its value."""
        values = self.values
        joints = "none yet" if math.isinf(self.moved) else f"{self.rate:.0f} Hz, the last {_ago(now - self.moved)}"
        told = [("joint states", joints)]
        if math.isfinite(self.told):
            told.append(("told of itself", _ago(now - self.told)))
        if rate := values.get("rate_hz"):
            jitter = values.get("jitter_ms") or "?"
            told.append(("its updates", f"{rate} Hz, at most {jitter} ms beside the mean"))
        if "enabled" in values:
            told.append(("enabled", {"True": "yes", "False": "no"}.get(values["enabled"], values["enabled"])))
        if self.goal is not None:
            told.append(("goal", ", ".join(f"{number:.3f}" for number in self.goal)))
        if other := values.get("goals of another type"):
            told.append(("unheard", other))
        counted = [
            f"{key.removeprefix('count: ')}: {value}" for key, value in values.items() if _is_trouble(key, value)
        ]
        told.append(("counted", "; ".join(counted) or "nothing"))
        if self.said and now - self.said_at < _SAID:
            told.append(("answer", self.said))
        return told


def stop_words(stopped: float, robots: Iterable[Status], now: float) -> str:
    """Say what has become of a stop of all.

    Args:
        stopped: When it was sent.
        robots: All that are known.
        now: The time.
    """
    there = [robot for robot in robots if robot.present]
    moving = [robot.name for robot in there if robot.state != State.ESTOP.value]
    sent = f"stop all sent {_ago(now - stopped)}"
    if moving:
        return f"{sent}: NOT (or no longer) stopped: {', '.join(sorted(moving))}"
    return f"{sent}: all {len(there)} robots say that they are stopped"


def _is_trouble(key: str, value: str) -> bool:
    name = key.removeprefix("count: ")
    return name != key and value not in ("0", "") and not (name.startswith(_USUAL) or name in ("states", "goals"))


def _ago(seconds: float) -> str:
    if seconds < 10:
        return f"{max(seconds, 0.0):.1f} s ago"
    return f"{seconds:.0f} s ago" if seconds < 120 else f"{seconds / 60:.0f} min ago"
