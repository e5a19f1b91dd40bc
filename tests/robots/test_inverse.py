import numpy as np
import pytest
import torch

from physai.envs.simulation import Simulation
from physai.physics import RobotState
from physai.robots import quaternion_matrix


@pytest.fixture(scope="module")
def simulation(env_config):
    made = Simulation(env_config("panda_pose", "physics=mujoco"), 1, seed=0)
    yield made
    made.close()


@pytest.fixture(scope="module")
def goals(simulation):
    return torch.from_numpy(simulation.task.sample_goal(500, torch.Generator().manual_seed(5))).float()


def solved(simulation, goals):
    """Configurations [N, n], rad."""
    return simulation.task.module.inverse(goals[:, :3], quaternion_matrix(goals[:, 3:]))


@pytest.mark.slow
def test_nearly_all_poses_are_met_within_the_joints_limits(simulation, goals):
    found = solved(simulation, goals).double().numpy()
    error = simulation.task.error(RobotState(found, np.zeros_like(found)), goals.double().numpy())
    assert (error < [0.05, 0.2618]).all(axis=1).mean() > 0.95
    assert (error < [0.005, 0.03]).all(axis=1).mean() > 0.7
    low, high = simulation.spec.position_limit.T
    assert ((found > low) & (found < high)).all()


@pytest.mark.slow
def test_nearly_all_of_its_configurations_touch_nothing(simulation, goals):
    assert (simulation.task.clearance(solved(simulation, goals).double().numpy()) > 0).mean() > 0.98


def test_a_pose_has_the_same_solution_whatever_is_asked_beside_it_and_whatever_sign_its_quaternion_has(
    simulation, goals
):
    together, other_sign = solved(simulation, goals), goals * torch.tensor([1.0] * 3 + [-1.0] * 4)
    torch.testing.assert_close(solved(simulation, goals[7:8]), together[7:8], atol=1e-3, rtol=0)
    torch.testing.assert_close(solved(simulation, other_sign), together)


def test_least_squares_solve_what_numpy_s_do(simulation):
    rng = np.random.default_rng(0)
    jacobian, error = 0.3 * rng.normal(size=(50, 6, 7)), 0.3 * rng.normal(size=(50, 6))  # as of an arm
    inverse = simulation.task.module.inverse
    found = inverse.least_squares(torch.from_numpy(jacobian).float(), torch.from_numpy(error).float()).numpy()
    damping = inverse.damping.double().numpy()
    square = jacobian @ jacobian.transpose(0, 2, 1) + damping
    expected = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[:, :, None]))[:, :, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
