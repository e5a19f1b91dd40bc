"""What an action means to a robot: one law, in torch for a policy and in arrays for a simulation."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from physai.robots import JointCommand, RobotConfig, RobotSpec
from physai.robots.command import LEAD
from tests.composed import env_config

DT = 0.02
LIMIT = np.array([2.0, 0.5])
CONFIG = env_config("reacher").robot


def command_of(kind: str) -> JointCommand:
    changes = {"command": kind, "command_limit": LIMIT.tolist()}
    return JointCommand(RobotSpec.from_config(RobotConfig.model_validate({**CONFIG.model_dump(), **changes})), DT)


VELOCITY, POSITION = command_of("joint_velocity"), command_of("joint_position")
BOTH = pytest.mark.parametrize("command", [VELOCITY, POSITION], ids=["velocity", "position"])


def pairs(low, high):
    return st.tuples(*[st.floats(low, high, width=32)] * 2)


def rows(*pairs):
    return [np.array([pair]) for pair in pairs]


@BOTH
@given(action=pairs(-1, 1), position=pairs(-10, 10), last=pairs(-10, 10))
def test_a_policy_commands_what_a_simulation_does(command, action, position, last):
    arrays = rows(action, position, last)
    found = command(*(torch.from_numpy(array).float() for array in arrays))
    np.testing.assert_allclose(found.numpy(), command.of_arrays(*arrays), rtol=0, atol=2e-6)


@BOTH
def test_the_scripted_law_equals_eager_bit_for_bit(command):
    scripted = torch.jit.script(command)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        given = [3 * torch.randn(5, 2, generator=generator) for _ in range(3)]
        assert torch.equal(scripted(*given), command(*given))


def test_a_velocity_command_is_the_action_s_share_of_each_joint_s_limit_whatever_the_robot_does():
    wild = np.full((3, 2), np.nan)
    action = np.array([[1.0, 1.0], [0.5, -0.5], [0.0, 0.0]])
    np.testing.assert_array_equal(VELOCITY.of_arrays(action, wild, wild), action * LIMIT)


def test_a_position_command_moves_the_last_one_on_by_one_control_period_at_that_speed():
    last = np.array([[0.3, -0.2]])
    found = POSITION.of_arrays(np.array([[1.0, -0.5]]), last, last)
    np.testing.assert_allclose(found, last + DT * LIMIT * [1.0, -0.5], rtol=0, atol=1e-12)


def test_no_action_repeats_the_last_position_and_stops_a_velocity():
    still, last, position = np.zeros((1, 2)), np.array([[0.3, -0.2]]), np.array([[0.28, -0.19]])
    np.testing.assert_array_equal(POSITION.of_arrays(still, position, last), last)
    np.testing.assert_array_equal(VELOCITY.of_arrays(still, position, last), still)


def test_a_position_command_runs_no_further_ahead_of_a_stuck_joint_than_its_lead():
    stuck = np.array([[0.5, -1.0]])
    command = stuck
    for _ in range(100):
        command = POSITION.of_arrays(np.array([[1.0, -1.0]]), stuck, command)
    np.testing.assert_allclose(command, stuck + LEAD * LIMIT * [1.0, -1.0], rtol=0, atol=1e-12)
    back = POSITION.of_arrays(np.array([[-1.0, 1.0]]), stuck, command)
    np.testing.assert_allclose(back, command - DT * LIMIT * [1.0, -1.0], rtol=0, atol=1e-12)


def test_a_position_command_stays_within_the_limits_of_the_joint_and_turns_a_continuous_one_without_end():
    command = position = np.array([[0.0, 2.55]])
    for _ in range(2000):
        command = position = POSITION.of_arrays(np.ones((1, 2)), position, command)
    np.testing.assert_allclose(command, [[2000 * DT * LIMIT[0], 2.6]], rtol=1e-9)


@given(action=pairs(-1e9, 1e9), position=pairs(-10, 10), last=pairs(-10, 10))
def test_actions_beyond_their_range_count_as_its_ends(action, position, last):
    wild, position, last = rows(action, position, last)
    for command in (VELOCITY, POSITION):
        expected = command.of_arrays(np.clip(wild, -1, 1), position, last)
        np.testing.assert_array_equal(command.of_arrays(wild, position, last), expected)


@BOTH
@given(action=pairs(-1, 1), last=pairs(-2, 2))
def test_the_action_is_found_again_in_its_command(command, action, last):
    wanted, position = (torch.tensor([pair]) for pair in (action, last))
    found = command.action(command(wanted, position, position), position)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
