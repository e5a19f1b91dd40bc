"""What a policy says about itself: every part of it is there, of the right form, and possible."""

import copy
import json
import math

import numpy as np
import pytest

from physai.deploy import Metadata, PolicyError, read_metadata
from physai.deploy.declarations import parse_region, parse_signals
from physai.deploy.metadata import describe_region, describe_signal, metadata_sha256
from physai.signals import Box, Quantity, Ring, Signal, Tolerance

SIGNALS = ("inputs.0", "inputs.1", "inputs.2", "outputs.0")
SIGNAL_PARTS = ("name", "quantity", "unit", "shape", "low", "high", "labels", "frame")
REQUIRED = [
    "robot.name",
    "robot.joints",
    "robot.home",
    "inputs",
    "outputs",
    *(f"{signal}.{part}" for signal in SIGNALS for part in SIGNAL_PARTS),
    "limits.position",
    "limits.velocity",
    "limits.effort",
    "limits.command",
    "control_rate",
    "goal.region",
    "goal.region.kind",
    "goal.region.inner",
    "goal.region.outer",
    "goal.tolerances",
    "goal.tolerances.0.name",
    "goal.tolerances.0.unit",
    "goal.tolerances.0.value",
    "golden",
    "golden.joint_position",
    "golden.joint_velocity",
    "golden.goal",
    "golden.joint_velocity_command",
    "golden.error",
    "robot.urdf_sha256",
    "robot.end_effector",
    "checkpoint",
    "evaluation",
    "config",
    "versions",
    "created",
    "content_sha256",
]
NUMBERS = [
    *(key for key in REQUIRED if key.startswith(("limits", "control", "golden.", "robot.home"))),
    *("goal.region.inner", "goal.region.outer", "goal.tolerances.0.value", "inputs.1.low", "outputs.0.high"),
]


@pytest.fixture(scope="module")
def good(exported_run) -> dict:
    return read_metadata(exported_run / "policy.pt").raw


def inside(raw: dict, key: str) -> tuple[object, str | int]:
    """What holds the value at a dotted key, and where in it."""
    *folders, last = (int(part) if part.isdigit() else part for part in key.split("."))
    for folder in folders:
        raw = raw[folder]
    return raw, last


def value_of(raw: dict, key: str) -> object:
    holder, last = inside(raw, key)
    return holder[last]


def changed(good: dict, key: str, value: object) -> str:
    """The metadata with another value at a dotted key; with none if the value is ``...``."""
    raw = copy.deepcopy(good)
    holder, last = inside(raw, key)
    if value is ...:
        del holder[last]
    else:
        holder[last] = value
    return json.dumps(raw | {"metadata_sha256": metadata_sha256(raw)})


def refusal(text: str) -> str:
    with pytest.raises(PolicyError) as error:
        Metadata.parse(text)
    message = str(error.value)
    assert message.isprintable()
    assert len(message) < 500
    return message


def test_all_that_a_controller_needs_is_there(good):
    metadata = Metadata.parse(json.dumps(good))
    assert (metadata.robot, metadata.joints) == ("planar_arm", ("joint1", "joint2"))
    assert metadata.position_limit.tolist() == [[-math.inf, math.inf], [-2.6, 2.6]]
    assert metadata.velocity_limit.shape == metadata.effort_limit.shape == metadata.command_limit.shape == (2,)
    assert (metadata.control_rate, metadata.goal.frame, metadata.goal.unit) == (50.0, "base", "m")
    assert [signal.name for signal in metadata.inputs] == ["joint_position", "joint_velocity", "goal"]
    assert metadata.command is metadata.outputs[0]
    assert (metadata.command.name, metadata.command.unit) == ("joint_velocity_command", "rad/s")
    assert metadata.inputs[0].labels == metadata.command.labels == metadata.joints
    assert metadata.inputs[0].bounds[0].tolist() == [-math.inf, -2.6]
    assert metadata.region == Ring(0.3, 0.53)
    assert metadata.tolerances == (Tolerance("distance", "m", 0.05),)
    assert metadata.home.shape == (2,)
    assert metadata.golden.pop("error").shape == (32, 1)
    assert {key: value.shape for key, value in metadata.golden.items()} == dict.fromkeys(metadata.golden, (32, 2))
    assert {value.dtype for value in metadata.golden.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("key", REQUIRED)
def test_a_missing_part_is_named(good, key):
    message = refusal(changed(good, key, ...))
    assert key.split(".")[0] in message
    if key.startswith(("robot", "limits", "goal", "control", "inputs.", "outputs.")) or "." not in key:
        assert key in message


@pytest.mark.parametrize("group", ["robot", "limits", "goal"])
def test_a_missing_group_is_named(good, group):
    assert f"metadata: {group}." in refusal(changed(good, group, ...))


OTHER_TYPES = [None, {}, [], [[]], 7, True, "x", [{}], {"a": 1}]
TEXTS = ("robot.name", "robot.urdf_sha256", "robot.end_effector", "created", "content_sha256")
TEXTS += ("goal.tolerances.0.name", "goal.tolerances.0.unit", "inputs.2.frame")
UNUSED = tuple(f"{signal}.frame" for signal in SIGNALS)
GROUPS, SINGLE_NUMBERS = ("checkpoint", "evaluation", "config", "versions"), ("control_rate",)
EMPTY_BOUNDS = [(f"{signal}.{end}", []) for signal in SIGNALS for end in ("low", "high")]
RIGHT = [
    *((key, "x") for key in (*TEXTS, *UNUSED)),
    *((key, value) for key in GROUPS for value in ({}, {"a": 1})),
    *((key, 7) for key in SINGLE_NUMBERS),
    *EMPTY_BOUNDS,
    *(("goal.region.outer", 7), ("inputs.2.labels", [])),
]


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key in REQUIRED for value in OTHER_TYPES if (key, value) not in RIGHT], ids=repr
)
def test_a_part_of_another_type_is_named(good, key, value):
    message = refusal(changed(good, key, value))
    name = value_of(good, f"{key.rpartition('.')[0]}.name") if key.startswith(("inputs.", "outputs.")) else key
    assert key.split(".")[0] in message or f"'{name}'" in message or "golden.x is missing" in message


@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_of_another_shape_are_named(good, key):
    value = value_of(good, key)
    for other in ([value], [value, value], value[:-1] if isinstance(value, list) else [1.0]):
        assert key in refusal(changed(good, key, other)) or key.startswith("golden")


def put(value: object, number: object) -> object:
    """The same nested lists with another first number."""
    return [put(value[0], number), *value[1:]] if isinstance(value, list) else number


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 10**400], ids=["NaN", "inf", "-inf", "10**400"])
@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_that_are_none_are_refused(good, key, number):
    value = value_of(good, key)
    refusal(changed(good, key, put(value, number)))


@pytest.mark.parametrize("key", NUMBERS)
def test_text_is_no_number(good, key):
    value = value_of(good, key)
    refusal(changed(good, key, put(value, "2.5")))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("key", ["joint_position", "joint_velocity", "goal", "joint_velocity_command"])
def test_golden_numbers_that_are_too_large_for_float32_are_refused(good, key):
    refusal(changed(good, f"golden.{key}", put(good["golden"][key], 1e300)))


@pytest.mark.parametrize(
    "key", ["limits.velocity", "limits.effort", "limits.command", "control_rate", "goal.tolerances.0.value"]
)
@pytest.mark.parametrize("number", [0, -1.5])
def test_a_limit_that_is_not_positive_is_refused(good, key, number):
    value = value_of(good, key)
    assert f"{key} must be positive" in refusal(changed(good, key, put(value, number)))


def test_limits_of_position_are_pairs_and_null_is_no_limit(good):
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, -1], [-1, 1]]))
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, 1], [-1, 1]]))
    free = Metadata.parse(changed(good, "limits.position", [[None, None], [-1, None]])).position_limit
    assert free.tolist() == [[-math.inf, math.inf], [-1, math.inf]]


@pytest.mark.parametrize(
    ("region", "reason"),
    [
        ({"kind": "ring", "inner": 0.5, "outer": 0.3}, "goal.region: a ring needs"),
        ({"kind": "ring", "inner": -0.1, "outer": 0.3}, "goal.region: a ring needs"),
        ({"kind": "ring", "inner": 0.1}, "goal.region.outer is missing"),
        ({"kind": "ring", "inner": 0.1, "outer": [0.3]}, "goal.region.outer must have the shape [], not [1]"),
        ({"kind": "box", "low": [0, 0], "high": [1, -1]}, "goal.region: a box needs"),
        ({"kind": "box", "low": [0], "high": [1]}, "goal.region.low must have the shape [2], not [1]"),
        ({"kind": "box", "low": [0, 0, 0], "high": [1, 1, 1]}, "goal.region.low must have the shape [2], not [3]"),
        ({"kind": "box", "low": [0, None], "high": [1, 1]}, "goal.region.low must hold numbers"),
        ({"kind": "ball", "radius": 1}, "goal.region.kind must be one of ring, box"),
    ],
)
def test_a_region_of_goals_that_cannot_be_is_refused(good, region, reason):
    assert f"metadata: {reason}" in refusal(changed(good, "goal.region", region))


@pytest.mark.parametrize("region", [Ring(0.2, 0.4), Box((-0.5, 0.0), (0.5, 0.25))])
def test_a_region_is_read_as_it_was_written(good, region):
    written = json.loads(json.dumps(describe_region(region)))
    assert Metadata.parse(changed(good, "goal.region", written)).region == region


def test_a_ring_is_of_goals_of_two_numbers(good):
    assert parse_region({"region": {"kind": "ring", "inner": 0, "outer": 1}}, "region", 2) == Ring(0.0, 1.0)
    with pytest.raises(PolicyError, match="region must be of goals of 3 numbers"):
        parse_region({"region": {"kind": "ring", "inner": 0, "outer": 1}}, "region", 3)


@pytest.mark.parametrize(
    "signal",
    [
        Signal("camera", Quantity.VIEW, (2, 3, 3), (0.0,) * 18, (1.0,) * 18, frame="hand"),
        Signal("force", Quantity.VIEW, (1,)),
        Signal("joint_position", Quantity.JOINT_POSITION, (2,), (-math.inf, -1.5), (math.inf, 1.5), ("a", "b")),
    ],
)
def test_a_signal_is_read_as_it_was_written(signal):
    written = json.loads(json.dumps(describe_signal(signal), allow_nan=False))
    assert parse_signals({"inputs": [written]}, "inputs") == (signal,)


@pytest.mark.parametrize("joints", [[], ["a", "a"], ["a", 2], ["a", None], "ab", [["a"], ["b"]]], ids=repr)
def test_joints_are_distinct_names(good, joints):
    assert "robot.joints" in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize("joints", [["a"], ["a", "b", "c"]])
def test_as_many_joints_as_everything_else_says(good, joints):
    assert "metadata: " in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        *(("inputs.0.shape", shape, "inputs.0") for shape in ([3], [], [0], [-2], [2.0], ["N"], [10**9], [10**6] * 9)),
        ("inputs.0.shape", [1, 2], "'joint_position' must have a number for each of robot.joints"),
        ("inputs.2.shape", [1, 2], "'goal' must have one axis"),
        ("inputs.0.labels", ["joint2", "joint1"], "'joint_position' must have a number for each of robot.joints"),
        ("inputs.2.labels", ["x", "x"], "inputs.2.labels must be 2 distinct names, or none"),
        ("inputs.0.quantity", "joint_velocity", "inputs.0.unit must be 'rad/s'"),
        ("inputs.2.quantity", "force", "inputs.2.quantity is unknown: 'force'"),
        ("inputs.2.unit", "mm", "inputs.2.unit must be 'm'"),
        ("inputs.1.low", [3.0, 3.0], "inputs.1.low must not be above inputs.1.high"),
        ("inputs.1.low", [-3.0], "inputs.1.low must have the shape [2], not [1]"),
        ("inputs.1.name", "joint_position", "inputs and outputs must have distinct names"),
        ("inputs.1.name", "error", "none of them 'error'"),
        ("inputs.1.name", "goal", "inputs and outputs must have distinct names"),
        ("inputs.0.name", "position", "inputs must have 'joint_position'"),
        ("inputs.2.name", "target", "inputs must have 'goal'"),
        ("inputs.1.name", "last_command", "'last_command' must be of the quantity joint_position"),
        ("outputs.0.name", "gripper_command", "outputs must begin with joint_velocity_command or joint_position_comm"),
        ("outputs.0.name", "joint_position_command", "outputs must begin with joint_velocity_command or joint_posit"),
        ("outputs.0.shape", [1], "outputs.0"),
        ("outputs", [], "outputs must not be empty"),
        ("goal.tolerances", [], "goal.tolerances must not be empty"),
    ],
    ids=repr,
)
def test_signals_that_are_not_what_they_are_called_are_refused(good, key, value, reason):
    assert f"metadata: {reason}" in refusal(changed(good, key, value)) or reason in refusal(changed(good, key, value))


def add(good: dict, side: str, **changes: object) -> str:
    one = describe_signal(Signal("another", Quantity.VIEW, (2,))) | changes
    raw = copy.deepcopy(good)
    raw["golden"][one["name"]] = [[0.0, 0.0]] * 32
    return changed(raw, side, [*raw[side], one])


def test_an_input_that_no_controller_knows_is_read_and_another_output_is_refused(good):
    assert Metadata.parse(add(good, "inputs")).inputs[-1] == Signal("another", Quantity.VIEW, (2,))
    assert "outputs must be ['joint_velocity_command']" in refusal(add(good, "outputs"))


def test_the_last_command_is_an_input_of_position_commands_only(good):
    changes = describe_signal(Signal("last_command", Quantity.JOINT_POSITION, (2,), labels=("joint1", "joint2")))
    assert "'last_command' is an input of position commands only" in refusal(add(good, "inputs", **changes))


def test_there_are_as_many_tolerances_as_errors(good):
    two = [*good["goal"]["tolerances"], {"name": "angle", "unit": "rad", "value": 0.1}]
    assert "golden.error must have the shape [32, 2], not [32, 1]" in refusal(changed(good, "goal.tolerances", two))


def test_there_are_golden_pairs_and_all_are_complete(good):
    none = {key: [] for key in good["golden"]}
    assert "there are 0 golden pairs, not 1 to 1,000" in refusal(changed(good, "golden", none))
    for key, rows in good["golden"].items():
        assert "golden." in refusal(changed(good, f"golden.{key}", rows[:-1]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[*row, 0.0] for row in rows]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[], *rows[1:]]))


@pytest.mark.parametrize("version", [0, 1, 3, "2", None, [1], {}, -1, 1e300], ids=repr)
def test_another_format_version_is_named_and_how_to_mend_it(good, version):
    message = refusal(changed(good, "format_version", version))
    assert f"format version {version!r}; this physai reads 2: export the policy again" in message
    assert "format version None" in refusal(changed(good, "format_version", ...))


def test_a_long_format_version_makes_no_long_message(good):
    refusal(changed(good, "format_version", "1" * 10_000))


@pytest.mark.parametrize("kind", ["other", None, 1, ["physai.policy"]])
def test_metadata_of_something_else_are_refused(good, kind):
    assert "not that of a physai policy" in refusal(changed(good, "format", kind))


@pytest.mark.parametrize("text", ["null", "[]", "7", '"physai.policy"', "{}", "[" * 500 + "]" * 500])
def test_json_that_is_no_object_is_refused(text):
    assert "not that of a physai policy" in refusal(text)


@pytest.mark.parametrize(
    "text",
    [
        *("", " ", "{", "metadata", "{'format': 1}", '{"a": 1}}', "\ufeff{}", '{"a": "\n"}', "\0", "1" * 10_000),
        *("[" * 1_000_000, '{"a":' * 1_000_000, '{"format": ' + "[" * 100_000 + "]" * 100_000 + "}"),
    ],
    ids=lambda text: repr(text[:12]),
)
def test_text_that_is_no_json_is_called_damaged(text):
    assert "the metadata is damaged" in refusal(text)


@pytest.mark.parametrize("depth", [20, 100, 400, 900])
@pytest.mark.parametrize(
    "key", ["control_rate", "limits.position", "golden.goal", "robot.joints", "robot.name", "inputs", "inputs.0.low"]
)
def test_deep_nesting_is_refused(good, key, depth):
    nested: list = []
    for _ in range(depth):
        nested = [nested]
    assert key in refusal(changed(good, key, nested))


def test_half_a_surrogate_in_a_name_makes_no_unprintable_message(good):
    text = changed(good, "robot.name", "\ud800")
    assert Metadata.parse(text).robot == "\ud800"
    refusal(changed(good, "inputs.2.quantity", "\ud800"))
