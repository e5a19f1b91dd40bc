"""What a policy file says about itself: which robot, which signals in which order, within which limits."""

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.deploy import fields
from physai.deploy.declarations import (
    describe_region,
    describe_signal,
    parse_region,
    parse_signals,
    parse_tolerances,
)
from physai.deploy.fields import PolicyError, get
from physai.signals import Quantity, Region, Signal, Tolerance

__all__ = ["Metadata", "PolicyError", "describe_region", "describe_signal"]

FORMAT = "physai.policy"
FORMAT_VERSION = 2
# Inputs that a controller knows. A file needs the joints' positions and a goal; any other is a question of its task.
JOINT_POSITION, JOINT_VELOCITY, GOAL = "joint_position", "joint_velocity", "goal"
LAST_COMMAND = "last_command"  # of position commands: the one that was sent last
MEMORY, NEW_MEMORY = "memory", "new_memory"  # of a policy that remembers: a further input, a further output
ERROR = "error"  # how far from the goal, in the units of the tolerances; a method of the module
COMMANDS = (Quantity.JOINT_VELOCITY, Quantity.JOINT_POSITION)
MAX_PAIRS = 1000
_KNOWN = {
    JOINT_POSITION: (Quantity.JOINT_POSITION,),
    JOINT_VELOCITY: (Quantity.JOINT_VELOCITY,),
    GOAL: (Quantity.POSITION, Quantity.JOINT_POSITION),
    LAST_COMMAND: (Quantity.JOINT_POSITION,),
    MEMORY: (Quantity.MEMORY,),
}
# What a controller does not need, but people do.
_FOR_PEOPLE = {
    "robot.urdf_sha256": str,
    "robot.end_effector": str,
    "checkpoint": dict,
    "evaluation": dict,
    "config": dict,
    "versions": dict,
    "created": str,
}


@dataclass(frozen=True, eq=False)
class Metadata:
    """The checked part of a policy's metadata; ``raw`` has all of it.

    Attributes:
        raw: The JSON object.
        robot: Name of the robot.
        joints: Names of the n joints, in the policy's order; the arrays below follow it.
        home: Where the robot begins, rad, [n].
        position_limit: rad, [n, 2]; infinite for continuous joints.
        velocity_limit: rad/s, [n].
        effort_limit: N·m, [n].
        command_limit: Largest velocity that the policy commands, rad/s, [n]; also where it commands positions.
        control_rate: Hz.
        inputs: What the policy takes, in order.
        outputs: What it gives, in order: the command, and what it remembers, if it does.
        region: Where goals lie.
        tolerances: How near to a goal is near enough: E errors, each in a unit of its own.
        golden: Inputs, and the outputs and errors that the policy gave for them when it was exported, by name; float32,
            [pairs, size], "error" [pairs, E].
        content_sha256: Hash of the code and weights that this describes.
    """

    raw: dict[str, Any]
    robot: str
    joints: tuple[str, ...]
    home: np.ndarray
    position_limit: np.ndarray
    velocity_limit: np.ndarray
    effort_limit: np.ndarray
    command_limit: np.ndarray
    control_rate: float
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    region: Region
    tolerances: tuple[Tolerance, ...]
    golden: dict[str, np.ndarray]
    content_sha256: str

    @property
    def goal(self) -> Signal:
        """The input that says where to go."""
        return next(signal for signal in self.inputs if signal.name == GOAL)

    @property
    def command(self) -> Signal:
        """The output that the robot is driven by."""
        return self.outputs[0]

    @property
    def memory_size(self) -> int:
        """How many numbers the policy remembers, H; 0 for most. An episode begins with zeros."""
        return self.outputs[1].size if len(self.outputs) > 1 else 0

    @classmethod
    def parse(cls, text: str) -> "Metadata":
        """Read and check the JSON.

        Raises:
            PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
        """
        raw = _load(text)
        joints = fields.texts(get(raw, "robot.joints", list), "robot.joints")
        if not joints or len(set(joints)) != len(joints):
            raise PolicyError("metadata: robot.joints must be distinct names")
        n = len(joints)
        inputs, outputs = parse_signals(raw, "inputs"), parse_signals(raw, "outputs")
        _check_signals(inputs, outputs, joints)
        for key, kind in _FOR_PEOPLE.items():
            get(raw, key, kind)
        limits = {key: get(raw, f"limits.{key}", list) for key in ("position", "velocity", "effort", "command")}
        goal = next(signal for signal in inputs if signal.name == GOAL)
        region = parse_region(raw, "goal.region", goal.size)
        tolerances = parse_tolerances(raw, "goal.tolerances", goal.unit, region)
        found = cls(
            raw=raw,
            robot=get(raw, "robot.name", str),
            joints=joints,
            home=fields.array(get(raw, "robot.home", list), "robot.home", (n,)),
            position_limit=_position_limit(limits["position"], n),
            velocity_limit=fields.positive(limits["velocity"], "limits.velocity", (n,)),
            effort_limit=fields.positive(limits["effort"], "limits.effort", (n,)),
            command_limit=fields.positive(limits["command"], "limits.command", (n,)),
            control_rate=float(fields.positive(get(raw, "control_rate", object), "control_rate", (), 1e4)),
            inputs=inputs,
            outputs=outputs,
            region=region,
            tolerances=tolerances,
            golden=_golden(raw, {s.name: s.size for s in (*inputs, *outputs)} | {ERROR: len(tolerances)}),
            content_sha256=get(raw, "content_sha256", str),
        )
        if not (found.command_limit <= found.velocity_limit).all():
            raise PolicyError("metadata: limits.command must not be beyond limits.velocity")
        if get(raw, "metadata_sha256", str) != metadata_sha256(raw):
            raise PolicyError("the metadata is not what was exported (metadata_sha256 differs)")
        return found


def metadata_sha256(raw: dict[str, Any]) -> str:
    """Hash of the metadata but for the hash itself."""
    rest = {key: value for key, value in raw.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def command_name(quantity: Quantity) -> str:
    """What the output is called that commands a quantity."""
    return f"{quantity.value}_command"


def _load(text: str) -> dict[str, Any]:
    try:
        raw = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"the metadata is damaged ({str(error)[:80]})") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        raise PolicyError("the metadata is not that of a physai policy")
    if raw.get("format_version") is True or raw.get("format_version") != FORMAT_VERSION:
        raise PolicyError(
            f"format version {repr(raw.get('format_version'))[:80]}; this physai reads {FORMAT_VERSION}: "
            "export the policy again with it"
        )
    return raw


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def _check_signals(inputs: tuple[Signal, ...], outputs: tuple[Signal, ...], joints: tuple[str, ...]) -> None:
    """See that signals are called what they are, and are those of these joints."""
    names = [signal.name for signal in (*inputs, *outputs)] + [ERROR]
    if len(set(names)) != len(names):
        raise PolicyError(f"metadata: inputs and outputs must have distinct names, none of them '{ERROR}'")
    for needed in (JOINT_POSITION, GOAL):
        if needed not in names[: len(inputs)]:
            raise PolicyError(f"metadata: inputs must have '{needed}'")
    command = outputs[0]
    if command.quantity not in COMMANDS or command.name != command_name(command.quantity):
        raise PolicyError(f"metadata: outputs must begin with {' or '.join(map(command_name, COMMANDS))}")
    known = _KNOWN | {command.name: (command.quantity,)}
    for signal in (*inputs, command):
        quantities = known.get(signal.name)
        if quantities is None:
            continue  # of a task that a later controller may know
        if signal.quantity not in quantities:
            raise PolicyError(
                f"metadata: '{signal.name}' must be of the quantity {' or '.join(each.value for each in quantities)}"
            )
        of_joints = signal.quantity in COMMANDS and signal.name != GOAL  # a goal may be of some joints
        if of_joints and (signal.shape, signal.labels) != ((len(joints),), joints):
            raise PolicyError(f"metadata: '{signal.name}' must have a number for each of robot.joints, in their order")
        if len(signal.shape) != 1:
            raise PolicyError(f"metadata: '{signal.name}' must have one axis")
    if LAST_COMMAND in names and command.quantity is not Quantity.JOINT_POSITION:
        raise PolicyError(f"metadata: '{LAST_COMMAND}' is an input of position commands only")
    memory = [(NEW_MEMORY, s.quantity, s.shape) for s in inputs if s.name == MEMORY]
    if [(signal.name, signal.quantity, signal.shape) for signal in outputs[1:]] != memory:
        raise PolicyError(
            f"metadata: outputs must be {[command.name, *(name for name, *_ in memory)]}, "
            f"'{NEW_MEMORY}' like '{MEMORY}'"
        )


def _position_limit(value: list[Any], joints: int) -> np.ndarray:
    found = fields.array(value, "limits.position", (joints, 2), null=True)
    found = np.where(np.isnan(found), np.array([-math.inf, math.inf]), found)
    if not (found[:, 0] < found[:, 1]).all():
        raise PolicyError("metadata: limits.position must be pairs of lower and upper limit")
    return found


def _golden(raw: dict[str, Any], sizes: dict[str, int]) -> dict[str, np.ndarray]:
    pairs = len(get(raw, f"golden.{ERROR}", list))
    if not 0 < pairs <= MAX_PAIRS:
        raise PolicyError(f"metadata: there are {pairs:,} golden pairs, not 1 to {MAX_PAIRS:,}")
    golden = get(raw, "golden", dict)
    missing = [name for name in sizes if name not in golden]
    if missing:
        raise PolicyError(f"metadata: golden.{missing[0]} is missing")
    return {
        name: fields.array(golden[name], f"golden.{name}", (pairs, size), dtype=np.float32)
        for name, size in sizes.items()
    }
