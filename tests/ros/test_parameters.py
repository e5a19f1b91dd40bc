"""Dataclasses as parameters of nodes: at the start, in the help text, and changed while the arm moves."""

import dataclasses
import time
from dataclasses import dataclass
from functools import partial

import pytest
import rclpy
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from physai.deploy import ControllerConfig
from physai.deploy.parameters import Parameters, parameter
from physai.errors import UserError
from physai.ros.command_watchdog import WatchdogConfig
from physai.ros.inference_node import InferenceConfig
from physai.ros.node.parameters import declare, describe, help_text
from physai.ros.virtual_robot import VirtualRobotConfig
from tests.ros.peer import free_domain

NODE = "/inference_node"


@dataclass(frozen=True)
class Example(Parameters):
    speed: float = parameter(0.5, "how fast", "rad/s", 0.0, 2.0)
    count: int = parameter(3, "how many", "", 1, 10)
    mode: str = parameter("slow", "how", choices=("slow", "fast"))
    names: tuple[str, ...] = parameter((), "who", fixed=True)
    on: bool = parameter(False, "whether")


@pytest.fixture(scope="module")
def context():
    with free_domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        yield context
        context.try_shutdown()


def create(context, apply=None, **overrides):
    """Make a node with overrides; returns the node, its values, and the list of changes that it has taken."""
    node = Node(
        "example",
        context=context,
        parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
        enable_rosout=False,
    )
    changes = []
    return node, declare(node, Example, apply or changes.append), changes


@pytest.fixture
def make(context):
    return partial(create, context)


@pytest.fixture(scope="module")
def shared(context):
    return create(context)


def change(node, **values):
    return node.set_parameters([Parameter(name, value=value) for name, value in values.items()])


def test_values_are_those_given_and_the_defaults(make):
    node, values, _ = make(speed=1, names=["a", "b"])
    assert values == Example(speed=1.0, names=("a", "b"))
    assert type(values.speed) is float
    assert node.get_parameter("speed").value == 1.0
    assert node.get_parameter("names").value == ["a", "b"]
    assert node.get_parameter("mode").value == "slow"


def test_all_wrong_values_are_named_in_one_line(make):
    with pytest.raises(UserError) as error:
        make(speed="x", count=11, mode="medium")
    assert str(error.value) == (
        "speed: a float is needed, got 'x'; count: must lie between 1 and 10, got 11; "
        "mode: must be 'slow' or 'fast', got 'medium'"
    )


def test_changes_are_checked_applied_and_remembered(make):
    node, _, changes = make()
    assert change(node, speed=1)[0].successful
    assert changes == [Example(speed=1.0)]
    result = change(node, count=0)[0]
    assert not result.successful
    result = change(node, mode="medium")[0]
    assert (result.successful, result.reason) == (False, "mode: must be 'slow' or 'fast', got 'medium'")
    assert change(node, on=True)[0].successful
    assert changes[1:] == [Example(speed=1.0, on=True)]
    assert not change(node, names=["c"])[0].successful  # fixed
    assert node.get_parameter("names").value in ([], ())
    assert change(node, use_sim_time=True)[0].successful  # none of ours
    assert len(changes) == 2


def test_together_all_are_refused_if_one_is_wrong(make):
    node, _, changes = make()
    result = node.set_parameters_atomically([Parameter("speed", value=1.0), Parameter("mode", value="medium")])
    assert not result.successful
    assert node.get_parameter("speed").value == 0.5
    assert changes == []


def test_what_the_node_refuses_changes_nothing(make):
    def refuse(values):
        raise UserError("not now")

    node, _, _ = make(apply=refuse)
    result = change(node, speed=1.0)[0]
    assert (result.successful, result.reason) == (False, "not now")
    assert node.get_parameter("speed").value == 0.5


_VALUES = st.one_of(
    st.floats(), st.integers(-(2**63), 2**63 - 1), st.booleans(), st.text("abc", max_size=3), st.lists(st.floats())
)


@settings(max_examples=200, deadline=None)
@given(values=st.dictionaries(st.sampled_from(["speed", "count", "mode", "on"]), _VALUES, min_size=1))
def test_a_change_is_taken_exactly_where_the_dataclass_takes_it(shared, values):
    node, first, changes = shared
    before, taken = changes[-1] if changes else first, len(changes)
    result = node.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
    try:
        expected = dataclasses.replace(before, **values)
    except UserError:
        assert not result.successful
        assert len(changes) == taken
    else:
        assert result.successful, result.reason
        assert changes[taken:] == [expected]


@pytest.mark.parametrize("kind", [ControllerConfig, InferenceConfig, VirtualRobotConfig, WatchdogConfig])
def test_every_parameter_is_described_and_has_a_line_of_help(kind):
    text = help_text(kind).splitlines()
    fields = dataclasses.fields(kind)
    assert [line.split()[0] for line in text] == [field.name for field in fields]
    for field, line in zip(fields, text, strict=True):
        descriptor = describe(field)
        assert field.metadata["description"] in descriptor.description
        assert field.metadata["description"] in line
        assert descriptor.read_only == field.metadata["fixed"] == ("fixed" in line.rsplit("(", 1)[-1])
    assert "max_velocity              0.3      fastest joint" in help_text(ControllerConfig)
    assert "(rad/s, 0.001 to 100)" in help_text(ControllerConfig)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_lower_velocity_takes_effect_at_once_while_the_arm_moves(loop):
    loop.start()
    try:
        (answer,) = loop.peer.set_parameters(NODE, max_velocity=0.1)
        since = time.monotonic()
        assert answer.successful, answer.reason
        loop.peer.moved(after=since, commands=20)
        speeds = [max(map(abs, velocity)) for at, velocity in loop.peer.commands if at > since + 0.02]
        assert max(speeds) <= 0.1 + 1e-9
        assert max(speeds) > 0.05  # a tick that a busy machine made late is one of zeros
        (answer,) = loop.peer.set_parameters(NODE, max_velocity=0.3)
        since = time.monotonic()
        loop.peer.moved(after=since, commands=30)
        assert max(map(abs, loop.peer.commands[-1][1])) > 0.2
    finally:
        loop.peer.set_parameters(NODE, max_velocity=0.3)


@pytest.mark.slow
@pytest.mark.realtime
def test_bad_and_fixed_values_are_refused_while_the_arm_moves_and_change_nothing(loop):
    since = loop.start()
    answers = loop.peer.set_parameters(
        NODE,
        max_velocity=2.0,
        state_timeout=-1.0,
        recovery_states=2.5,
        trigger="joint_state",
        rate_hz=100.0,
        goal=[0.3],
    )
    assert [answer.successful for answer in answers] == [False] * 6
    assert "limit_margin: at 2.0 rad/s" in answers[0].reason
    assert answers[2].reason == "recovery_states: a int is needed, got 2.5"
    for answer in answers[3:]:
        assert "read-only" in answer.reason
    loop.peer.moved(after=time.monotonic(), commands=30)
    later = [velocity for at, velocity in loop.peer.commands if at > since]
    assert max(max(map(abs, velocity)) for velocity in later) <= 0.3 + 1e-9
    assert sum(not any(velocity) for velocity in later) <= 3  # ticks that a busy machine made late
    (answer,) = loop.peer.set_parameters(NODE, max_velocity=0.25)  # what was refused is not remembered
    assert answer.successful, answer.reason
    (answer,) = loop.peer.set_parameters(NODE, max_velocity=0.3)
    assert answer.successful, answer.reason


@pytest.mark.slow
def test_an_empty_list_of_the_command_line_is_the_empty_list(domain, start):
    node = start("virtual_robot", joints="[]", fault_nan=1)
    node.says("takes joint_velocity of ['joint1', 'joint2']")
