"""Policies of other signals: goals in joint space, goals of three numbers, two errors, inputs that nobody knows."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from physai.deploy import Controller, ControllerConfig, Goal, JointState, State, load_policy
from physai.deploy.goals import GoalError, accept
from physai.errors import UserError
from physai.signals import Box, Quantity, Signal, Tolerance
from tests.deploy.files import described, refusal
from tests.deploy.scripted import LIMIT, of_joints, policy_file

PERIOD = 0.02
JOINTS = ("a", "b", "c")
POSITION = of_joints("joint_position", "joint_position", JOINTS)
VELOCITY = of_joints("joint_velocity", "joint_velocity", JOINTS)
COMMAND = of_joints("joint_velocity_command", "joint_velocity", JOINTS)
JOINT_GOAL = of_joints("goal", "joint_position", JOINTS)
POINT_GOAL = Signal("goal", Quantity.POSITION, (3,), labels=("x", "y", "z"), frame="base")
NEAR = (Tolerance("joint angle", "rad", 0.05), Tolerance("sum", "rad", 0.1))


class Reach(nn.Module):
    """Goes straight to a joint configuration; its errors are the largest one and their sum."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(4.0), requires_grad=False)

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return torch.clamp(self.gain * (goal - joint_position), -2.0, 2.0)

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        far = (joint_position - goal).abs()
        return torch.stack([far.amax(dim=1), far.sum(dim=1)], dim=1)


class Point(Reach):
    """Takes a goal of three numbers for a place that the joints' angles are the coordinates of."""

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return (joint_position - goal).square().sum(dim=1, keepdim=True).sqrt()


class Camera(Reach):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor, camera: Tensor) -> Tensor:
        return joint_position * camera.sum()


BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.5))


def load(path, module, *inputs, goal=JOINT_GOAL, tolerances=NEAR):
    path.write_bytes(policy_file(module, JOINTS, (POSITION, VELOCITY, goal, *inputs), (COMMAND,), BOX, tolerances))
    return load_policy(path)


@pytest.fixture
def reach(path):
    return load(path, Reach())


@pytest.fixture
def point(path):
    return load(path, Point(), goal=POINT_GOAL, tolerances=(Tolerance("distance", "m", 0.02),))


def drive(policy, goal, seconds, start=(0.0, 0.0, 0.0), obey=1.0, **config):
    """An arm that does what it is told; the last command, and where it is then."""
    controller = Controller(policy, ControllerConfig(max_velocity=1.0, limit_margin=0.2, **config), lambda: 0.0)
    position, velocity = np.array(start), np.zeros(3)
    for tick in range(round(seconds / PERIOD)):
        position = position + velocity * PERIOD
        state = JointState(JOINTS, position, velocity, tick * PERIOD)
        command = controller.update(tick * PERIOD, state, goal if not tick else None)
        velocity = obey * command.value
    return command, position, controller


def test_a_file_of_other_signals_loads_and_gives_what_it_gave(reach):
    assert reach.golden_error == 0.0
    assert reach.metadata.goal == JOINT_GOAL
    assert reach.metadata.region == BOX
    assert [tolerance.value for tolerance in reach.metadata.tolerances] == [0.05, 0.1]
    assert reach([0.0, 0.5, 1.0], [0.0] * 3, [0.25, 0.5, -1.0]).tolist() == [1.0, 0.0, -LIMIT]
    np.testing.assert_allclose(reach.error([0.0, 0.5, 1.0], [0.25, 0.5, -1.0]), [2.0, 2.25])


@pytest.mark.parametrize(
    "goal",
    [
        Goal([0.5, -0.5, 1.2]),
        Goal([0.5, -0.5, 1.2], "any frame"),
        Goal([1.2, 0.5, -0.5], names=("c", "a", "b")),
        Goal(np.array([-0.5, 1.2, 0.5]), names=["b", "c", "a"]),
    ],
    ids=["in order", "with a frame", "by name", "by name, in arrays"],
)
def test_an_arm_reaches_a_joint_configuration_however_it_is_said(reach, goal):
    command, position, controller = drive(reach, goal, 4.0)
    assert command.state is State.REACHED
    assert np.abs(position - [0.5, -0.5, 1.2]).max() < 0.05
    assert np.abs(position - [0.5, -0.5, 1.2]).sum() < 0.1
    assert controller.snapshot()["goal"] == [0.5, -0.5, 1.2]


def test_every_error_must_be_within_its_tolerance(path):
    tolerances = (Tolerance("joint angle", "rad", 0.9), Tolerance("sum", "rad", 0.05))
    command, position, _ = drive(load(path, Reach(), tolerances=tolerances), Goal([0.5, 0.5, 0.5]), 4.0)
    assert command.state is State.REACHED
    assert np.abs(position - 0.5).sum() < 0.05


def test_an_arm_reaches_a_point_of_three_numbers(point):
    command, position, _ = drive(point, Goal([0.3, -0.4, 1.4], "base"), 4.0)
    assert command.state is State.REACHED
    assert np.linalg.norm(position - [0.3, -0.4, 1.4]) < 0.02


@pytest.mark.parametrize(
    ("goal", "kind", "text"),
    [
        (Goal([0.5, 0.5]), "malformed", "it has the shape [2], not [3]"),
        (Goal([0.5, 0.5], names=("a", "b")), "malformed", "it is for ['a', 'b'], not ['a', 'b', 'c']"),
        (Goal([0.5] * 4, names=("a", "b", "c", "d")), "malformed", "it is for ['a', 'b', 'c', 'd']"),
        (Goal([0.5] * 3, names=("a", "b", "b")), "malformed", "it is for ['a', 'b', 'b']"),
        (Goal([0.5] * 3, names=("a", "b")), "malformed", "2 names, but values of the shape [3]"),
        (Goal([0.5] * 3, names="abc"), "malformed", ""),
        (Goal([0.5] * 3, names=(1, 2, 3)), "malformed", "its names are none"),
        (Goal([0.5] * 3, names=7), "malformed", "its names are none"),
        (Goal([0.5, np.nan, 0.5]), "not finite", "it is not finite"),
        (Goal([0.5, 0.5, 2.0]), "unreachable", "its number 3 is 2.000, not -1 to 1.5"),
    ],
    ids=repr,
)
def test_a_goal_of_joints_that_is_none_is_rejected_in_a_line_that_says_why(reach, goal, kind, text):
    if goal.names == "abc":
        accept(goal, reach.metadata, False)  # letters are names, too
        return
    with pytest.raises(GoalError) as caught:
        accept(goal, reach.metadata, False)
    assert caught.value.kind == kind
    assert str(caught.value).startswith(f"goal rejected: {text}")
    assert "\n" not in str(caught.value)


def test_a_goal_out_of_a_box_is_moved_to_its_nearest_point_where_that_is_allowed(reach):
    value, moved = accept(Goal([2.0, -7.0, 0.5]), reach.metadata, True)
    assert (value.tolist(), moved) == ([1.0, -1.0, 0.5], True)


def test_a_point_in_another_frame_is_rejected(point):
    with pytest.raises(GoalError, match="frame 'world' is not 'base'"):
        accept(Goal([0.5, 0.5, 0.5], "world"), point.metadata, False)


def test_a_goal_that_is_given_up_is_told_with_all_errors_and_their_units(reach):
    command, *_ = drive(
        reach, Goal([0.5, 0.25, 0.0]), 2.0, obey=0.0, progress_timeout=0.5, following_error=100.0, following_window=9.0
    )
    assert command.state is State.HOLD
    assert command.reasons == ("no progress for 0.5 s, 0.500 rad, 0.750 rad from the goal: waiting for another",)


def test_a_policy_that_takes_what_no_controller_knows_loads_and_is_refused_by_name(path):
    camera = Signal("camera", Quantity.VIEW, (2, 2), (0.0,) * 4, (1.0,) * 4)
    policy = load(path, Camera(), camera)
    assert policy([1.0, 2.0, 3.0], [0.0] * 3, [0.0] * 3, np.full((2, 2), 0.5)).tolist() == [2.0, 4.0, 6.0]
    with pytest.raises(UserError, match="the policy takes 'camera': this controller can tell joint_position, ") as line:
        Controller(policy)
    assert "\n" not in str(line.value)


def test_a_module_that_takes_another_order_than_its_signals_is_refused(path, reach):
    def swap(metadata):
        metadata["inputs"][:2] = metadata["inputs"][1::-1]

    path.write_bytes(described(path.read_bytes(), swap))
    assert "its forward takes ['joint_position', 'joint_velocity', 'goal'], not ['joint_velocity'" in refusal(path)
