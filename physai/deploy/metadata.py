"""What a policy file says about itself: which robot, in which order and units, within which limits."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from physai.collision import CollisionModel, Kinematics
from physai.deploy.kinematics import read_kinematics
from physai.deploy.reading import PolicyError, all_numbers, array, get, items, positive
from physai.signals import Quantity, Region, Signal, Tolerance
from physai.signals.region import REGIONS

FORMAT = "physai.policy"
FORMAT_VERSION = 4
POSITION, VELOCITY, GOAL = "joint_position", "joint_velocity", "goal"  # which every policy takes
LAST_COMMAND = "last_command"  # what was sent before: an input of policies that command positions
MEMORY, NEW_MEMORY = "memory", "new_memory"  # of a policy that remembers: a further input, a further output
ERROR = "error"  # how far the robot is from a goal, which the controller asks for
MAX_PAIRS = 1000
MAX_SIZE = 65536  # numbers of a signal
_MAX_SHAPES = 2000
_COMMANDS = (Quantity.JOINT_VELOCITY, Quantity.JOINT_POSITION)
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
        floats: Whether nothing holds its base; its joints are springs then, and are told where about home to be.
        home: Rest pose, rad, [n].
        position_limit: rad, [n, 2]; infinite for continuous joints.
        velocity_limit: rad/s, [n].
        effort_limit: N·m, [n].
        command_limit: How fast an action of 1 moves each joint, rad/s, [n]; of a base that floats, how far, rad.
        control_rate: Hz.
        inputs: What the policy takes, in order.
        outputs: What it gives, in order; first the command.
        region: Where goals lie.
        tolerances: Errors that count as reached, one for each error that the policy tells.
        kinematics: What each joint moves, and where the links end.
        collision: The robot's capsules, and what it was trained not to touch; None where it has none.
        golden: Inputs, and the outputs and errors that the policy gave for them when it was exported, by name; float32,
            [pairs, ...].
        content_sha256: Hash of the code and weights that this describes.
    """

    raw: dict[str, Any]
    robot: str
    joints: tuple[str, ...]
    floats: bool
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
    kinematics: Kinematics
    collision: CollisionModel | None
    golden: dict[str, np.ndarray]
    content_sha256: str

    @property
    def goal(self) -> Signal:
        """What is asked of the robot."""
        return next(signal for signal in self.inputs if signal.name == GOAL)

    @property
    def command(self) -> Signal:
        """What the robot is told."""
        return self.outputs[0]

    @property
    def measures(self) -> bool:
        """Whether the policy can tell from joint positions how far its robot is from a goal."""
        return ERROR in self.golden

    @property
    def memory_size(self) -> int:
        """How many numbers the policy remembers from step to step, H; an episode begins with zeros. 0 for most."""
        return sum(signal.size for signal in self.outputs[1:])

    @classmethod
    def parse(cls, text: str) -> "Metadata":
        """Read and check the JSON.

        Raises:
            PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
        """
        try:
            raw = json.loads(text, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise PolicyError(f"the metadata is damaged ({str(error)[:80]})") from error
        if not isinstance(raw, dict) or raw.get("format") != FORMAT:
            raise PolicyError("the metadata is not that of a physai policy")
        if raw.get("format_version") is True or raw.get("format_version") != FORMAT_VERSION:
            raise PolicyError(
                f"format version {repr(raw.get('format_version'))[:80]}; this physai reads {FORMAT_VERSION}: "
                "export the policy again with it"
            )
        joints = get(raw, "robot.joints", list)
        if not joints or not all(isinstance(name, str) for name in joints) or len(set(joints)) != len(joints):
            raise PolicyError("metadata: robot.joints must be distinct names")
        n = len(joints)
        position = array(raw, "limits.position", (n, 2), null=[-math.inf, math.inf])
        if not (position[:, 0] < position[:, 1]).all():
            raise PolicyError("metadata: limits.position must be pairs of lower and upper limit")
        inputs = tuple(_signal(raw, key) for key in items(raw, "inputs", 32, "signals"))
        outputs = tuple(_signal(raw, key) for key in items(raw, "outputs", 32, "signals"))
        floats = raw["robot"].get("base") == "floating"
        _check_signals(inputs, outputs, tuple(joints), floats)
        goal = next(signal for signal in inputs if signal.name == GOAL)
        region, tolerances = _asked(raw, goal)
        for key, kind in _FOR_PEOPLE.items():
            get(raw, key, kind)
        pairs = len(get(raw, f"golden.{outputs[0].name}", list))
        if not 0 < pairs <= MAX_PAIRS:
            raise PolicyError(f"metadata: there are {pairs:,} golden pairs, not 1 to {MAX_PAIRS:,}")
        shapes = {signal.name: (pairs, *signal.shape) for signal in (*inputs, *outputs)}
        shapes |= {ERROR: (pairs, len(tolerances))} if ERROR in raw["golden"] or not floats else {}
        found = cls(
            raw=raw,
            robot=get(raw, "robot.name", str),
            joints=tuple(joints),
            floats=floats,
            home=array(raw, "robot.home", (n,)),
            position_limit=position,
            velocity_limit=positive(raw, "limits.velocity", (n,)),
            effort_limit=positive(raw, "limits.effort", (n,)),
            command_limit=positive(raw, "limits.command", (n,)),
            control_rate=float(positive(raw, "control_rate", (), 1e4)),
            inputs=inputs,
            outputs=outputs,
            region=region,
            tolerances=tolerances,
            kinematics=read_kinematics(raw, n),
            collision=_collision(raw, n),
            golden={key: array(raw, f"golden.{key}", shape, kind=np.float32) for key, shape in shapes.items()},
            content_sha256=get(raw, "content_sha256", str),
        )
        if not floats and not (found.command_limit <= found.velocity_limit).all():
            raise PolicyError("metadata: limits.command must not be beyond limits.velocity")
        if get(raw, "metadata_sha256", str) != metadata_sha256(raw):
            raise PolicyError("the metadata is not what was exported (metadata_sha256 differs)")
        return found


def describe_goal(metadata: Metadata) -> str:
    """Return JSON that tells what is asked of a robot, in the words of the policy's metadata."""
    asked = {"region": describe_region(metadata.region), "tolerances": [vars(each) for each in metadata.tolerances]}
    return json.dumps({"inputs": [describe_signal(metadata.goal)], "goal": asked})


def read_goal(text: str) -> tuple[Signal, Region, tuple[Tolerance, ...]]:
    """Return the goal, where goals lie, and what is near enough, of the JSON of :func:`describe_goal`.

    Raises:
        PolicyError: If a part is missing, of the wrong shape, or impossible; it says which.
    """
    try:
        raw = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"the goal's description is damaged ({str(error)[:80]})") from error
    goal = _signal(raw, "inputs.0")
    return goal, *_asked(raw, goal)


def describe_signal(signal: Signal) -> dict[str, Any]:
    """Return a signal as JSON holds it; null stands for a bound that does not exist."""
    bounds = {key: [x if math.isfinite(x) else None for x in getattr(signal, key)] for key in ("low", "high")}
    return {
        **asdict(signal),
        **bounds,
        "quantity": signal.quantity.value,
        "unit": signal.unit,
        "shape": list(signal.shape),
        "labels": list(signal.labels),
    }


def describe_region(region: Region) -> dict[str, Any]:
    """Return a region as JSON holds it."""
    values = vars(region).items()
    return {"kind": region.kind} | {key: list(v) if isinstance(v, tuple) else v for key, v in values}


def metadata_sha256(raw: dict[str, Any]) -> str:
    """Hash of the metadata but for the hash itself."""
    rest = {key: value for key, value in raw.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _signal(raw: dict[str, Any], key: str) -> Signal:
    name, quantity = get(raw, f"{key}.name", str), get(raw, f"{key}.quantity", str)
    if not name.isidentifier() or len(name) > 100:
        raise PolicyError(f"metadata: {key}.name must be an identifier, not {name!r:.80}")
    if quantity not in [known.value for known in Quantity]:
        raise PolicyError(f"metadata: {key}.quantity: this physai does not know {quantity!r:.80}")
    shape = get(raw, f"{key}.shape", list)
    if not shape or len(shape) > 8 or not all(type(length) is int and 0 < length <= MAX_SIZE for length in shape):
        raise PolicyError(f"metadata: {key}.shape must be positive integers")
    size = math.prod(shape)
    if size > MAX_SIZE:
        raise PolicyError(f"metadata: {key} has {size:,} numbers, more than {MAX_SIZE:,}")
    low, high = _bounds(raw, f"{key}.low", size, -math.inf), _bounds(raw, f"{key}.high", size, math.inf)
    labels = get(raw, f"{key}.labels", list)
    if len(labels) not in (0, size) or not all(isinstance(label, str) for label in labels):
        raise PolicyError(f"metadata: {key}.labels must be {size} names, or none")
    if len(set(labels)) != len(labels):  # a goal that is said by name would lose a number
        raise PolicyError(f"metadata: {key}.labels must be distinct")
    frame = get(raw, f"{key}.frame", str)
    signal = Signal(name, Quantity(quantity), tuple(shape), low, high, tuple(labels), frame)
    if get(raw, f"{key}.unit", str) != signal.unit:
        raise PolicyError(f"metadata: {key}.unit must be '{signal.unit}'")
    if not (signal.bounds[0] <= signal.bounds[1]).all():
        raise PolicyError(f"metadata: {key}.low must not be above {key}.high")
    return signal


def _bounds(raw: dict[str, Any], key: str, size: int, infinite: float) -> tuple[float, ...]:
    return tuple(array(raw, key, (size,), null=infinite).tolist()) if get(raw, key, list) else ()


def _check_signals(
    inputs: tuple[Signal, ...], outputs: tuple[Signal, ...], joints: tuple[str, ...], floats: bool
) -> None:
    """See that a robot's policy takes and gives what a robot's policy must."""
    if len(names := {signal.name for signal in (*inputs, *outputs)}) < len((*inputs, *outputs)) or ERROR in names:
        raise PolicyError("metadata: the names of inputs and outputs must be distinct")
    command, *memory = outputs
    if command.quantity not in _COMMANDS or command.name != f"{command.quantity.value}_command":
        raise PolicyError("metadata: the first of outputs must be a command of joint velocities or positions")
    sensed = {POSITION: Quantity.JOINT_POSITION, VELOCITY: Quantity.JOINT_VELOCITY}
    wanted: dict[str, Quantity | None] = {**sensed, GOAL: None}
    if floats and command.quantity is not Quantity.JOINT_POSITION:
        raise PolicyError("metadata: robot.base: one that floats needs a command of joint positions")
    if command.quantity is Quantity.JOINT_POSITION and not floats:
        wanted[LAST_COMMAND] = Quantity.JOINT_POSITION
    by_name = {signal.name: signal for signal in inputs}
    for name, quantity in wanted.items():
        if name not in by_name or quantity not in (None, by_name[name].quantity):
            raise PolicyError(f"metadata: inputs must hold '{name}'" + (f", a {quantity.value}" if quantity else ""))
    for signal in (command, *(by_name[name] for name, quantity in wanted.items() if quantity)):
        if signal.shape != (len(joints),) or signal.labels != joints:
            side = "outputs" if signal is command else "inputs"
            raise PolicyError(f"metadata: {side}: '{signal.name}' must have one number for each of {list(joints)}")
    sizes = [one.size for one in (*memory, *(signal for signal in inputs if signal.name == MEMORY))]
    if memory and not ([one.name for one in memory] == [NEW_MEMORY] and len(sizes) == 2 and sizes[0] == sizes[1]):
        raise PolicyError(f"metadata: a policy that remembers takes '{MEMORY}' and gives as much '{NEW_MEMORY}'")
    if not memory and sizes:
        raise PolicyError(f"metadata: there is '{MEMORY}' among the inputs, and no '{NEW_MEMORY}' among the outputs")


def _asked(raw: dict[str, Any], goal: Signal) -> tuple[Region, tuple[Tolerance, ...]]:
    tolerances = tuple(_tolerance(raw, key) for key in items(raw, "goal.tolerances", 1000, "tolerances"))
    region = _region(raw)
    most = float(np.abs(region.bounds).max())
    if any(each.unit == goal.unit and each.value > most for each in tolerances):
        raise PolicyError(f"metadata: goal.tolerances: one of more than {most:g} {goal.unit} is met everywhere")
    if goal.shape != (size := len(region.bounds[0]),):
        raise PolicyError(f"metadata: goal.region has {size} numbers, the goal has the shape {list(goal.shape)}")
    return region, tolerances


def _region(raw: dict[str, Any]) -> Region:
    told = dict(get(raw, "goal.region", dict))
    kind = told.pop("kind", None)
    if not isinstance(kind, str) or kind not in REGIONS:
        raise PolicyError(f"metadata: goal.region.kind: this physai does not know {kind!r:.80}")
    if len(told) > 16 or not all(all_numbers(value) and value is not None for value in told.values()):
        raise PolicyError("metadata: goal.region must hold numbers")
    try:
        with np.errstate(over="ignore"):
            fields: dict[str, Any] = {
                key: tuple(map(float, v)) if isinstance(v, list) else float(v) for key, v in told.items()
            }
        return REGIONS[kind](**fields)
    except (TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"metadata: goal.region: {' '.join(str(error).split())[:120]}") from error


def _collision(raw: dict[str, Any], joints: int) -> CollisionModel | None:
    told = get(raw, "collision", object)
    if told is None:
        return None
    try:
        most = max((len(value) for value in told.values() if isinstance(value, list)), default=0)
        if most > _MAX_SHAPES:
            raise ValueError(f"a list of more than {_MAX_SHAPES:,}")
        model = CollisionModel.from_description(told)
    except (TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise PolicyError(f"metadata: collision: {' '.join(str(error).split())[:160]}") from error
    if len(model.motions) != joints:
        raise PolicyError(f"metadata: collision.motions are of {len(model.motions)} joints, not {joints}")
    return model


def _tolerance(raw: dict[str, Any], key: str) -> Tolerance:
    name, unit = get(raw, f"{key}.name", str), get(raw, f"{key}.unit", str)
    return Tolerance(name, unit, float(positive(raw, f"{key}.value", ())))


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")
