"""What a policy file says about itself: which robot, in which order and units, within which limits."""

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.errors import UserError

FORMAT = "physai.policy"
FORMAT_VERSION = 1
INPUTS = ("joint_position", "joint_velocity", "goal")
OUTPUT = "joint_velocity_command"
MEMORY, NEW_MEMORY = "memory", "new_memory"  # of a policy that remembers: a further input, a further output
DISTANCE = "distance"  # of the end effector to the goal, which the controller asks for
UNITS = {
    "joint_position": "rad",
    "joint_velocity": "rad/s",
    "goal": "m",
    DISTANCE: "m",
    OUTPUT: "rad/s",
    "effort": "N m",
}
MAX_PAIRS = 1000
MAX_MEMORY = 65536  # numbers
# What a controller does not need, but people do.
_TOLD = {
    "robot.urdf_sha256": str,
    "robot.end_effector": str,
    "checkpoint": dict,
    "evaluation": dict,
    "config": dict,
    "versions": dict,
    "created": str,
}


class PolicyError(UserError):
    """A policy file that cannot be trusted or does not fit: one line that says why."""

    def __init__(self, message: str) -> None:
        # It may quote the file: no line breaks, no control characters for the terminal that shows it.
        super().__init__("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in message))


@dataclass(frozen=True, eq=False)
class Metadata:
    """The checked part of a policy's metadata; ``raw`` has all of it.

    Attributes:
        raw: The JSON object.
        robot: Name of the robot.
        joints: Names of the n joints, in the policy's order; the arrays below follow it.
        position_limit: rad, [n, 2]; infinite for continuous joints.
        velocity_limit: rad/s, [n].
        effort_limit: N·m, [n].
        command_limit: Largest velocity that the policy commands, rad/s, [n].
        control_rate: Hz.
        goal_frame: Link in whose frame goals are given.
        goal_radius: Nearest and farthest goal from that frame's origin, m.
        goal_tolerance: Distance that counts as reached, m.
        memory_size: How many numbers the policy remembers from step to step, H; 0 for most. An episode begins with
            zeros.
        golden: Inputs, and the command and distance that the policy gave for them when it was exported; float32,
            [pairs, n], [pairs, 2], [pairs, 1]; also the memory before and after, [pairs, H], if there is one.
        content_sha256: Hash of the code and weights that this describes.
    """

    raw: dict[str, Any]
    robot: str
    joints: tuple[str, ...]
    position_limit: np.ndarray
    velocity_limit: np.ndarray
    effort_limit: np.ndarray
    command_limit: np.ndarray
    control_rate: float
    goal_frame: str
    goal_radius: tuple[float, float]
    goal_tolerance: float
    memory_size: int
    golden: dict[str, np.ndarray]
    content_sha256: str

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the policy takes, in order."""
        return input_keys(self.memory_size)

    @property
    def outputs(self) -> tuple[str, ...]:
        """What it gives, in order."""
        return output_keys(self.memory_size)

    @classmethod
    def parse(cls, text: str) -> "Metadata":
        """Read and check the JSON.

        Raises:
            PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
        """
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
        joints = _get(raw, "robot.joints", list)
        if not joints or not all(isinstance(name, str) for name in joints) or len(set(joints)) != len(joints):
            raise PolicyError("metadata: robot.joints must be distinct names")
        n = len(joints)
        position = _array(raw, "limits.position", (n, 2), infinite=True)
        if not (position[:, 0] < position[:, 1]).all():
            raise PolicyError("metadata: limits.position must be pairs of lower and upper limit")
        inner, outer = _array(raw, "goal.radius", (2,))
        if not 0 <= inner <= outer:
            raise PolicyError("metadata: goal.radius must be an inner and an outer radius")
        memory_size = _memory_size(raw)
        sizes = {"joint_position": n, "joint_velocity": n, "goal": 2, OUTPUT: n, MEMORY: memory_size}
        sizes[NEW_MEMORY] = memory_size
        for side, keys in (("inputs", input_keys(memory_size)), ("outputs", output_keys(memory_size))):
            if _get(raw, side, dict) != {key: ["N", sizes[key]] for key in keys}:
                raise PolicyError(f"metadata: {side} must be {list(keys)}")
        if _get(raw, "units", dict) != UNITS:
            raise PolicyError(f"metadata: units must be {UNITS}")
        for key, kind in _TOLD.items():
            _get(raw, key, kind)
        pairs = len(_get(raw, f"golden.{OUTPUT}", list))
        if not 0 < pairs <= MAX_PAIRS:
            raise PolicyError(f"metadata: there are {pairs:,} golden pairs, not 1 to {MAX_PAIRS:,}")
        sizes[DISTANCE] = 1
        recorded = (*input_keys(memory_size), *output_keys(memory_size), DISTANCE)
        found = cls(
            raw=raw,
            robot=_get(raw, "robot.name", str),
            joints=tuple(joints),
            position_limit=position,
            velocity_limit=_positive(raw, "limits.velocity", (n,)),
            effort_limit=_positive(raw, "limits.effort", (n,)),
            command_limit=_positive(raw, "limits.command", (n,)),
            control_rate=float(_positive(raw, "control_rate", (), 1e4)),
            goal_frame=_get(raw, "goal.frame", str),
            goal_radius=(float(inner), float(outer)),
            goal_tolerance=float(_positive(raw, "goal.tolerance", (), outer)),
            memory_size=memory_size,
            golden={key: _array(raw, f"golden.{key}", (pairs, sizes[key]), kind=np.float32) for key in recorded},
            content_sha256=_get(raw, "content_sha256", str),
        )
        if not (found.command_limit <= found.velocity_limit).all():
            raise PolicyError("metadata: limits.command must not be beyond limits.velocity")
        if _get(raw, "metadata_sha256", str) != metadata_sha256(raw):
            raise PolicyError("the metadata is not what was exported (metadata_sha256 differs)")
        return found


def input_keys(memory_size: int) -> tuple[str, ...]:
    """What a policy takes, in order."""
    return (*INPUTS, MEMORY) if memory_size else INPUTS


def output_keys(memory_size: int) -> tuple[str, ...]:
    """What a policy gives, in order."""
    return (OUTPUT, NEW_MEMORY) if memory_size else (OUTPUT,)


def metadata_sha256(raw: dict[str, Any]) -> str:
    """Hash of the metadata but for the hash itself."""
    rest = {key: value for key, value in raw.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _get(raw: dict[str, Any], key: str, kind: type) -> Any:
    value: Any = raw
    for part in key.split("."):
        if not isinstance(value, dict) or part not in value:
            raise PolicyError(f"metadata: {key} is missing")
        value = value[part]
    if not isinstance(value, kind):
        raise PolicyError(f"metadata: {key} must be a {kind.__name__}")
    return value


def _memory_size(raw: dict[str, Any]) -> int:
    if MEMORY not in _get(raw, "inputs", dict):
        return 0
    match raw["inputs"][MEMORY]:
        case ["N", int(size)] if 0 < size <= MAX_MEMORY and size is not True:
            return size
    raise PolicyError(f"metadata: inputs.{MEMORY} must be ['N', H], H at most {MAX_MEMORY:,}")


def _array(
    raw: dict[str, Any], key: str, shape: tuple[int, ...], infinite: bool = False, kind: type = np.float64
) -> np.ndarray:
    value = _get(raw, key, object)
    try:
        if not _all_numbers(value):
            raise TypeError
        with np.errstate(over="ignore"):
            array: np.ndarray = np.array(value, dtype=np.float64).astype(kind)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise PolicyError(f"metadata: {key} must hold numbers") from None
    if array.shape != shape:
        raise PolicyError(f"metadata: {key} must have the shape {list(shape)}, not {list(array.shape)}")
    if infinite:  # JSON has no infinity: null stands for a limit that does not exist
        array = np.where(np.isnan(array), np.array([-math.inf, math.inf]), array)
    elif not np.isfinite(array).all():
        raise PolicyError(f"metadata: {key} must be finite")
    return array


def _all_numbers(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_all_numbers, value))
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def _positive(raw: dict[str, Any], key: str, shape: tuple[int, ...], most: float = math.inf) -> np.ndarray:
    array = _array(raw, key, shape)
    if not ((array > 0) & (array <= most)).all():
        raise PolicyError(f"metadata: {key} must be positive" + (f", and at most {most:g}" if most < math.inf else ""))
    return array
