import pytest
import torch
from scipy import stats

from physai.envs.make import make

OFFSET = "randomization.encoder_offset={distribution:normal,mean:0.3,std:0.2,operation:set}"
POSITION = "randomization.position_noise={distribution:uniform,low:0.01,high:0.05,operation:set}"
VELOCITY = "randomization.velocity_noise={distribution:uniform,low:0.1,high:0.2,operation:set}"


@pytest.fixture
def make_env():
    """Make an env that is closed after the test."""
    made = []

    def make_closing(*overrides, name="reacher", robots=64):
        made.append(make(name, robots, 0, ["randomization=none", *overrides]))
        return made[-1]

    yield make_closing
    for env in made:
        env.close()


def true_state(env):
    state = env.simulation.state
    return torch.from_numpy(state.joint_position).float(), torch.from_numpy(state.joint_velocity).float()


def played(env, steps):
    """Step with random actions; yield the policy's view after each step, and the true joint state beside it."""
    generator = torch.Generator().manual_seed(1)
    td = env.reset()
    yield td, *true_state(env)
    for _ in range(steps):
        action = 2 * torch.rand(env.action_spec.shape, generator=generator) - 1
        stepped, td = env.step_and_maybe_reset(td.set("action", action))
        if not stepped["next", "done"].any():
            yield stepped["next"], *true_state(env)


def columns(env, td, name):
    return td["physics_parameters"][:, env.simulation.layout.columns[name]]


def test_the_reading_is_the_true_state_with_the_robot_s_offset_and_noise(make_env):
    env = make_env(OFFSET, POSITION, VELOCITY, "env.task.tolerance=1e-6")
    position, velocity = [], []
    for td, true_position, true_velocity in played(env, 60):
        error = td["joint_position"] - true_position - columns(env, td, "encoder_offset")
        position.append(error / columns(env, td, "position_noise"))
        velocity.append((td["joint_velocity"] - true_velocity) / columns(env, td, "velocity_noise"))
    for noise in (torch.stack(position), torch.stack(velocity)):
        assert stats.kstest(noise.double().flatten()[:5000], stats.norm.cdf).pvalue > 0.01
        for robot in range(64):
            assert noise[:, robot].std() == pytest.approx(1.0, abs=0.25)
        lag = (noise[1:] * noise[:-1]).mean()
        assert abs(lag) < 0.05  # white
    assert abs((torch.stack(position) * torch.stack(velocity)).mean()) < 0.05


def test_each_robot_keeps_its_offset_through_an_episode(make_env):
    env = make_env(OFFSET, "env.task.tolerance=1e-6")
    offsets = [td["joint_position"] - true for td, true, _ in played(env, 20)]
    torch.testing.assert_close(torch.stack(offsets), offsets[0].expand(21, -1, -1), rtol=0, atol=1e-5)
    assert offsets[0].std() == pytest.approx(0.2, abs=0.05)
    assert (offsets[0][:, 0] - offsets[0][:, 1]).abs().min() > 0  # one for each joint


@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_the_observation_is_made_of_what_is_measured(make_env, name):
    env = make_env(OFFSET, POSITION, VELOCITY, name=name)
    continuous = env.simulation.spec.continuous
    for td, true_position, _ in played(env, 5):
        tip = env.simulation.kinematics(td["joint_position"])[:, :2]
        seen = td["joint_position"].clone()
        seen[:, continuous] = torch.remainder(seen[:, continuous] + torch.pi, 2 * torch.pi) - torch.pi
        expected = torch.cat([seen, td["joint_velocity"], tip, td["goal"]], -1)
        torch.testing.assert_close(td["observation"], expected, rtol=0, atol=2e-6)
        true_tip = env.simulation.kinematics(true_position)[:, :2]
        assert (tip - true_tip).norm(dim=-1).mean() > 0.01


@pytest.mark.slow
def test_reward_and_success_are_those_of_the_true_state(make_env):
    env = make_env(OFFSET, POSITION, VELOCITY, robots=256)
    simulation, tolerance = env.simulation, env.simulation.task.tolerances[0].value
    generator = torch.Generator().manual_seed(2)
    td = env.reset()
    reached = believed = 0
    for _ in range(60):
        stepped = env.step(td.set("action", 2 * torch.rand(256, 2, generator=generator) - 1))["next"]
        tip = simulation.kinematics(true_state(env)[0])[:, :2]
        distance = (tip - torch.from_numpy(simulation.goal).float()).norm(dim=-1)
        success = distance < tolerance
        torch.testing.assert_close(stepped["reward"][:, 0], 10.0 * success - distance, rtol=0, atol=1e-5)
        assert torch.equal(stepped["terminated"][:, 0], success)
        assert torch.equal(stepped["success"][:, 0], success)
        measured = (stepped["observation"][:, 4:6] - stepped["goal"]).norm(dim=-1) < tolerance
        reached += int(success.sum())
        believed += int((measured & ~success).sum())
        td = stepped
    assert reached > 0
    assert believed > 0
