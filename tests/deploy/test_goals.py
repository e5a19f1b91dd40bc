import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physai.deploy import Goal
from physai.deploy.goals import GoalError, accept
from physai.signals import Box, Quantity, Signal


@pytest.fixture(scope="module")
def metadata(policy):
    return policy.metadata  # a ring of 0.30 to 0.53 m in the frame 'base'


def rejection(goal, metadata, project=False):
    with pytest.raises(GoalError) as caught:
        accept(goal, metadata, project)
    assert str(caught.value).startswith("goal rejected: ")
    assert "\n" not in str(caught.value)
    return caught.value.kind


@pytest.mark.parametrize("project", [True, False])
def test_a_goal_on_the_ring_is_taken_as_it_is(metadata, project):
    for position in ([0.4, 0.0], (-0.3, 0.3), np.array([0.0, -0.5], dtype=np.float32), [0, 0.31]):
        np.testing.assert_array_equal(accept(Goal(position, "base"), metadata, project)[0], position)


def test_a_goal_on_the_very_edge_is_reachable_however_it_was_rounded(metadata):
    for radius in (0.3, 0.53):
        for angle in np.linspace(-math.pi, math.pi, 50):
            goal = np.array([radius * math.cos(angle), radius * math.sin(angle)], dtype=np.float32)
            np.testing.assert_array_equal(accept(Goal(goal, "base"), metadata, False)[0], goal)


@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_goal_that_is_not_finite_is_rejected(metadata, bad, project):
    for position in ([bad, 0.4], [0.4, bad]):
        assert rejection(Goal(position, "base"), metadata, project) == "not finite"


@pytest.mark.parametrize(
    "position",
    [
        *([], [0.4], [0.4, 0.0, 0.0], [[0.4, 0.0]], 0.4, [[0.4], 0.0], {}, None, [None, 0.4], [10**400, 0.0]),
        *("abc", ["x", "y"], ["0.4", "0.0"], np.array(["0.4", "0.0"]), [True, False], [0.4, 1j]),
    ],
)
def test_a_goal_that_is_not_two_numbers_is_rejected(metadata, position):
    assert rejection(Goal(position, "base"), metadata, True) == "malformed"


@pytest.mark.parametrize("frame", ["world", "", "/base", "Base"])
def test_a_goal_in_another_frame_is_rejected(metadata, frame):
    assert rejection(Goal([0.4, 0.0], frame), metadata, True) == "wrong frame"


@pytest.mark.parametrize("frame", [None, 7, np.array(["base", "base"]), np.array([]), ["base"]])
def test_a_goal_whose_frame_is_no_name_is_rejected(metadata, frame):
    assert rejection(Goal([0.4, 0.0], frame), metadata, True) == "malformed"


@pytest.mark.parametrize("position", [[0.0, 0.0], [0.2, 0.2], [0.531, 0.0], [5.0, -5.0], [1e308, 0.0]])
def test_a_goal_out_of_reach_is_rejected(metadata, position):
    assert rejection(Goal(position, "base"), metadata) == "unreachable"


def test_a_goal_out_of_reach_is_moved_straight_onto_the_ring_where_that_is_allowed(metadata):
    for position, expected in [([0.2, 0.0], [0.3, 0.0]), ([0.0, -7.0], [0.0, -0.53]), ([-3.0, 4.0], [-0.318, 0.424])]:
        np.testing.assert_allclose(accept(Goal(position, "base"), metadata, True)[0], expected, rtol=1e-12)


def test_a_goal_too_far_to_tell_is_rejected(metadata):
    for position in ([1.7e308, 1.7e308], [1.7e308, -1.7e308]):
        assert rejection(Goal(position, "base"), metadata, True) == "unreachable"


def test_a_goal_at_the_base_has_no_direction_and_cannot_be_moved(metadata):
    assert rejection(Goal([0.0, 0.0], "base"), metadata, True) == "unreachable"


@given(st.tuples(st.floats(), st.floats()))
def test_what_is_taken_lies_on_the_ring(metadata, position):
    for project in (True, False):
        try:
            taken, _ = accept(Goal(position, "base"), metadata, project)
        except GoalError:
            continue
        assert 0.3 - 1.1e-6 <= math.hypot(*taken) <= 0.53 + 1.1e-6


@pytest.fixture(scope="module")
def of_poses(metadata):
    """The same policy's metadata, as if its goals were poses within a metre."""
    labels = ("x", "y", "z", "qx", "qy", "qz", "qw")
    goal = Signal("goal", Quantity.POSE, (7,), labels=labels, frame="base")
    region = Box((-1.0,) * 7, (1.0,) * 7)
    return dataclasses.replace(metadata, inputs=(*metadata.inputs[:2], goal), region=region)


TURN = np.array([0.5, -0.5, 0.5, -0.5])


@pytest.mark.parametrize("factor", [1.0, -1.0, 1.05])
def test_a_quaternion_is_normalized_and_its_opposite_is_the_same_goal(of_poses, factor):
    taken, moved = accept(Goal([0.1, 0.2, 0.3, *(factor * TURN)], "base"), of_poses, False)
    np.testing.assert_allclose(taken, [0.1, 0.2, 0.3, *-TURN])
    assert not moved


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.5], [9.0, 0.0, 0.0, 0.0]])
def test_a_quaternion_that_is_no_rotation_is_rejected_with_its_length(of_poses, turn):
    goal = Goal([0.1, 0.2, 0.3, *turn], "base")
    assert rejection(goal, of_poses) == "not a rotation"
    with pytest.raises(GoalError, match=f"its quaternion has the length {np.linalg.norm(turn):.3f}, not 1"):
        accept(goal, of_poses, False)


def test_a_position_is_no_pose(of_poses):
    assert rejection(Goal([0.1, 0.2, 0.3], "base"), of_poses) == "malformed"


@pytest.mark.fault("goal inside the robot's base, the floor or a box; quaternion that is no rotation")
def test_a_goal_inside_of_something_is_rejected_by_its_name(of_poses):
    goal = Goal([0.1, 0.2, 0.3, *TURN], "base")
    with pytest.raises(GoalError, match="goal rejected: it lies in 'shelf'"):
        accept(goal, of_poses, False, lambda point: "shelf" if np.allclose(point, [0.1, 0.2, 0.3]) else None)
