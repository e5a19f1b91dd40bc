"""What a policy says about itself: every part of it is there, of the right form, and possible."""

import copy
import json
import math

import numpy as np
import pytest

from physai.deploy import Metadata, PolicyError, read_metadata
from physai.deploy.metadata import metadata_sha256

REQUIRED = [
    "robot.name",
    "robot.joints",
    "inputs",
    "inputs.joint_position",
    "inputs.joint_velocity",
    "inputs.goal",
    "outputs",
    "outputs.joint_velocity_command",
    "limits.position",
    "limits.velocity",
    "limits.effort",
    "limits.command",
    "control_rate",
    "goal.frame",
    "goal.radius",
    "goal.tolerance",
    "golden",
    "golden.joint_position",
    "golden.joint_velocity",
    "golden.goal",
    "golden.joint_velocity_command",
    "golden.distance",
    "units",
    "robot.urdf_sha256",
    "robot.end_effector",
    "checkpoint",
    "evaluation",
    "config",
    "versions",
    "created",
    "content_sha256",
]
NUMBERS = [key for key in REQUIRED if key.startswith(("limits", "control", "goal.r", "goal.t", "golden."))]


@pytest.fixture(scope="module")
def good(exported_run) -> dict:
    return read_metadata(exported_run / "policy.pt").raw


def changed(good: dict, key: str, value: object) -> str:
    """The metadata with another value at a dotted key; with none if the value is ``...``."""
    raw = copy.deepcopy(good)
    *folders, last = key.split(".")
    inside = raw
    for folder in folders:
        inside = inside[folder]
    if value is ...:
        del inside[last]
    else:
        inside[last] = value
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
    assert (metadata.control_rate, metadata.goal_frame) == (50.0, "base")
    assert metadata.goal_radius[0] < metadata.goal_radius[1]
    assert metadata.goal_tolerance > 0
    assert metadata.golden.pop("distance").shape == (32, 1)
    assert {key: value.shape for key, value in metadata.golden.items()} == dict.fromkeys(metadata.golden, (32, 2))
    assert {value.dtype for value in metadata.golden.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("key", REQUIRED)
def test_a_missing_part_is_named(good, key):
    message = refusal(changed(good, key, ...))
    assert key.split(".")[0] in message
    if key.startswith(("robot", "limits", "goal", "control")) or "." not in key:
        assert key in message


@pytest.mark.parametrize("group", ["robot", "limits", "goal"])
def test_a_missing_group_is_named(good, group):
    assert f"metadata: {group}." in refusal(changed(good, group, ...))


OTHER_TYPES = [None, {}, [], [[]], 7, True, "x", [{}], {"a": 1}]
TEXTS = ("robot.name", "robot.urdf_sha256", "robot.end_effector", "goal.frame", "created", "content_sha256")
GROUPS, SINGLE_NUMBERS = ("checkpoint", "evaluation", "config", "versions"), ("control_rate",)
RIGHT = [
    *((key, "x") for key in TEXTS),
    *((key, value) for key in GROUPS for value in ({}, {"a": 1})),
    *((key, 7) for key in SINGLE_NUMBERS),
]


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key in REQUIRED for value in OTHER_TYPES if (key, value) not in RIGHT], ids=repr
)
def test_a_part_of_another_type_is_named(good, key, value):
    assert key.split(".")[0] in refusal(changed(good, key, value))


@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_of_another_shape_are_named(good, key):
    group, _, last = key.partition(".")
    value = good[group][last] if last else good[group]
    for other in ([value], [value, value], value[:-1] if isinstance(value, list) else [1.0]):
        assert key in refusal(changed(good, key, other)) or key.startswith("golden")


def put(value: object, number: object) -> object:
    """The same nested lists with another first number."""
    return [put(value[0], number), *value[1:]] if isinstance(value, list) else number


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 10**400], ids=["NaN", "inf", "-inf", "10**400"])
@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_that_are_none_are_refused(good, key, number):
    group, _, last = key.partition(".")
    value = good[group][last] if last else good[group]
    refusal(changed(good, key, put(value, number)))


@pytest.mark.parametrize("key", NUMBERS)
def test_text_is_no_number(good, key):
    group, _, last = key.partition(".")
    value = good[group][last] if last else good[group]
    refusal(changed(good, key, put(value, "2.5")))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("key", ["joint_position", "joint_velocity", "goal", "joint_velocity_command"])
def test_golden_numbers_that_are_too_large_for_float32_are_refused(good, key):
    refusal(changed(good, f"golden.{key}", put(good["golden"][key], 1e300)))


@pytest.mark.parametrize(
    "key", ["limits.velocity", "limits.effort", "limits.command", "control_rate", "goal.tolerance"]
)
@pytest.mark.parametrize("number", [0, -1.5])
def test_a_limit_that_is_not_positive_is_refused(good, key, number):
    group, _, last = key.partition(".")
    value = good[group][last] if last else good[group]
    assert f"{key} must be positive" in refusal(changed(good, key, put(value, number)))


def test_limits_of_position_are_pairs_and_null_is_no_limit(good):
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, -1], [-1, 1]]))
    assert "limits.position" in refusal(changed(good, "limits.position", [[1, 1], [-1, 1]]))
    free = Metadata.parse(changed(good, "limits.position", [[None, None], [-1, None]])).position_limit
    assert free.tolist() == [[-math.inf, math.inf], [-1, math.inf]]


@pytest.mark.parametrize("radius", [[0.5, 0.3], [-0.1, 0.3]])
def test_a_region_of_goals_that_cannot_be_is_refused(good, radius):
    assert "goal.radius" in refusal(changed(good, "goal.radius", radius))


@pytest.mark.parametrize("joints", [[], ["a", "a"], ["a", 2], ["a", None], "ab", [["a"], ["b"]]], ids=repr)
def test_joints_are_distinct_names(good, joints):
    assert "robot.joints" in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize("joints", [["a"], ["a", "b", "c"]])
def test_as_many_joints_as_everything_else_says(good, joints):
    assert "metadata: " in refusal(changed(good, "robot.joints", joints))


@pytest.mark.parametrize("shape", [["N", 3], ["N"], [1, 2], "N2", ["N", 2, 1]], ids=repr)
@pytest.mark.parametrize("key", ["inputs.goal", "inputs.joint_position", "outputs.joint_velocity_command"])
def test_inputs_and_outputs_are_those_of_a_policy(good, key, shape):
    assert f"metadata: {key.split('.')[0]} must be" in refusal(changed(good, key, shape))


@pytest.mark.parametrize("key", ["inputs.image", "outputs.gripper"])
def test_another_input_or_output_is_refused(good, key):
    assert f"metadata: {key.split('.')[0]} must be" in refusal(changed(good, key, ["N", 2]))


def test_there_are_golden_pairs_and_all_are_complete(good):
    none = {key: [] for key in good["golden"]}
    assert "there are 0 golden pairs, not 1 to 1,000" in refusal(changed(good, "golden", none))
    for key, rows in good["golden"].items():
        assert "golden." in refusal(changed(good, f"golden.{key}", rows[:-1]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[*row, 0.0] for row in rows]))
        assert "golden." in refusal(changed(good, f"golden.{key}", [[], *rows[1:]]))


@pytest.mark.parametrize("version", [0, 2, "1", None, [1], {}, -1, 1e300], ids=repr)
def test_another_format_version_is_named_and_how_to_mend_it(good, version):
    message = refusal(changed(good, "format_version", version))
    assert f"format version {version!r}; this physai reads 1: export the policy again" in message
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
    "key", ["control_rate", "limits.position", "golden.goal", "robot.joints", "robot.name", "inputs"]
)
def test_deep_nesting_is_refused(good, key, depth):
    nested: list = []
    for _ in range(depth):
        nested = [nested]
    assert key in refusal(changed(good, key, nested))


def test_half_a_surrogate_in_a_name_makes_no_unprintable_message(good):
    text = changed(good, "robot.joints", ["a", "\ud800"])
    assert Metadata.parse(text).joints == ("a", "\ud800")
