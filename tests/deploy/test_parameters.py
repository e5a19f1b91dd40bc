import dataclasses
import math

import pytest

from physai.deploy import Controller, ControllerConfig
from physai.errors import UserError

FIELDS = {field.name: field for field in dataclasses.fields(ControllerConfig)}
NUMBERS = {name: field for name, field in FIELDS.items() if type(field.default) in (int, float)}
FLOATS = [name for name, field in NUMBERS.items() if type(field.default) is float]
INTS = [name for name in NUMBERS if name not in FLOATS]


def refusal(**values):
    with pytest.raises(UserError) as caught:
        ControllerConfig(**values)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_the_defaults_are_those_of_the_contract():
    config = ControllerConfig()
    assert config.rate_hz == 50
    assert config.max_velocity == 0.3
    assert config.limit_margin == 0.1
    assert config.state_timeout == 0.1
    assert config.recovery_states == 5
    assert config.policy_failures == 3
    assert config.unreachable_goal == "reject"
    assert config.allow_velocity_estimate is False


@pytest.mark.parametrize("name", FIELDS)
def test_every_field_says_its_unit_range_and_meaning(name):
    metadata = FIELDS[name].metadata
    assert set(metadata) == {"unit", "low", "high", "description"}
    assert metadata["description"]
    assert isinstance(metadata["unit"], str)
    if name in FLOATS and name not in ("jump_factor", "reached_hysteresis"):
        assert metadata["unit"]
    if name in NUMBERS:
        assert metadata["low"] <= FIELDS[name].default <= metadata["high"] < math.inf


@pytest.mark.parametrize("name", NUMBERS)
def test_a_value_outside_its_range_is_refused_in_a_line_that_names_it(name):
    metadata, step = FIELDS[name].metadata, 1 if name in INTS else 1e-9
    for bad in (metadata["low"] - step, metadata["high"] * 2, -metadata["high"]):
        message = refusal(**{name: bad})
        assert message.startswith(f"{name}: must lie between {metadata['low']:g} and {metadata['high']:g}")
        assert message.endswith(f", got {bad}")
        assert metadata["unit"] in message


@pytest.mark.parametrize("name", NUMBERS)
def test_the_ends_of_a_range_are_inside(name):
    metadata = FIELDS[name].metadata
    for end in (metadata["low"], metadata["high"]):
        others = {"rate_hz": 1000.0 if name == "clock_jump" else 50.0, "clock_jump": 3600.0}
        config = ControllerConfig(**{**others, name: end})
        assert getattr(config, name) == end


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused(name, bad):
    assert refusal(**{name: bad}).startswith(f"{name}: must lie between ")


@pytest.mark.parametrize("name", FIELDS)
def test_a_value_of_another_type_is_refused_in_a_line_that_names_it(name):
    for bad in (None, [1], b"reject", 1 + 0j, *([] if name == "unreachable_goal" else ["1"])):
        assert refusal(**{name: bad}).startswith(f"{name}: a {type(FIELDS[name].default).__name__} is needed, got ")


@pytest.mark.parametrize("name", FLOATS)
def test_an_int_will_do_for_a_float_and_becomes_one(name):
    value = max(1, math.ceil(FIELDS[name].metadata["low"]))
    config = ControllerConfig(**{"rate_hz": 50, "clock_jump": 2, name: value} if name != "rate_hz" else {name: 50})
    assert getattr(config, name) == (50 if name == "rate_hz" else value)
    assert type(getattr(config, name)) is float


@pytest.mark.parametrize("name", NUMBERS)
def test_a_bool_is_no_number(name):
    assert refusal(**{name: True}).startswith(f"{name}: a ")


@pytest.mark.parametrize("name", INTS)
def test_a_float_is_no_count(name):
    assert refusal(**{name: 5.0}) == f"{name}: a int is needed, got 5.0"


def test_an_int_is_no_bool():
    assert refusal(allow_velocity_estimate=1) == "allow_velocity_estimate: a bool is needed, got 1"


def test_what_to_do_with_an_unreachable_goal_is_one_of_two_words():
    assert ControllerConfig(unreachable_goal="project").unreachable_goal == "project"
    assert refusal(unreachable_goal="clamp") == "unreachable_goal: must be 'reject' or 'project', got 'clamp'"


def test_a_jump_of_the_clock_is_longer_than_a_late_update():
    assert refusal(rate_hz=2).startswith("clock_jump: must be longer than three periods of rate_hz")
    assert ControllerConfig(rate_hz=2, clock_jump=1.6).clock_jump == 1.6


def test_a_number_too_large_for_a_float_is_refused():
    # FAILS: physai.deploy.parameters raises OverflowError ("int too large to convert to float"), not a UserError.
    assert refusal(max_velocity=10**400).startswith("max_velocity: ")


def test_a_config_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        ControllerConfig().max_velocity = 100.0


def test_the_controller_refuses_a_max_velocity_beyond_the_robot_s_limit(policy):
    Controller(policy, ControllerConfig(max_velocity=2.5))
    with pytest.raises(UserError, match=r"^max_velocity: 2\.51 rad/s is beyond the robot's limit, 2\.5 rad/s$"):
        Controller(policy, ControllerConfig(max_velocity=2.51))


def test_the_slowest_joint_decides_which_max_velocity_is_refused(policy):
    class Slow:
        metadata, sha256 = (
            dataclasses.replace(policy.metadata, velocity_limit=policy.metadata.velocity_limit / [1, 10]),
            "",
        )

    Controller(Slow(), ControllerConfig(max_velocity=0.25))
    with pytest.raises(UserError, match="max_velocity: "):
        Controller(Slow(), ControllerConfig(max_velocity=0.3))


def test_the_controller_refuses_a_margin_that_leaves_no_room_to_move(policy):
    class Narrow:
        metadata = dataclasses.replace(policy.metadata, position_limit=policy.metadata.position_limit * 0.05)
        sha256 = ""

    Controller(Narrow(), ControllerConfig(limit_margin=0.12))
    with pytest.raises(UserError, match=r"^limit_margin: 0\.13 rad leaves no room"):
        Controller(Narrow(), ControllerConfig(limit_margin=0.13))
