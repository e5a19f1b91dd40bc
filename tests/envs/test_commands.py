"""Robots that take velocities, and robots that take positions: what a policy is told, and what arrives late."""

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

import physai
from physai.envs.simulation import Simulation

POSITION = "env.robot.command=joint_position"
VELOCITY = "env.robot.command=joint_velocity"
BOTH = pytest.mark.parametrize("command", [VELOCITY, POSITION], ids=["velocity", "position"])
DELAY = "randomization.actuator_delay={distribution:uniform,low:0,high:3,operation:set}"
ENDLESS = "env.task.tolerance=1e-6"
NONE = "randomization=none"
ROBOTS = 16


@pytest.fixture
def make():
    """Make an env that is closed after the test."""
    made = []

    def make_env(*overrides, name="reacher", robots=ROBOTS):
        made.append(physai.make_env(name, robots, 0, [ENDLESS, *overrides]))
        return made[-1]

    yield make_env
    for env in made:
        env.close()


def delays(env, td):
    return td["physics_parameters"][:, env.simulation.layout.columns["actuator_delay"]][:, 0].long()


def steps(env, td, count, seed=0):
    """Random actions; yields what was before and after each step."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        action = 2 * torch.rand(*env.action_spec.shape, generator=generator) - 1
        after = env.step(td.set("action", action))["next"]
        yield td, after
        td = after


@BOTH
@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_specs_hold(make, command, name):
    check_env_specs(make(command, "randomization=strong", name=name))


def test_the_last_command_is_told_where_commands_are_positions_only(make):
    velocity, position = make(VELOCITY), make(POSITION)
    assert [signal.name for signal in velocity.simulation.sensed] == ["joint_position", "joint_velocity", "goal"]
    assert "last_command" not in velocity.reset()
    last = position.simulation.sensed[3]
    assert (last.name, last.unit, last.labels) == ("last_command", "rad", ("joint1", "joint2"))
    assert position.reset()["last_command"].shape == (ROBOTS, 2)


def test_the_last_command_is_what_the_policy_said_and_the_start_where_it_has_said_nothing(make):
    env = make(POSITION, "randomization=strong")  # encoders lie, commands are late: none of this changes it
    td = env.reset()
    true = torch.from_numpy(env.simulation.state.joint_position).float()
    assert torch.equal(td["last_command"], true)
    assert not torch.equal(td["last_command"], td["joint_position"])
    for before, after in steps(env, td, 10):
        moved = (after["last_command"] - before["last_command"]) / (0.02 * 2.0)
        torch.testing.assert_close(moved, before["action"], rtol=0, atol=0.02)
    mask = (torch.arange(ROBOTS) % 2 == 0)[:, None]
    fresh = env.reset(after.clone().set("_reset", mask))["last_command"]
    begun = torch.from_numpy(env.simulation.state.joint_position).float()
    assert torch.equal(fresh, torch.where(mask, begun, after["last_command"]))


@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_robots_that_take_positions_go_as_fast_as_those_that_take_velocities(make, name):
    ends = []
    for command in (VELOCITY, POSITION):
        env = make(command, NONE, "env.start.spread=[0,0]", name=name)
        td = env.reset()
        action = torch.linspace(-1, 1, ROBOTS)[:, None] * torch.tensor([1.0, -0.5])
        for _ in range(50):
            td = env.step(td.set("action", action))["next"]
        ends.append(env.simulation.state)
    limit = env.simulation.spec.command_limit
    np.testing.assert_allclose(ends[1].joint_velocity, ends[0].joint_velocity, rtol=0, atol=0.02)
    behind = np.abs(ends[1].joint_position - ends[0].joint_position)
    assert (behind <= limit / env.simulation.spec.position_gain + 1e-3).all()  # by its servo's time at most


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_a_command_moves_the_robot_exactly_as_many_steps_late_as_its_delay(make, command, name):
    delayed, prompt = (make(command, NONE, *delay, name=name) for delay in ([DELAY], []))
    td = delayed.reset()
    late = delays(delayed, td)
    assert late.unique().tolist() == [0, 1, 2, 3]
    physics = prompt.simulation.physics
    physics.set_state(delayed.simulation.physics.state())
    generator = torch.Generator().manual_seed(0)
    standing = delayed.simulation.last_command.copy()
    since = np.zeros(ROBOTS, int)  # step of each robot's last reset
    given = []
    for step in range(60):
        if step in (7, 8, 20, 41):
            rows = torch.rand(ROBOTS, 1, generator=generator) < 0.4
            assert 0 < rows.sum() < ROBOTS
            td = delayed.reset(td.set("_reset", rows))
            late, before = delays(delayed, td), late
            assert torch.equal(late[~rows[:, 0]], before[~rows[:, 0]])
            changed = rows[:, 0].numpy()
            since[changed] = step
            standing[changed] = delayed.simulation.last_command[changed]
            physics.set_state(delayed.simulation.physics.state())
        action = 2 * torch.rand(ROBOTS, 2, generator=generator) - 1
        stepped = delayed.step(td.set("action", action))
        assert torch.equal(stepped["action"], action)  # what the learner sees is what the policy said
        td = stepped["next"]
        given.append(delayed.simulation.last_command)
        from_step = step - late.numpy()
        arriving = [given[at][i] if at >= since[i] else standing[i] for i, at in enumerate(from_step)]
        expected = physics.step(np.array(arriving))
        np.testing.assert_array_equal(delayed.simulation.state.joint_position, expected.joint_position)
        np.testing.assert_array_equal(delayed.simulation.state.joint_velocity, expected.joint_velocity)


@BOTH
@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_a_robot_stays_where_it_starts_until_its_first_command_arrives(make, command, name):
    env = make(command, NONE, DELAY, name=name)
    for _ in range(3):
        td = env.reset()
        late, start = delays(env, td), td["joint_position"]
        for step in range(4):
            td = env.step(td.set("action", torch.ones(ROBOTS, 2)))["next"]
            apart = (td["joint_position"] - start).abs().amax(dim=1)
            assert (apart[late > step] < 2e-3).all()  # gravity may pull a little
            assert (apart[late <= step] > 2e-3).all()


@BOTH
def test_a_full_reset_forgets_all_commands_under_way(make, command):
    env = make(command, NONE, DELAY)
    td = env.reset()
    for _ in range(5):
        td = env.step(td.set("action", torch.ones(ROBOTS, 2)))["next"]
    td = env.reset()
    late = delays(env, td)
    after = env.step(td.set("action", -torch.ones(ROBOTS, 2)))["next"]
    assert (after["joint_velocity"][late > 0].abs() < 1e-3).all()
    assert (after["joint_velocity"][late == 0][:, 0] < -0.01).all()


@BOTH
def test_a_snapshot_holds_all_that_a_simulation_is(env_config, command):
    config = env_config("reacher", command, "env.task.tolerance=0.1", "env.start.carried_over=0.5")
    original, restored = (Simulation(config, 64, seed) for seed in (0, 1))
    parameters = original.layout.nominal.repeat(64, 1).numpy()
    parameters[:, original.layout.columns["actuator_delay"]] = np.arange(64)[:, None] % 5
    random = np.random.default_rng(0)
    for simulation in (original, restored):
        simulation.reset(parameters=parameters)
    for _ in range(30):
        _, terminated, _ = original.step(random.uniform(-1, 1, (64, 2)))
        original.reset(terminated[:, 0])
        restored.step(random.uniform(-1, 1, (64, 2)))
    tips = original.kinematics(torch.from_numpy(original.state.joint_position).float())[:, :2].double().numpy()
    original.goal = np.where(np.arange(64)[:, None] < 32, tips, original.goal)
    original.step(np.zeros((64, 2)))
    assert original.success[:32].all()
    restored.restore(original.snapshot())
    assert_equal(original, restored)
    original.reset(np.arange(64) % 2 == 0)
    restored.reset(np.arange(64) % 2 == 0)
    assert_equal(original, restored)
    for _ in range(30):
        action = random.uniform(-1, 1, (64, 2))
        ours, theirs = original.step(action), restored.step(action)
        np.testing.assert_array_equal(ours, theirs)
        assert_equal(original, restored)
        for simulation in (original, restored):
            simulation.reset(ours[1][:, 0])
    for simulation in (original, restored):
        simulation.close()


def assert_equal(ours, theirs):
    """Equal in all that a simulation shows."""
    for key in ("joint_position", "joint_velocity"):
        np.testing.assert_array_equal(getattr(ours.state, key), getattr(theirs.state, key), err_msg=key)
    shown = ("goal", "error", "success", "last_command", "episode_length", "episode_rewards", "within", "started")
    for key in (*shown, "physics_parameters"):
        np.testing.assert_array_equal(getattr(ours, key), getattr(theirs, key), err_msg=key)
