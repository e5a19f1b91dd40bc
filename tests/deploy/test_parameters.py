import dataclasses
import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.deploy import Controller, ControllerConfig
from physai.deploy.parameters import Parameters, parameter
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
    assert set(metadata) == {"unit", "low", "high", "description", "choices", "fixed"}
    assert metadata["description"]
    assert isinstance(metadata["unit"], str)
    if name in FLOATS and name not in ("jump_factor", "reached_hysteresis", "following_error"):
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
        assert getattr(ControllerConfig(**{name: end}), name) == end


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused(name, bad):
    assert refusal(**{name: bad}).startswith(f"{name}: must lie between ")


@pytest.mark.parametrize("name", FIELDS)
def test_a_value_of_another_type_is_refused_in_a_line_that_names_it(name):
    lists = isinstance(FIELDS[name].default, tuple)
    for bad in (None, b"reject", 1 + 0j, *([] if lists else [[1]]), *([] if name == "unreachable_goal" else ["1"])):
        assert refusal(**{name: bad}).startswith(f"{name}: a {type(FIELDS[name].default).__name__} is needed, got ")


@pytest.mark.parametrize("name", FLOATS)
def test_an_int_will_do_for_a_float_and_becomes_one(name):
    value = max(1, math.ceil(FIELDS[name].metadata["low"]))
    taken = getattr(ControllerConfig(**{name: value}), name)
    assert taken == value
    assert type(taken) is float


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


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_too_large_for_a_float_is_refused(name):
    assert refusal(**{name: 10**400}).startswith(f"{name}: ")
    assert refusal(**{name: -(10**400)}).startswith(f"{name}: ")


def test_a_config_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        ControllerConfig().max_velocity = 100.0


def test_all_that_is_wrong_is_named_in_one_line():
    assert refusal(max_velocity=1e3, recovery_states=2.5, state_timeout=0.2, unreachable_goal="clamp") == (
        "max_velocity: must lie between 0.001 and 100 rad/s, got 1000.0; "
        "recovery_states: a int is needed, got 2.5; "
        "unreachable_goal: must be 'reject' or 'project', got 'clamp'"
    )


# Parameters of other kinds.


@dataclass(frozen=True)
class Other(Parameters):
    rate: float = parameter(50.0, "how often", "Hz", 1.0, 1e3)
    count: int = parameter(3, "how many", low=1, high=9)
    enabled: bool = parameter(False, "whether", fixed=True)
    topic: str = parameter("", "any text")
    mode: str = parameter("slow", "how", choices=("slow", "fast"))
    names: tuple[str, ...] = parameter((), "any texts")
    gains: tuple[float, ...] = parameter((1.0, 2.0), "some numbers", low=-1.0, high=5.0)


OTHERS = {field.name: field for field in dataclasses.fields(Other)}
WANTED = {  # said again, in other words
    "rate": lambda value: type(value) in (int, float) and 1 <= value <= 1000,
    "count": lambda value: type(value) is int and 1 <= value <= 9,
    "enabled": lambda value: type(value) is bool,
    "topic": lambda value: type(value) is str,
    "mode": lambda value: value in ("slow", "fast"),
    "names": lambda value: type(value) in (list, tuple) and all(type(x) is str for x in value),
    "gains": lambda value: (
        type(value) in (list, tuple) and all(type(x) in (int, float) and -1 <= x <= 5 for x in value)
    ),
}


def refusal_of_other(**values):
    with pytest.raises(UserError) as caught:
        Other(**values)
    return str(caught.value)


def test_what_is_declared_is_kept_with_the_field():
    assert OTHERS["rate"].metadata["unit"] == "Hz"
    assert OTHERS["mode"].metadata["choices"] == ("slow", "fast")
    assert [name for name, field in OTHERS.items() if field.metadata["fixed"]] == ["enabled"]


def test_a_list_becomes_a_tuple_and_ints_in_it_the_floats_that_are_wanted():
    taken = Other(names=["a", "b"], gains=[0, 1.5])
    assert (taken.names, taken.gains) == (("a", "b"), (0.0, 1.5))
    assert [type(gain) for gain in taken.gains] == [float, float]
    assert Other(names=[], gains=()).names == ()


def test_numbers_of_numpy_will_do_for_floats():
    taken = Other(rate=np.float64(2.5), gains=list(np.array([0.5, 1.0])))
    assert [type(number) for number in (taken.rate, *taken.gains)] == [float] * 3


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"names": "ab"}, "names: a tuple is needed, got 'ab'"),
        ({"names": ["a", 1]}, "names: a list of str is needed, got ['a', 1]"),
        ({"gains": 1.0}, "gains: a tuple is needed, got 1.0"),
        ({"gains": [1.0, "2"]}, "gains: a list of float is needed, got [1.0, '2']"),
        ({"gains": [True]}, "gains: a list of float is needed, got [True]"),
        ({"gains": [1.0, 5.5]}, "gains: must lie between -1 and 5, got (1.0, 5.5)"),
        ({"gains": [math.nan]}, "gains: must lie between -1 and 5, got (nan,)"),
        ({"mode": "Slow"}, "mode: must be 'slow' or 'fast', got 'Slow'"),
        ({"mode": None}, "mode: a str is needed, got None"),
    ],
)
def test_a_list_or_a_word_that_is_not_wanted_is_refused_in_a_line_that_names_it(values, message):
    assert refusal_of_other(**values) == message


plain = st.none() | st.booleans() | st.integers(-10, 10) | st.integers() | st.floats() | st.text(max_size=9)
anything = plain | st.sampled_from(["slow", "fast", 10**400]) | st.lists(plain, max_size=3)


@pytest.mark.slow
@given(st.dictionaries(st.sampled_from(list(OTHERS)), anything))
def test_whatever_is_given_is_taken_as_its_type_or_refused_in_one_line_that_names_all_of_it(values):
    bad = [name for name in OTHERS if name in values and not WANTED[name](values[name])]
    try:
        taken = Other(**values)
    except UserError as error:
        lines = str(error).splitlines()
        assert len(lines) == 1
        assert re.findall(r"(?:^|; )(\w+): (?:a|must) ", re.sub(r"'[^']*'|\"[^\"]*\"", "''", lines[0])) == bad
    else:
        assert not bad
        for name, field in OTHERS.items():
            value = getattr(taken, name)
            assert type(value) is type(field.default)
            assert value == (
                tuple(values[name]) if isinstance(values.get(name), list) else values.get(name, field.default)
            )


# What the controller refuses, since it does not fit its robot: of 2.5 rad/s, a joint of 2.6 rad, at 50 Hz.


@dataclasses.dataclass
class Stranger:
    metadata: object
    sha256: str = ""


@pytest.fixture
def other(policy):
    """Make a policy for another robot."""
    return lambda **changes: Stranger(dataclasses.replace(policy.metadata, **changes))


def refused(policy, **values):
    with pytest.raises(UserError) as caught:
        Controller(policy, ControllerConfig(**values))
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_max_velocity_beyond_the_slowest_joint_s_limit_is_refused(policy, other):
    Controller(policy, ControllerConfig(max_velocity=2.5, limit_margin=0.5))
    assert refused(policy, max_velocity=2.51) == "max_velocity: 2.51 rad/s is beyond the robot's limit, 2.5 rad/s"
    slow = other(velocity_limit=np.array([2.5, 0.25]))
    Controller(slow, ControllerConfig(max_velocity=0.25))
    assert refused(slow, max_velocity=0.3).startswith("max_velocity: ")


def test_a_margin_that_leaves_no_room_to_move_is_refused(policy, other):
    narrow = other(position_limit=policy.metadata.position_limit * 0.05)
    Controller(narrow, ControllerConfig(limit_margin=0.12))
    assert refused(narrow, limit_margin=0.13).startswith("limit_margin: 0.13 rad leaves no room")


def test_a_jump_of_the_clock_that_is_no_longer_than_a_late_update_is_refused(policy, other):
    slow = other(control_rate=2.0)
    assert refused(slow) == "clock_jump: must be longer than 3 control periods, got 1.0"
    Controller(slow, ControllerConfig(clock_jump=1.6, limit_margin=0.5))
    assert refused(policy, clock_jump=0.06).startswith("clock_jump: ")
    Controller(policy, ControllerConfig(clock_jump=0.061))


def test_a_time_after_which_goals_are_forgotten_that_is_shorter_than_a_hold_takes_is_refused(policy):
    Controller(policy, ControllerConfig(resume_timeout=0.1))
    expected = "resume_timeout: must be as long as state_timeout, 0.1 s, at least, got 0.09"
    assert refused(policy, resume_timeout=0.09) == expected


@pytest.mark.parametrize(
    ("too_much", "enough"),
    [
        ({"max_velocity": 2.0}, {"limit_margin": 0.3201}),
        ({"max_velocity": 0.63}, {"max_velocity": 0.62}),
        ({"state_timeout": 0.28}, {"state_timeout": 0.27}),
        ({"limit_margin": 0.047}, {"limit_margin": 0.049}),
    ],
)
def test_a_margin_that_the_arm_may_cross_before_an_old_state_stops_it_is_refused(policy, too_much, enough):
    assert refused(policy, **too_much).startswith("limit_margin: at ")
    Controller(policy, ControllerConfig(**too_much | enough))


@pytest.mark.parametrize("limit", [(-math.inf, 2.6), (-2.6, math.inf), (-2.6, 2.6)])
def test_that_margin_matters_where_there_is_a_limit(other, limit):
    everywhere = (-math.inf, math.inf)
    Controller(other(position_limit=np.array([everywhere, everywhere])), ControllerConfig(max_velocity=2.0))
    limited = other(position_limit=np.array([everywhere, limit]))
    assert refused(limited, max_velocity=2.0).startswith("limit_margin: at 2.0 rad/s")


@pytest.mark.parametrize("values", [{"max_velocity": 2.0}, {"max_velocity": 1.237}])
def test_a_margin_as_wide_as_the_refusal_asks_for_will_do(policy, values):
    least = float(re.search(r"must be ([0-9.]+) rad at least", refused(policy, **values))[1])
    Controller(policy, ControllerConfig(**values, limit_margin=least))
