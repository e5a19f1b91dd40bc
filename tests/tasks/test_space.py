"""Goals in space: positions and poses, where they are drawn, and what arms see of them."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.physics import RobotState
from physai.robots import quaternion_matrix
from physai.signals import Quantity
from physai.tasks import Step

SPACE = ["panda_reach", "panda_pose", "kuka7_reach", "xarm_reach"]


@pytest.fixture(scope="module")
def simulate(env_config):
    made = {}

    def make(name: str, *overrides: str) -> Simulation:
        key = name, *overrides
        if key not in made:
            made[key] = Simulation(env_config(name, "physics=mujoco", *overrides), 8, seed=0)
            made[key].reset()
        return made[key]

    yield make
    for simulation in made.values():
        simulation.close()


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def inside_of_limits(simulation, rows, seed=0):
    """Joint positions [rows, n], rad."""
    low, high = simulation.spec.position_limit.T
    return np.random.default_rng(seed).uniform(low, high, (rows, len(low)))


def state_at(joint_position):
    return RobotState(joint_position, np.zeros_like(joint_position))


def poses(simulation, joint_position):
    """Where the end effector is: positions [N, 3] and rotation matrices [N, 3, 3]."""
    q = torch.from_numpy(joint_position).float()
    linear, rotation, _ = simulation.kinematics.linearize_pose(torch.cos(q), torch.sin(q))
    return linear[:, :, -1].double().numpy(), rotation.double().numpy()


@pytest.mark.slow
@pytest.mark.parametrize("name", SPACE)
def test_what_is_seen_is_within_its_bounds_and_scripts_bit_for_bit(simulate, name):
    task = simulate(name).task
    q = inside_of_limits(simulate(name), 50)
    goal = task.sample_goal(50, generator())
    sensed = [torch.from_numpy(array).float() for array in (q, np.ones_like(q), goal)]
    observation, features = task.module(*sensed)
    low, high = task.observation.bounds
    assert ((observation.numpy() >= low) & (observation.numpy() <= high)).all()
    assert torch.isfinite(features).all()
    scripted = torch.jit.script(task.module)
    assert all(torch.equal(*pair) for pair in zip(scripted(*sensed), (observation, features), strict=True))
    assert torch.equal(scripted.error(sensed[0], sensed[2]), task.module.error(sensed[0], sensed[2]))


def test_the_error_of_a_position_is_the_distance(simulate):
    simulation = simulate("panda_reach")
    q = inside_of_limits(simulation, 20)
    position, _ = poses(simulation, q)
    off = np.random.default_rng(1).normal(size=(20, 3))
    error = simulation.task.error(state_at(q), position + off)
    np.testing.assert_allclose(error[:, 0], np.linalg.norm(off, axis=1), rtol=1e-4)


@pytest.mark.slow
def test_the_errors_of_a_pose_are_distance_and_angle_whichever_sign_its_quaternion_has(simulate):
    simulation = simulate("panda_pose")
    q = inside_of_limits(simulation, 20)
    position, rotation = poses(simulation, q)
    turn = Rotation.random(20, random_state=0)
    quaternion = (turn * Rotation.from_matrix(rotation)).as_quat()
    for sign in (1, -1):
        goal = np.concatenate([position + np.array([0.0, 0.1, 0.0]), sign * quaternion], axis=1)
        error = simulation.task.error(state_at(q), goal)
        np.testing.assert_allclose(error[:, 0], 0.1, rtol=1e-3)
        np.testing.assert_allclose(error[:, 1], turn.magnitude(), atol=2e-3)
        seen = [torch.from_numpy(array).float() for array in (q, np.zeros_like(q), goal)]
        features = simulation.task.module(*seen)
        if sign == 1:
            first = features
    assert all(torch.equal(*pair) for pair in zip(first, features, strict=True))


@pytest.mark.parametrize("name", ["panda_reach", "panda_pose"])
def test_what_is_said_to_shorten_the_errors_does(simulate, name):
    """A step along Jᵀe, and for poses along J_ωᵀr, brings the end effector nearer."""
    simulation = simulate(name)
    task, n = simulation.task, len(simulation.spec.joints)
    q, goal = inside_of_limits(simulation, 50), task.sample_goal(50, generator(1))
    _, features = task.module(*(torch.from_numpy(array).float() for array in (q, np.zeros_like(q), goal)))
    size, end = len(task.module.coarse), features.shape[1] - task.module.suggests * n
    errors = features[:, end - 2 * size : end - size] / task.module.coarse
    before = task.error(state_at(q), goal)
    for column, joints in enumerate(errors[:, 3 * len(before[0]) :].split(n, dim=1)):
        step = joints.double().numpy()
        step *= 1e-3 / np.linalg.norm(step, axis=1, keepdims=True)
        assert (task.error(state_at(q + step), goal)[:, column] < before[:, column]).mean() > 0.95


@pytest.mark.slow
@torch.no_grad()
def test_the_suggested_way_leads_from_goal_to_goal_and_seldom_touches_anything(simulate):
    simulation = simulate("panda_pose")
    task, limit = simulation.task, torch.from_numpy(simulation.spec.command_limit)
    goals = torch.from_numpy(task.sample_goal(401, generator())).float()
    configurations = task.module.inverse(goals[:, :3], quaternion_matrix(goals[:, 3:])).double()
    q, there = configurations[:-1], configurations[1:]
    straight = torch.stack([q + share * (there - q) for share in torch.linspace(0, 1, 50)])
    touched = np.zeros(400, bool)
    for _ in range(300):
        _, features = task.module(q.float(), torch.zeros(400, 7), goals[1:])
        q = q + 0.02 * limit * torch.tanh(features[:, -7:].double())
        touched |= task.clearance(q.numpy()) <= 0
    assert (task.error(state_at(q.numpy()), goals[1:].numpy()) < simulation.tolerance).all(axis=1).mean() > 0.98
    touched_straight = task.clearance(straight.flatten(0, 1).numpy()).reshape(50, 400).min(axis=0) <= 0
    clear = task.clearance(configurations.numpy()) > 0
    on_the_way = clear[:-1] & clear[1:]
    assert 2 * (touched & on_the_way).sum() <= (touched_straight & on_the_way).sum()


@pytest.mark.parametrize("name", SPACE)
def test_goals_are_drawn_in_the_region_from_the_generator_alone(simulate, name):
    task = simulate(name).task
    goals = task.sample_goal(200, generator())
    assert goals.shape == (200, *task.goal.shape)
    assert all(map(task.region.contains, goals))
    np.testing.assert_array_equal(goals, task.sample_goal(200, generator()))
    assert len(np.unique(goals, axis=0)) == 200
    low, high = (bound[:3] for bound in task.region.bounds)
    assert (np.ptp(goals[:, :3], axis=0) > 0.8 * (high - low)).all()  # all over it


def test_poses_are_drawn_that_the_arm_takes_also_far_from_home(simulate):
    task = simulate("panda_pose").task
    goals = task.sample_goal(500, generator())
    np.testing.assert_allclose(np.linalg.norm(goals[:, 3:], axis=1), 1.0, atol=1e-6)
    home = poses(simulate("panda_pose"), simulate("panda_pose").spec.home[None])[1]
    away = (Rotation.from_quat(goals[:, 3:]) * Rotation.from_matrix(home).inv()).magnitude()
    assert np.quantile(away, 0.9) > 2.0  # rad


def test_goals_are_those_that_one_finds_without_a_look_at_where_the_tip_is_first(simulate, monkeypatch):
    goals = simulate("panda_pose").task._goals
    quick = [goals.sample(rows, generator(rows)) for rows in (1, 2, 200)]
    monkeypatch.setattr(goals, "_near", lambda configurations: np.ones(len(configurations), bool))
    for found in quick:
        np.testing.assert_array_equal(found, goals.sample(len(found), generator(len(found))))


def test_a_draw_of_which_nothing_leads_near_the_region_is_passed_over(simulate, monkeypatch):
    goals, made, seen = simulate("panda_pose").task._goals, [], []
    near, of_those = goals._near, goals._goals
    monkeypatch.setattr("physai.tasks.reachable._TRIES", 16)
    monkeypatch.setattr(goals, "_near", lambda drawn: made.append(near(drawn)) or made[-1])
    monkeypatch.setattr(goals, "_goals", lambda drawn: seen.append(len(drawn)) or of_those(drawn))
    for seed in range(20):
        goals.sample(1, generator(seed))
    assert 0 in map(np.count_nonzero, made)
    assert 0 not in seen


def test_a_policy_file_names_examples_of_goals_that_the_arm_reaches(simulate):
    region = simulate("panda_pose").task.region
    assert (region.kind, len(region.examples) % 7, region.sample(3, generator()).shape) == ("reachable", 0, (3, 7))


def test_success_that_ends_nothing_pays_in_each_step_of_it(simulate):
    simulation = simulate("panda_reach")
    simulation.reset()
    position, _ = poses(simulation, simulation.state.joint_position)
    simulation.goal = position.copy()
    for _ in range(3):
        _, terminated, truncated = simulation.step(np.zeros((8, 7)))
        assert simulation.success.all()
        assert not (terminated | truncated).any()
    paid = simulation.episode_rewards[:, simulation.reward_terms.index("success")]
    np.testing.assert_allclose(paid, 3 * 0.2, rtol=1e-6)


def test_a_posture_away_from_home_costs_by_the_joint_s_range(simulate):
    simulation = simulate("panda_reach")
    simulation.reset()
    simulation.step(np.zeros((8, 7)))
    away = (simulation.state.joint_position - simulation.spec.home) / (
        np.ptp(simulation.spec.position_limit, axis=1) / 2
    )
    paid = simulation.episode_rewards[:, simulation.reward_terms.index("posture")]
    np.testing.assert_allclose(paid, -0.3 * (away**2).mean(axis=1), rtol=1e-5)


def test_each_joint_near_a_limit_costs_by_how_near_it_is(simulate):
    task = simulate("panda_reach").task
    low, high = simulate("panda_reach").spec.position_limit.T
    at = np.tile((low + high) / 2, (4, 1))
    at[1, 4], at[2, 4], at[3, [0, 4]] = 0.95 * low[4], high[4] + 0.01, (low[0], high[4])
    one = np.zeros((4, 7))
    judged = np.zeros((4, 1)), np.zeros(4), None, *np.zeros((2, 4))
    step = Step(RobotState(at, one), one, one, one, np.zeros((4, 3)), *judged)
    np.testing.assert_allclose(
        task.rewards(step, np.zeros(4, bool))["joint_limits"], [0.0, -0.15, -0.3, -0.6], rtol=1e-5
    )


def test_an_episode_that_would_begin_in_a_collision_begins_at_home(simulate):
    simulation = simulate("panda_reach", "env.start.spread=[2.8,1.7,2.8,1.4,2.8,1.8,2.8]", "env.start.carried_over=0.0")
    at_home = 0
    for _ in range(10):
        simulation.reset()
        assert (simulation.task.clearance(simulation.state.joint_position) > 0).all()
        at_home += (simulation.state.joint_position == simulation.spec.home).all(axis=1).sum()
    assert 10 < at_home < 70


def test_a_collision_ends_the_episode_and_costs(simulate):
    simulation = simulate("panda_reach")
    simulation.reset()
    samples = simulation.spec.sample(500, np.random.default_rng(0))
    touching = samples[simulation.task.clearance(samples) <= 0][:8]
    simulation.physics.reset(np.arange(8), state_at(touching))
    simulation.state = simulation.physics.robot_state()
    _, terminated, _ = simulation.step(np.zeros((8, 7)))
    assert terminated.all()
    assert not simulation.success.any()
    paid = simulation.episode_rewards[:, simulation.reward_terms.index("collision")]
    np.testing.assert_allclose(paid, -20.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["panda_reach", "env.task.region.high=[1.5,0.4,0.7]"], r"reaches 1\.\d\d m"),
        (["panda_reach", "env.task.region.high=[0.1,0.4,0.7]"], "a box needs lower and upper bounds"),
        (["panda_reach", "env.task.region.low=[0.3,0.1]", "env.task.region.high=[0.5,0.2]"], "Ball of three numbers"),
        (
            ["panda_pose", "env.task.region.low=[3,3,3]", "env.task.region.high=[4,4,4]"],
            "only 0 lead, without touching anything, into the box",
        ),
        (["panda_reach", "env.task.floor=0.4"], "env.robot.home: 'panda_link1' and 'floor' overlap there by"),
    ],
)
def test_regions_that_make_no_sense_are_one_line(env_config, overrides, line):
    name, *rest = overrides
    with pytest.raises(UserError, match=line):
        Simulation(env_config(name, "physics=mujoco", *rest), 1, seed=0)


def test_a_ball_is_a_region_too(simulate):
    ball = "{_target_: physai.signals.Ball, center: [0.5, 0.0, 0.4], radius: 0.2}"
    task = simulate("panda_reach", "~env.task.region", f"+env.task.region={ball}").task
    goals = task.sample_goal(500, generator())
    assert task.goal.quantity is Quantity.POSITION
    assert (np.linalg.norm(goals - [0.5, 0.0, 0.4], axis=1) <= 0.2).all()
