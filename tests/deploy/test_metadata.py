"""What a policy says about itself: every part of it is there, of the right form, and possible."""

import copy
import json
import math

import numpy as np
import pytest

from physai.deploy import Metadata, PolicyError, read_metadata
from physai.deploy.metadata import describe_region, describe_signal, metadata_sha256
from physai.signals import Quantity, Ring, Signal, Tolerance

SIGNAL = ("name", "quantity", "shape", "low", "high", "labels", "frame", "unit")
REQUIRED = [
    "robot.name",
    "robot.joints",
    "robot.home",
    "inputs",
    *(f"inputs.2.{part}" for part in SIGNAL),
    "outputs",
    *(f"outputs.0.{part}" for part in SIGNAL),
    "limits.position",
    "limits.velocity",
    "limits.effort",
    "limits.command",
    "control_rate",
    "goal.region",
    "goal.region.kind",
    "goal.region.inner",
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
    *(key for key in REQUIRED if key.startswith(("limits", "control", "golden."))),
    *("robot.home", "goal.region.inner", "goal.tolerances.0.value", "inputs.2.low", "outputs.0.high"),
]


@pytest.fixture(scope="module")
def good(exported_run) -> dict:
    return read_metadata(exported_run / "policy.pt").raw


def changed(good: dict, key: str, value: object) -> str:
    """The metadata with another value at a dotted key; with none if the value is ``...``."""
    raw = copy.deepcopy(good)
    *folders, last = (int(part) if part.isdigit() else part for part in key.split("."))
    inside = raw
    for folder in folders:
        inside = inside[folder]
    if value is ...:
        del inside[last]
    else:
        inside[last] = value
    return json.dumps(raw | {"metadata_sha256": metadata_sha256(raw)})


def found(good: dict, key: str) -> object:
    """What is at a dotted key."""
    inside = good
    for part in key.split("."):
        inside = inside[int(part) if part.isdigit() else part]
    return inside


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
    assert (metadata.control_rate, metadata.home.tolist()) == (50.0, [0.0, 0.0])
    assert [signal.name for signal in metadata.inputs] == ["joint_position", "joint_velocity", "goal"]
    assert (metadata.goal.frame, metadata.goal.labels, metadata.goal.unit) == ("base", ("x", "y"), "m")
    assert (metadata.command.name, metadata.command.labels) == ("joint_velocity_command", metadata.joints)
    assert metadata.region == Ring(0.3, 0.53)
    assert metadata.tolerances == (Tolerance("distance", "m", 0.05),)
    assert metadata.golden.pop("error").shape == (32, 1)
    assert {key: value.shape for key, value in metadata.golden.items()} == dict.fromkeys(metadata.golden, (32, 2))
    assert {value.dtype for value in metadata.golden.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("key", REQUIRED)
def test_a_missing_part_is_named(good, key):
    message = refusal(changed(good, key, ...))
    assert key.split(".")[0] in message
    if key.startswith(("robot", "limits", "goal.t", "control", "inputs.")) or "." not in key:
        assert key in message


@pytest.mark.parametrize("group", ["robot", "limits", "goal"])
def test_a_missing_group_is_named(good, group):
    assert f"metadata: {group}." in refusal(changed(good, group, ...))


OTHER_TYPES = [None, {}, [], [[]], 7, True, "x", [{}], {"a": 1}]
TEXTS = (
    *("robot.name", "robot.urdf_sha256", "robot.end_effector", "created", "content_sha256"),
    *("goal.tolerances.0.name", "goal.tolerances.0.unit", "inputs.2.frame", "outputs.0.frame", "inputs.2.name"),
)
GROUPS, SINGLE_NUMBERS = ("checkpoint", "evaluation", "config", "versions"), ("control_rate",)
EMPTY = ("low", "high", "labels")  # of a signal without bounds, or whose numbers have no names
RIGHT = [
    *((key, "x") for key in TEXTS),
    *((key, value) for key in GROUPS for value in ({}, {"a": 1})),
    *((key, 7) for key in SINGLE_NUMBERS),
    *((f"inputs.2.{part}", []) for part in EMPTY),
    *((f"outputs.0.{part}", []) for part in EMPTY[:2]),
]


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key in REQUIRED for value in OTHER_TYPES if (key, value) not in RIGHT], ids=repr
)
def test_a_part_of_another_type_is_named(good, key, value):
    assert key.split(".")[0] in refusal(changed(good, key, value))


@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_of_another_shape_are_named(good, key):
    value = found(good, key)
    for other in ([value], [value, value], value[:-1] if isinstance(value, list) else [1.0]):
        message = refusal(changed(good, key, other))
        assert key.rpartition(".")[0] in message or key in message or key.startswith("golden")


def put(value: object, number: object) -> object:
    """The same nested lists with another first number."""
    return [put(value[0], number), *value[1:]] if isinstance(value, list) else number


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 10**400], ids=["NaN", "inf", "-inf", "10**400"])
@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_that_are_none_are_refused(good, key, number):
    value = found(good, key)
    refusal(changed(good, key, put(value, number)))


@pytest.mark.parametrize("key", NUMBERS)
def test_text_is_no_number(good, key):
    value = found(good, key)
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
    value = found(good, key)
    assert f"{key} must be positive" in refusal(changed(good, key, put(value, number)))


def test_limits_of_position_are_pairs_and_null_is_no_limit(good):
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, -1], [-1, 1]]))
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, 1], [-1, 1]]))
    free = Metadata.parse(changed(good, "limits.position", [[None, None], [-1, None]])).position_limit
    assert free.tolist() == [[-math.inf, math.inf], [-1, math.inf]]


@pytest.mark.parametrize(
    "region",
    [
        *({"kind": "ring", "inner": inner, "outer": outer} for inner, outer in ((0.5, 0.3), (-0.1, 0.3), (0.1, None))),
        *({"kind": "ring"}, {"kind": "ring", "inner": 0.1, "outer": 0.2, "middle": 0.15}, {"kind": "disc"}),
        {"kind": "ring", "inner": [0.1], "outer": 0.2},
        *({"kind": "box", "low": low, "high": [1.0, 1.0]} for low in ([2.0, 0.0], [0.0], [None, 0.0], 0.0)),
        {"kind": "box", "low": [0.0] * 3, "high": [1.0] * 3},  # more numbers than the goal has
    ],
)
def test_a_region_of_goals_that_cannot_be_is_refused(good, region):
    assert "goal.region" in refusal(changed(good, "goal.region", region))


@pytest.mark.parametrize("joints", [[], ["a", "a"], ["a", 2], ["a", None], "ab", [["a"], ["b"]]], ids=repr)
def test_joints_are_distinct_names(good, joints):
    assert "robot.joints" in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize("joints", [["a"], ["a", "b", "c"]])
def test_as_many_joints_as_everything_else_says(good, joints):
    assert "metadata: " in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize("shape", [[3], [], [1, 2], "2", [2, 1], [2.0], [True, True]], ids=repr)
@pytest.mark.parametrize("key", ["inputs.2", "inputs.0", "outputs.0"])
def test_signals_have_the_shapes_of_a_robot_s(good, key, shape):
    raw = json.loads(changed(good, f"{key}.shape", shape))
    for part in ("low", "high", "labels"):
        raw = json.loads(changed(raw, f"{key}.{part}", []))
    assert "metadata: " in refusal(json.dumps(raw))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("inputs.0.name", name) for name in ("joint_velocity", "imu", "error", "joint position", "x" * 1000)),
        *(("inputs.0.quantity", quantity) for quantity in ("joint_velocity", "pressure")),
        *(("inputs.0.labels", labels) for labels in ([], ["joint2", "joint1"], ["joint1"])),
        *(("outputs.0.quantity", quantity) for quantity in ("joint_position", "view", "position")),
        *(("outputs.0.name", "command"), ("outputs.0.unit", "rad"), ("inputs.2.unit", "cm")),
        *(("inputs.2.low", [1.0, 1.0]), ("inputs.2.high", [-1.0, 1.0]), ("outputs.0.labels", ["joint1", "joint3"])),
    ],
)
def test_signals_that_are_not_those_of_a_robot_s_policy_are_refused(good, key, value):
    assert "metadata: " in refusal(changed(good, key, value))


@pytest.mark.parametrize("side", ["inputs", "outputs"])
def test_a_signal_too_few_or_twice_is_refused(good, side):
    assert "metadata: " in refusal(changed(good, side, good[side][:-1]))
    assert "metadata: " in refusal(changed(good, side, [*good[side], good[side][0]]))


def test_a_further_input_is_read_and_left_to_who_drives(good):
    imu = describe_signal(Signal("imu", Quantity.VIEW, (2, 3)))
    raw = json.loads(changed(good, "inputs", [*good["inputs"], imu]))
    text = changed(raw, "golden", good["golden"] | {"imu": [[[0.0] * 3] * 2] * 32})
    metadata = Metadata.parse(text)
    assert metadata.inputs[-1] == Signal("imu", Quantity.VIEW, (2, 3))
    assert metadata.golden["imu"].shape == (32, 2, 3)


def test_signals_and_regions_come_back_as_they_were(good):
    metadata = Metadata.parse(json.dumps(good))
    for side in ("inputs", "outputs"):
        assert [describe_signal(signal) for signal in getattr(metadata, side)] == good[side]
    assert describe_region(metadata.region) == good["goal"]["region"]


def test_there_are_golden_pairs_and_all_are_complete(good):
    none = {key: [] for key in good["golden"]}
    assert "there are 0 golden pairs, not 1 to 1,000" in refusal(changed(good, "golden", none))
    for key, rows in good["golden"].items():
        assert "golden." in refusal(changed(good, f"golden.{key}", rows[:-1]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[*row, 0.0] for row in rows]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[], *rows[1:]]))


@pytest.mark.parametrize("version", [0, 1, "2", None, [2], {}, -1, 1e300], ids=repr)
def test_another_format_version_is_named_and_how_to_mend_it(good, version):
    message = refusal(changed(good, "format_version", version))
    assert f"format version {version!r}; this physai reads 4: export the policy again" in message
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
    "key", ["control_rate", "limits.position", "golden.goal", "robot.joints", "robot.name", "inputs", "goal.region"]
)
def test_deep_nesting_is_refused(good, key, depth):
    nested: list = []
    for _ in range(depth):
        nested = [nested]
    assert key in refusal(changed(good, key, nested))


def test_half_a_surrogate_in_a_name_makes_no_unprintable_message(good):
    refusal(changed(good, "robot.joints", ["a", "\ud800"]))


def test_a_goal_that_is_said_by_name_loses_no_number(good):
    assert "inputs.2.labels must be distinct" in refusal(changed(good, "inputs.2.labels", ["x", "x"]))


def test_a_tolerance_that_is_met_everywhere_is_refused(good):
    text = refusal(changed(good, "goal.tolerances.0.value", 0.54))
    assert text == "metadata: goal.tolerances: one of more than 0.53 m is met everywhere"
    Metadata.parse(changed(good, "goal.tolerances.0.unit", "rad"))  # of something else than the goal
