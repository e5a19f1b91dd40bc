"""An engine of 49 lines (tests/physics/dummy.py), and MuJoCo, in PyBullet's place, with no change above them."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule
from torchrl.envs import check_env_specs

import physai
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.training.evaluation import evaluate

DUMMY = "env.physics={_target_: tests.physics.dummy.DummyPhysics}"
POSITION = "env.robot.command=joint_position"
NONE = "randomization=none"


def toward_the_goal(observation):
    """Actions that turn a planar arm's end effector to its goal: each joint along the slope of the distance."""
    q1, _, _, _, x, y, goal_x, goal_y = observation.unbind(dim=1)
    away_x, away_y = goal_x - x, goal_y - y
    elbow_x, elbow_y = x - 0.3 * torch.cos(q1), y - 0.3 * torch.sin(q1)
    first = -y * away_x + x * away_y
    second = -elbow_y * away_x + elbow_x * away_y
    return (20 * torch.stack([first, second], dim=1)).clamp(-1, 1)


@pytest.fixture
def make():
    made = []

    def make_env(robots, *overrides):
        made.append(physai.make_env("reacher", robots, 0, [DUMMY, *overrides]))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


@pytest.mark.parametrize("command", ["joint_velocity", "joint_position"])
def test_a_simulation_runs_on_it(env_config, command):
    simulation = Simulation(env_config("reacher", DUMMY, f"env.robot.command={command}"), 3, seed=0)
    simulation.reset()
    before = simulation.state.joint_position
    for _ in range(10):
        simulation.step(np.full((3, 2), 0.5))
    moved = simulation.state.joint_position - before
    np.testing.assert_allclose(moved[:, 0], 10 * 0.02 * 0.5 * 2.0, rtol=1e-9)
    simulation.close()


@pytest.mark.parametrize("randomization", ["none", "strong"])
def test_the_torchrl_env_runs_on_it(make, randomization):
    check_env_specs(make(4, f"randomization={randomization}"))


@pytest.mark.slow
@pytest.mark.parametrize("command", ["joint_velocity", "joint_position"])
def test_a_policy_is_evaluated_on_it(make, command):
    env = make(50, NONE, f"env.robot.command={command}", "env.start.spread=[3.1,1.0]")
    policy = TensorDictModule(toward_the_goal, in_keys=["observation"], out_keys=["action"])
    found = evaluate(policy, env, 100, seed=0)
    assert found.success_rate > 0.8
    assert found.unit == "m"
    assert (found.error[found.success] < 0.05).all()
    again = evaluate(policy, env, 100, seed=0)
    assert torch.equal(found.length, again.length)


@pytest.mark.parametrize("engine", [[DUMMY], ["physics=mujoco"], ["physics=mujoco", "physics.motor=servo"]])
def test_gymnasium_s_checker_passes_on_it(engine):
    env = gymnasium.make("physai/Reacher-v0", overrides=engine)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("engine", [[], ["env.physics=${physics}", "physics=mujoco"]], ids=["dummy", "mujoco"])
def test_a_saved_state_goes_on_bit_for_bit_on_it(make, engine):
    env, restored = (make(4, "randomization=strong", *engine) for _ in range(2))
    td = env.reset()
    restored.set_state(env.state())
    for action in 2 * torch.rand(20, 4, 2, generator=torch.Generator().manual_seed(0)) - 1:
        td = env.step(td.set("action", action))["next"]
        other = restored.step(td.clone().set("action", action))["next"]
        assert torch.equal(td["joint_position"], other["joint_position"])
        assert torch.equal(td["reward"], other["reward"])


@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_an_engine_is_chosen_by_name_and_one_that_an_env_brings_along_stays(env_config, name):
    assert env_config(name).physics["_target_"] == "physai.physics.pybullet.PyBulletPhysics"
    chosen = env_config(name, "physics=mujoco", "physics.motor=servo").physics
    assert chosen["_target_"] == "physai.physics.mujoco.MuJoCoPhysics"
    assert chosen["motor"] == "servo"
    assert env_config(name, DUMMY, "physics=mujoco").physics == {"_target_": "tests.physics.dummy.DummyPhysics"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("physics.motor=serve", "physics.motor: input should be 'impulse' or 'servo', got 'serve'"),
        ("physics.threads=0", "physics.threads: input should be greater than 0, got 0"),
        ("physics.motor_time_constant=0", "physics.motor_time_constant: input should be greater than 0"),
        ("+physics.thread=2", "unknown key 'thread' of physai.physics.mujoco.MuJoCoPhysics; did you mean"),
    ],
)
def test_what_an_engine_does_not_take_is_one_line(env_config, override, message):
    with pytest.raises(UserError, match=message.replace(".", r"\.")):
        env_config("reacher", "physics=mujoco", override)


def test_what_is_no_engine_is_refused_by_name(env_config):
    with pytest.raises(UserError, match=r"physics\._target_: .*does not say whether it is 'simulated'"):
        env_config("reacher", "env.physics={_target_: tests.envs.test_another_engine.NoEngine}")
    with pytest.raises(UserError, match=r"env\.physics\._target_: .*HalfAnEngine .*has no 'step'"):
        Simulation(env_config("reacher", "env.physics={_target_: tests.envs.test_another_engine.HalfAnEngine}"), 1, 0)


class NoEngine:
    """Takes what an engine takes."""

    def __init__(self, *_: object) -> None: ...


class HalfAnEngine(NoEngine):
    """Says that it is one, and can only be reset."""

    simulated = True

    def reset(self) -> None:
        """Do nothing."""
