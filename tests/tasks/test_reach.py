import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.physics import RobotState
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Quantity, Ring, Tolerance
from physai.tasks import Reach, Step

RADII = [0.3, 0.53]


def reach(config, goal_radius=RADII) -> Reach:
    """The task of an env's robot."""
    spec = RobotSpec.from_config(config.robot)
    rest = {"tolerance": 0.05, "success_reward": 10.0, "success_ends": True, "settle": 0.0, "max_steps": 200}
    rest |= dict.fromkeys(("smoothness", "posture", "joint_limits", "collision"), 0.0)
    rest |= {"safe_distance": 0.01, "floor": None, "boxes": []}
    return Reach(spec, ForwardKinematics(spec), goal_radius, **rest)


@pytest.fixture
def task(reacher):
    return reach(reacher)


@pytest.fixture
def simulate(env_config):
    """Make a simulation that is closed after the test."""
    made = []

    def make(*overrides: str, name: str = "reacher", robots: int = 4) -> Simulation:
        made.append(Simulation(env_config(name, *overrides), robots, seed=0))
        made[-1].reset()
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


@pytest.fixture(scope="module")
def turning(reacher):
    """What an arm whose first joint is continuous, and whose second is not, observes."""
    return reach(reacher).module


def end_effector(simulation):
    """Where the end effectors are in the plane, m, [N, 2]."""
    return simulation.kinematics(torch.from_numpy(simulation.state.joint_position).float())[:, :2].double().numpy()


def put_goal_at_the_tip(simulation, row):
    simulation.goal = simulation.goal.copy()
    simulation.goal[row] = end_effector(simulation)[row]


def judged(task, distance):
    """A step that led robots to these distances, m, of the goal."""
    error = np.reshape(distance, (-1, 1))
    rows = len(error)
    state = RobotState(np.zeros((rows, 2)), np.zeros((rows, 2)))
    held = 0.02 * (error[:, 0] < task.tolerances[0].value)
    step = Step(state, *np.zeros((4, rows, 2)), error, held, None, *np.zeros((2, rows)))
    success = task.success(step)
    return success, task.terminated(step, success), task.rewards(step, success)


def test_the_kuka_s_goals_lie_between_30_and_60_cm(simulate):
    simulation = simulate(name="kuka_reacher", robots=1)
    radius = np.linalg.norm(simulation.task.region.sample(1000, torch.Generator().manual_seed(0)), axis=1)
    assert 0.3 - 1e-6 <= radius.min() < 0.31
    assert 0.59 < radius.max() <= 0.6 + 1e-6


def test_it_declares_its_goal_its_region_and_what_it_counts_as_near(task, reacher):
    assert task.region == Ring(0.3, 0.53)
    assert (task.goal.name, task.goal.quantity, task.goal.shape) == ("goal", Quantity.POSITION, (2,))
    assert (task.goal.labels, task.goal.frame, task.goal.unit) == (("x", "y"), "base", "m")
    np.testing.assert_array_equal(task.goal.bounds, [[-0.53, -0.53], [0.53, 0.53]])
    assert task.tolerances == (Tolerance("distance", "m", 0.05),)


def test_distance_counts_in_the_plane_only(kuka_reacher):
    kinematics = ForwardKinematics(RobotSpec.from_config(kuka_reacher.robot))
    q = torch.tensor([[0.0, 0.5], [1.0, -0.8]])
    end_effector = kinematics(q)
    assert (end_effector[:, 2] > 0.5).all()
    goal = end_effector[:, :2] + torch.tensor([[0.3, 0.4], [-0.6, 0.8]])
    task = reach(kuka_reacher)
    torch.testing.assert_close(task.module.error(q, goal), torch.tensor([[0.5], [1.0]]))
    state = RobotState(q.double().numpy(), np.zeros((2, 2)))
    np.testing.assert_allclose(task.error(state, goal.double().numpy()), [[0.5], [1.0]], rtol=0, atol=1e-6)


def test_rewards_and_success_are_the_numbers_of_the_contract(task):
    distance = np.array([0.0, 0.03, 0.0499, 0.05, 0.2, 1.08])
    success, terminated, rewards = judged(task, distance)
    assert success.tolist() == terminated.tolist() == [True, True, True, False, False, False]
    assert list(rewards) == ["distance", "success"]
    np.testing.assert_array_equal(rewards["distance"], -distance)
    np.testing.assert_array_equal(rewards["success"], [10.0, 10.0, 10.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(sum(rewards.values()), [10.0, 9.97, 9.9501, -0.05, -0.2, -1.08])


@pytest.fixture
def observe(env_config):
    """Make the observation module of an env's robot."""

    def make(name="reacher"):
        return reach(env_config(name), [0.3, 0.5]).module

    return make


def test_the_observation_is_positions_velocities_tip_and_goal(observe):
    module = observe()
    q, qd, goal = torch.tensor([[0.0, math.pi / 2]]), torch.tensor([[0.5, -1.0]]), torch.tensor([[0.1, 0.2]])
    observation, features = module(q, qd, goal)
    expected = torch.tensor([[0.0, math.pi / 2, 0.5, -1.0, 0.30, 0.25, 0.1, 0.2]])
    torch.testing.assert_close(observation, expected)
    assert features.shape == (1, 12)


@given(st.floats(-math.pi, math.pi), st.integers(-50, 50), st.floats(-2.6, 2.6))
def test_an_arm_that_has_turned_around_looks_like_one_that_has_not(turning, angle, turns, elbow):
    q = torch.tensor([[angle, elbow], [angle + 2 * math.pi * turns, elbow]])
    rest = torch.tensor([[0.5, -1.0]] * 2), torch.tensor([[0.1, 0.2]] * 2)
    observation, features = turning(q, *rest)
    assert observation[:, 0].abs().max() <= math.pi + 1e-6
    observation[:, 0] = torch.remainder(observation[:, 0] - angle + 1.0, 2 * math.pi)  # both ends are the same
    torch.testing.assert_close(observation[0], observation[1], rtol=0, atol=2e-4)
    torch.testing.assert_close(features[0], features[1], rtol=0, atol=1e-2)  # some of them count in tolerances


def test_positions_of_joints_with_limits_are_observed_as_they_are(observe):
    rest = torch.zeros(1, 2), torch.tensor([[0.1, 0.2]])
    assert observe()(torch.tensor([[4.0, 4.0]]), *rest)[0][0, :2].tolist() == pytest.approx([4.0 - 2 * math.pi, 4.0])
    assert observe("kuka_reacher")(torch.tensor([[4.0, -5.0]]), *rest)[0][0, :2].tolist() == [4.0, -5.0]


def test_observations_have_finite_bounds_that_hold_after_many_turns(task, reacher):
    low, high = task.observation.bounds
    assert low.shape == high.shape == (8,)
    assert np.isfinite([low, high]).all()
    q = torch.stack([torch.linspace(-1000, 1000, 5000), torch.linspace(-2.6, 2.6, 5000)], dim=1)
    goal = torch.from_numpy(task.region.sample(5000, torch.Generator()))
    observation = task.module(q, torch.zeros_like(q), goal)[0].numpy()
    assert ((low <= observation) & (observation <= high)).all()
    spec = RobotSpec.from_config(reacher.robot)
    assert spec.position_limit[0].tolist() == [-math.inf, math.inf]  # what it says of the robot is left alone


def test_the_step_that_reaches_the_goal_and_runs_out_of_time_only_terminates(simulate):
    simulation = simulate("env.task.max_steps=1")
    simulation.goal = np.full((4, 2), 9.0, np.float32)
    put_goal_at_the_tip(simulation, 2)
    reward, terminated, truncated = simulation.step(np.zeros((4, 2)))
    assert terminated[:, 0].tolist() == [False, False, True, False]
    assert truncated[:, 0].tolist() == [True, True, False, True]
    assert reward[2] > 9.9
    assert (reward[[0, 1, 3]] < -1).all()


def test_episodes_that_miss_the_goal_are_truncated_after_exactly_200_steps(simulate):
    simulation = simulate()
    simulation.goal = np.full((4, 2), 9.0, np.float32)
    late = np.array([False, True, False, False])
    for step in range(1, 241):
        _, terminated, truncated = simulation.step(np.zeros((4, 2)))
        assert not terminated.any()
        expected = [step >= 200, step >= 240, step >= 200, step >= 200]
        assert truncated[:, 0].tolist() == expected
        if step == 40:
            simulation.reset(late)
            simulation.goal = np.full((4, 2), 9.0, np.float32)
    assert simulation.episode_length[:, 0].tolist() == [240, 200, 240, 240]


def test_return_and_length_sum_up_since_the_row_s_own_reset(simulate):
    simulation = simulate()
    rewards = []
    for step in range(10):
        rewards.append(simulation.step(np.ones((4, 2)))[0])
        if step == 5:
            simulation.reset(np.array([True, False, False, False]))
    sums = np.stack([sum(rewards[6:])[0], *sum(rewards)[1:]])
    assert simulation.reward_terms == ("distance", "success")
    np.testing.assert_allclose(simulation.episode_rewards.sum(axis=1, keepdims=True), sums, rtol=1e-5)
    assert simulation.episode_length[:, 0].tolist() == [4, 10, 10, 10]


def test_an_action_is_a_share_of_the_command_limit_and_is_clamped(simulate):
    simulation = simulate("env.start.spread=[0,0]")
    action = np.array([[0.5, 0.0], [1.0, 0.0], [3.0, 0.0], [-7.0, 0.0]])
    for _ in range(30):
        simulation.step(action)
    np.testing.assert_allclose(simulation.state.joint_velocity[:, 0], [1.0, 2.0, 2.0, -2.0], rtol=0, atol=0.02)


def put(simulation, joint_position, joint_velocity, goal):
    """Bring all robots into a state; numbers that a float32 can hold, for that is what a policy gets."""
    simulation.goal = np.array(goal, np.float32).astype(float)
    state = RobotState(*(np.array(value, np.float32).astype(float) for value in (joint_position, joint_velocity)))
    simulation.physics.reset(np.arange(simulation.num_envs), state)
    simulation.restore(simulation.snapshot())


def what_a_policy_sees(simulation):
    sensed = simulation.state.joint_position, simulation.state.joint_velocity, simulation.goal
    return simulation.task.module(*(torch.from_numpy(value).float() for value in sensed))[0].numpy()


def assert_same_observation(found, expected, continuous):
    """Equal to 1e-6; the two ends of half a turn are the same."""
    difference = found.astype(float) - expected
    turns = difference[..., : len(continuous)][..., continuous]
    difference[..., : len(continuous)][..., continuous] = (turns + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(difference).max() <= 1e-6


@pytest.fixture(scope="module")
def both(env_config):
    """Four robots of each kind."""
    made = [Simulation(env_config(name), 4, seed=0) for name in ("reacher", "kuka_reacher")]
    yield made
    for simulation in made:
        simulation.close()


def rows_of_two(low, high):
    return st.lists(st.tuples(*[st.floats(low, high, width=32)] * 2), min_size=4, max_size=4)


@pytest.mark.slow
@given(rows_of_two(-100, 100), rows_of_two(-3, 3), rows_of_two(-1, 1))
def test_what_a_simulation_observes_is_what_a_policy_sees(both, joint_position, joint_velocity, goal):
    for simulation in both:
        put(simulation, joint_position, joint_velocity, goal)
        found = simulation.observe()
        assert found.dtype == np.float32
        assert_same_observation(found, what_a_policy_sees(simulation), simulation.spec.continuous)
        pair = simulation.state.joint_position, simulation.goal
        error = simulation.task.module.error(*(torch.from_numpy(value).float() for value in pair))
        np.testing.assert_allclose(simulation.error, error.numpy(), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env.task.goal_radius=[0.5,0.3]", ["env.task.goal_radius", "0.5", "0.3"]),
        ("env.task.goal_radius=[0.3,0.9]", ["env.task.goal_radius", "0.9", "reach", "planar_arm"]),
        ("env.start.spread=[1.0,1.0,1.0]", ["env.start.spread", "2 joints"]),
        ("env.robot.command_limit=[2.0,3.0]", ["command_limit", "3", "joint2", "2.5"]),
    ],
)
def test_a_task_that_the_robot_cannot_do_is_refused(env_config, override, words):
    with pytest.raises(UserError) as caught:
        Simulation(env_config("reacher", override), 1, seed=0)
    for word in words:
        assert word in str(caught.value)


def held_for(task, seconds, action=0.0):
    """A step of a robot that has been at its goal for so long, and changed its action by so much."""
    state = RobotState(np.zeros((1, 2)), np.zeros((1, 2)))
    still, changed = np.zeros((1, 2)), np.full((1, 2), action)
    return Step(state, still, changed, still, still, np.zeros((1, 1)), np.array([seconds]), None, *np.zeros((2, 1)))


def test_with_settle_success_is_to_have_stayed(simulate):
    task = simulate("env.task.settle=0.5", robots=1).task
    for seconds, success in ((0.02, False), (0.48, False), (0.5, True), (25 * 0.02, True), (1.0, True)):
        step = held_for(task, seconds)
        assert task.success(step) == success
        assert task.terminated(step, task.success(step)) == success


def test_smoothness_costs_the_square_of_what_the_action_changes_by(simulate):
    plain, smooth = (simulate(f"env.task.smoothness={value}", robots=1).task for value in (0.0, 0.3))
    step = held_for(smooth, 0.0, action=0.5)
    assert set(plain.rewards(step, np.zeros(1, bool))) == {"distance", "success"}
    assert smooth.rewards(step, np.zeros(1, bool))["smoothness"] == pytest.approx(-0.075)
