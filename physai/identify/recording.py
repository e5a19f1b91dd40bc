"""What a robot was told and what its sensors said, read from a table or a recording of ROS topics."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physai.config import nearest
from physai.errors import UserError

_BACKWARDS, _FORWARDS = 1e-4, 600.0  # s; a clock that goes back or on by more at once has been set
_MOST_PARTS = 4  # of a control period; finer steps cost much and tell little
_SAME = 0.02  # within which a period is meant to be an equal part of a control period
_WHAT = ("position", "velocity", "command")


@dataclass(frozen=True)
class Recording:
    """What happened in each of T steps; NaN where nothing arrived.

    Attributes:
        period: From step to step, s: a control period, or an equal part of one.
        position: What the encoders said at the beginning of each step, rad, [T, n].
        velocity: rad/s, [T, n].
        command: In force from each step to the next, rad/s or rad, [T, n].
        effort: What torque sensors said, N·m, [T, n]; all NaN of a robot without them.
    """

    period: float
    position: np.ndarray
    velocity: np.ndarray
    command: np.ndarray
    effort: np.ndarray

    def __len__(self) -> int:
        return len(self.command)


def read(path: Path, joints: Sequence[str], control_dt: float, command_topic: str) -> Recording:
    """Read a CSV file with a header, or the folder of a recording (rosbag2).

    A table has the columns ``time``, s, and for each joint ``position[<joint>]``, ``velocity[<joint>]`` and
    ``command[<joint>]``; a row's command is in force from its time on. It may have ``effort[<joint>]``, too.

    Args:
        path: File or folder.
        joints: The robot's, in their order.
        control_dt: Control period, s.
        command_topic: Where the recording has the commands.

    Raises:
        UserError: If it cannot be read, or does not hold what is needed; one line says what.
    """
    if path.is_dir():
        states, commands = _of_topics(path, joints, command_topic)
    else:
        states, commands = _of_table(path, joints)
    for what, series in (("joint states", states), ("commands", commands)):
        _check(path, what, series)
    return _on_grid(path, states, commands, control_dt)


def _of_table(path: Path, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return states [K, 1 + 3n] and commands [K, 1 + n], times first."""
    try:
        table = pd.read_csv(path, skipinitialspace=True)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise UserError(f"{path}: {reason}") from error
    columns = {what: [f"{what}[{joint}]" for joint in joints] for what in _WHAT}
    efforts = [f"effort[{joint}]" for joint in joints]
    if any(name in table for name in efforts):
        columns["effort"] = efforts
    for name in ("time", *(column for of in columns.values() for column in of)):
        if name not in table:
            raise UserError(f"{path}: it has no column '{name}'{nearest(name, map(str, table.columns))}")
        if len(table) and not pd.api.types.is_numeric_dtype(table[name]):
            raise UserError(f"{path}: column '{name}' holds something that is no number")
    states = table[["time", *columns["position"], *columns["velocity"]]].to_numpy(np.float64)
    felt = table[efforts].to_numpy(np.float64) if "effort" in columns else np.full((len(table), len(joints)), np.nan)
    return np.hstack([states, felt]), table[["time", *columns["command"]]].to_numpy(np.float64)


def _of_topics(folder: Path, joints: Sequence[str], command_topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Return states [K, 1 + 3n] and commands [M, 1 + n] as they came, times first."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise UserError("recordings need rosbags: pip install rosbags") from error
    states: list[list[float]] = []
    commands: list[list[float]] = []
    state_topic = f"{command_topic.rsplit('/', 2)[0]}/joint_states"  # of the robot in the same namespace
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            wanted = [each for each in reader.connections if each.topic in (state_topic, command_topic)]
            for topic in (state_topic, command_topic):
                if topic not in (each.topic for each in wanted):
                    raise UserError(f"{folder}: it holds no {topic}")
            for connection, stamp, data in reader.messages(wanted):
                message: Any = reader.deserialize(data, connection.msgtype)
                if connection.topic == command_topic:
                    commands.append([stamp * 1e-9, *message.data])
                elif (row := _state(folder, message, joints)) is not None:
                    states.append([stamp * 1e-9, *row])
    except (AnyReaderError, OSError) as error:
        raise UserError(f"{folder}: {error}") from error
    lengths = {len(row) - 1 for row in commands}
    if lengths != {len(joints)}:
        raise UserError(f"{folder}: commands are for {sorted(lengths)} joints, and the robot has {len(joints)}")
    return np.array(states).reshape(-1, 1 + 3 * len(joints)), np.array(commands)


def _state(folder: Path, message: Any, joints: Sequence[str]) -> list[float] | None:
    """Positions, velocities, efforts of a JointState in the robot's order; None where another part of it publishes."""
    names = list(message.name)
    if not set(names) & set(joints):
        return None
    for joint in joints:
        if joint not in names:
            raise UserError(f"{folder}: /joint_states has no joint '{joint}'{nearest(joint, names)}")
    places = [names.index(joint) for joint in joints]
    values = [list(getattr(message, key)) for key in ("position", "velocity")]
    if any(len(each) != len(names) for each in values):
        raise UserError(f"{folder}: /joint_states tells no positions or no velocities")
    effort = list(message.effort) if len(message.effort) == len(names) else [math.nan] * len(names)
    return [each[place] for each in (*values, effort) for place in places]


def _check(path: Path, what: str, series: np.ndarray) -> None:
    if len(series) < 2:
        raise UserError(f"{path}: it holds {len(series)} {what}")
    if not np.isfinite(series[:, 0]).all():
        raise UserError(f"{path}: a time of its {what} is not finite")
    steps = np.diff(series[:, 0])
    jumps = np.flatnonzero((steps < -_BACKWARDS) | (steps > _FORWARDS))
    if len(jumps):
        by, at = steps[jumps[0]], jumps[0] + 1
        way = "back" if by < 0 else "on"
        raise UserError(f"{path}: the clock of its {what} goes {way} by {abs(by):.3g} s at number {at}")


def _on_grid(path: Path, states: np.ndarray, commands: np.ndarray, control_dt: float) -> Recording:
    """Put what came at its own times on the steps of the robot's controller.

    States are taken as those of the nearest step: a driver reads them at its own steady pace, and what jitters is when
    they were sent. Where they come often, several make one step.
    """
    time = states[:, 0]
    period = float(np.median(np.diff(time)))
    if not period < 1.1 * control_dt:
        raise UserError(
            f"{path}: joint states come every {period * 1e3:.3g} ms, and the control period of the env is only "
            f"{control_dt * 1e3:.3g} ms: env.control_dt={period:.2g} makes them one"
        )
    # Step by step, for a median is not so exact that it could be counted on for minutes.
    step = np.concatenate([[0], np.cumsum(np.rint(np.diff(time) / period).astype(int))])
    period = float((time[-1] - time[0]) / max(step[-1], 1))
    joined = max(math.ceil(round(control_dt / period) / _MOST_PARTS), 1)
    tables = commands.shape[0] == states.shape[0] and np.array_equal(commands[:, 0], time)
    kept = step % joined == 0
    states, time, step, period = states[kept], time[kept], step[kept] // joined, period * joined
    gridded = np.full((step[-1] + 1, states.shape[1] - 1), np.nan)
    gridded[step] = states[:, 1:]
    # What was in force until the next state: the last command before that. Without a next state, by the clock.
    until = time[0] + period * np.arange(1, len(gridded) + 1)
    later = step > 0  # the first states may share a step
    until[step[later] - 1] = time[later]
    last = np.searchsorted(commands[:, 0], until - (0.5 * period if tables else 0.0), side="left") - 1
    given = np.where((last >= 0)[:, None], commands[np.maximum(last, 0), 1:], np.nan)
    if tables:  # with a row its command is lost
        given[np.setdiff1d(np.arange(len(given)), step)] = np.nan
    parts = control_dt / period
    if abs(parts / max(round(parts), 1) - 1.0) < _SAME:
        period = control_dt / max(round(parts), 1)
    position, velocity, effort = np.split(gridded, 3, axis=1)
    return Recording(period, position, velocity, given, effort)
