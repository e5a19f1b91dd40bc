"""Moves a robot so that its parameters show, and records it for `python -m physai.identify`.

It is the inference node, with planned motions in the place of a policy: the same controller, limits, collision guard,
emergency stop and watchdog, under the same name. The robot goes home, where the motions begin and end, and does not
wait for ~/enable. Faster motions (max_velocity, max_acceleration) tell more. Ctrl-C stops it, and ends the recording.
"""

import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader, ReaderError

from physai.deploy import Driver, Goal, Metadata, State
from physai.deploy.parameters import parameter
from physai.errors import UserError
from physai.identify.motions import Bounds, Excitation, plan
from physai.ros.driving.planned import PlannedMotions
from physai.ros.driving.processes import NodeProcess
from physai.ros.inference_node import InferenceConfig, InferenceNode
from physai.ros.node.run import run
from physai.ros.record import TOPICS
from physai.ros.topics import joint_states
from physai.ros.topics.commands import controller_topic
from physai.signals import Quantity

_RECORDER = "recorder"
_START, _LOOK = 30.0, 0.1  # s until it records, and how often it is looked after
_PATIENCE = 15.0  # s without motion
_INTERRUPTED = 130  # exit code, as of a shell


@dataclass(frozen=True)
class ExciteConfig(InferenceConfig):
    """Parameters: those of the inference node, and these."""

    autostart: bool = parameter(True, "drive without waiting for ~/enable", fixed=True)
    # By its own clock a node's commands come now before and now after a robot looks for them: jitter that no model has.
    trigger: str = parameter("joint_state", "what a command answers to", choices=("timer", "joint_state"), fixed=True)
    seconds: float = parameter(30.0, "how long the robot moves and rests in turns", "s", 1.0, 3600.0, fixed=True)
    output: str = parameter("", "folder of the recording; empty: outputs/excitation_<time>", fixed=True)
    seed: int = parameter(0, "draws the motions", "", 0, 2**31 - 1, fixed=True)


class ExciteNode(InferenceNode):
    """Drives a robot through motions, and ends when they are over, or the robot is stopped.

    Raises:
        UserError: If a parameter or the policy file is wrong, or nothing can be recorded.
    """

    config: ExciteConfig
    _excitation: Excitation
    _recorder: NodeProcess | None = None
    _told = -1  # the last motion that was announced; 0 is the way home
    _done = False

    def __init__(self) -> None:
        self._moved = time.monotonic()  # last
        super().__init__(ExciteConfig)
        if self.stopped:  # by an emergency stop of before
            return
        self._folder = Path(self.config.output or time.strftime("outputs/excitation_%Y-%m-%d_%H-%M-%S"))
        self._logs = tempfile.TemporaryDirectory(prefix="physai-excite-")
        self._recorder = self._start_recorder()
        self._moved = time.monotonic()
        self.every(_LOOK, self._look_after_recorder)

    def load(self) -> Driver:
        """Return motions of the robot that a policy file describes."""
        policy, config = super().load(), self.config
        metadata = policy.metadata
        if metadata.command.quantity is not Quantity.JOINT_VELOCITY:
            raise UserError(
                f"policy_path: its robot takes {metadata.command.quantity.value}; motions are joint_velocity"
            )
        velocity = np.minimum(metadata.command_limit, config.max_velocity)
        bounds = Bounds(metadata.position_limit, config.limit_margin, velocity, config.max_acceleration, metadata.home)
        period = 1.0 / metadata.control_rate
        motions = plan(bounds, metadata.joints, period, config.seconds, config.seed)
        self._excitation = Excitation(bounds, motions, period)
        return PlannedMotions(metadata, policy.sha256, self._excitation)

    def first_goal(self, policy: Driver) -> Goal | None:
        """Home, which is reached when all motions are over."""
        return super().first_goal(policy) or Goal(policy.metadata.home.tolist())

    # The recorder

    def _start_recorder(self) -> NodeProcess:
        """Start it in a process of its own: a disk that is slow must not keep the arm waiting."""
        if self._folder.exists():
            raise UserError(f"output: {self._folder} exists already")
        topics = dict.fromkeys(map(self.resolve_topic_name, (*TOPICS, self._commands.topic)))
        recorder = NodeProcess(
            "physai.ros.record",
            Path(self._logs.name) / "log",
            output=self._folder,
            topics=f"[{', '.join(topics)}]",
        )
        end = time.monotonic() + _START
        while not list(self._folder.glob("*.mcap")):
            if recorder.ended or time.monotonic() > end:
                recorder.end()
                raise UserError(f"output: {recorder.last_words().removeprefix('error: ')}")
            time.sleep(0.01)
        return recorder

    def _look_after_recorder(self) -> None:
        if self._recorder is not None and self._recorder.ended:
            self._fail(f"the recorder has ended: {self._recorder.last_words()}")

    def _interlocks(self, now: float) -> list[str]:
        found = super()._interlocks(now)
        return found if self._told >= 0 else list(dict.fromkeys([*found, *self._missing()]))

    def _missing(self) -> Iterator[str]:
        """What must be there before the first motion: the recorder listens, too, and is no controller."""
        for topic in (self._commands.topic, self.resolve_topic_name(joint_states.TOPIC)):
            if _RECORDER not in self._listeners(topic):
                yield f"nobody records {topic} yet"
        if not self._listeners(self._commands.topic) - {_RECORDER}:
            yield f"no controller listens to {self._commands.topic}"

    def _listeners(self, topic: str) -> set[str]:
        return {info.node_name for info in self.get_subscriptions_info_by_topic(topic)}

    # The motions

    def _tick(self) -> None:
        super()._tick()  # what it sends goes before all else
        command, now = self._command, time.monotonic()
        why = "; ".join(command.reasons)
        if command.state is State.REACHED:
            self._done = self.stopped = True
        elif command.state in (State.FAULT, State.ESTOP):
            remembered = f" ({self._waits_for()})" if self._stop_file.stopped else ""
            self._fail(f"{command.state.value}: {why}{remembered}")
        elif command.state is State.ACTIVE:
            self._moved = now
            self._tell()
        elif command.state is State.WAITING and (known := self._controller.snapshot())["goal"] is None:
            self._fail(f"the robot will not be driven on: {'; '.join(filter(None, (why, known['last_hold'])))}")
        elif not self._enabled:
            self._moved = now  # somebody wants it so
        elif now - self._moved > _PATIENCE:
            self._fail(f"the robot has not been driven for {_PATIENCE:g} s: {why}")

    def _tell(self) -> None:
        if (number := self._excitation.number) == self._told:
            return
        self._told, motions = number, self._excitation.motions
        what = f"motion {number} of {len(motions)}: {motions[number - 1].name}" if number else "going home"
        self.get_logger().info(what)

    def _fail(self, reason: str) -> None:
        if not self.stopped:
            self.code, self.stopped = 1, True
            self.get_logger().fatal(reason)

    # The end

    def finish(self) -> None:
        """Leave the robot standing, then complete the recording, and say what to do with it."""
        super().finish()
        if self._recorder is None:
            return
        if not self._done:
            self._excitation.interrupt()
            self.code = self.code or _INTERRUPTED
        self._recorder.end()
        self._logs.cleanup()
        motions, broken_off = self._excitation.number, self._excitation.broken_off
        self.get_logger().info(
            f"{motions} of {len(self._excitation.motions)} motions, {broken_off} broken off; recorded to {self._folder}"
        )
        if motions > 1:
            names = joint_states.TOPIC, controller_topic(Quantity.JOINT_VELOCITY)
            topics = map(self.resolve_topic_name, names)
            words = _identify(self._folder, self._controller.policy.metadata, *topics)
            self.get_logger().info(f"next:\n  python -m physai.identify {words}")


def _identify(folder: Path, metadata: Metadata, state_topic: str, command_topic: str) -> str:
    """What to tell an identification: the recording, its robot, and how often it tells of itself."""
    words = [f"data={folder}"]
    if command_topic != f"/{controller_topic(Quantity.JOINT_VELOCITY)}":
        words.append(f"command_topic={command_topic}")
    env = metadata.raw["config"].get("env", {})
    if "name" in env:
        words.append(f"env={env['name']}")
    period = _period(folder, state_topic)
    if not 0.9 < period * metadata.control_rate < 1.1:
        words.append(f"env.control_dt={period:.2g}")
    return " ".join(words)


def _period(folder: Path, topic: str) -> float:
    """Of the joint states in a recording, s; NaN where there are none."""
    try:
        with Reader(folder) as reader:
            told = [each for each in reader.connections if each.topic == topic]
            stamps: list[Any] = [stamp for _, stamp, _ in reader.messages(told)] if told else []
    except ReaderError:  # of a recorder that was killed
        return math.nan
    return float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else math.nan


def main() -> int:
    """Run the node."""
    return run(ExciteNode, "physai.ros.excite", __doc__ or "", ExciteConfig)


if __name__ == "__main__":
    sys.exit(main())
