"""From actions to commands: the same in arrays as in the module that policies carry along."""

import numpy as np
import pytest
import torch

from physai.robots import JointCommand, RobotSpec
from physai.robots.command import LEAD
from physai.signals import Quantity

DT = 0.02


@pytest.fixture(scope="module")
def spec(reacher):
    """The planar arm: its first joint turns without end, its second within 2.6 rad."""

    def make(command, limit=(2.0, 1.0)):
        config = reacher.robot.model_copy(update={"command": command, "command_limit": list(limit)})
        return RobotSpec.from_config(config)

    return make


def test_a_velocity_command_is_a_share_of_each_joint_s_own_limit_and_is_clamped(spec):
    command = JointCommand(spec("joint_velocity"), DT)
    action = np.array([[0.5, 0.5], [3.0, -7.0]])
    nowhere = np.full((2, 2), np.nan)  # neither where it is nor what it was told counts
    np.testing.assert_allclose(command.of_arrays(action, nowhere, nowhere), [[1.0, 0.5], [2.0, -1.0]])


def test_a_position_command_moves_the_last_one_on_by_a_period_s_way(spec):
    command = JointCommand(spec("joint_position"), DT)
    position, last = np.array([[1.0, 1.0]]), np.array([[1.1, 0.9]])
    np.testing.assert_allclose(command.of_arrays(np.array([[1.0, -0.5]]), position, last), [[1.14, 0.89]])


def test_a_position_command_stays_near_the_joint_and_within_its_limits(spec):
    command = JointCommand(spec("joint_position"), DT)
    far = command.of_arrays(np.zeros((1, 2)), np.array([[0.0, 0.0]]), np.array([[9.0, -9.0]]))
    np.testing.assert_allclose(far, [[2.0 * LEAD, -1.0 * LEAD]])
    edge = command.of_arrays(np.ones((1, 2)), np.array([[100.0, 2.59]]), np.array([[100.0, 2.59]]))
    np.testing.assert_allclose(edge, [[100.04, 2.6]])  # the first joint has no limit


@pytest.mark.parametrize("quantity", ["joint_velocity", "joint_position"])
def test_the_module_does_what_arrays_do_and_scripts(spec, quantity):
    command = JointCommand(spec(quantity), DT)
    scripted = torch.jit.script(command)
    random = np.random.default_rng(0)
    arrays = [random.uniform(-low, low, (500, 2)).astype(np.float32) for low in (1.0, 2.7, 3.0)]
    tensors = [torch.from_numpy(array) for array in arrays]
    expected = command.of_arrays(*(array.astype(float) for array in arrays))
    np.testing.assert_allclose(command(*tensors).numpy(), expected, rtol=0, atol=1e-6)
    assert torch.equal(scripted(*tensors), command(*tensors))


@pytest.mark.parametrize("quantity", ["joint_velocity", "joint_position"])
def test_an_action_is_found_again_in_its_command(spec, quantity):
    command = JointCommand(spec(quantity), DT)
    action, position = torch.tensor([[0.3, -0.8]]), torch.tensor([[0.5, 0.1]])
    told = command(action, position, position)
    torch.testing.assert_close(command.action(told, position), action, rtol=0, atol=1e-4)


def test_a_robot_says_what_drives_it_within_which_bounds(spec):
    velocity, position = spec("joint_velocity").joint_command, spec("joint_position").joint_command
    assert (velocity.name, velocity.quantity, velocity.unit) == (
        "joint_velocity_command",
        Quantity.JOINT_VELOCITY,
        "rad/s",
    )
    assert (velocity.low, velocity.high) == ((-2.0, -1.0), (2.0, 1.0))
    assert (position.name, position.labels) == ("joint_position_command", ("joint1", "joint2"))
    assert position.bounds[1].tolist() == [np.inf, 2.6]
