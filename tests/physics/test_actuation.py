import pytest
import torch

from physai.envs.make import make

DELAY = "randomization.actuator_delay={distribution:uniform,low:0,high:3,operation:set}"
ROBOTS = 16


@pytest.fixture(params=["reacher", "kuka_reacher"])
def pair(request):
    """An env whose robots have delays of 0 to 3 steps, and one without delays."""
    endless = "env.task.tolerance=1e-6"
    delayed = make(request.param, ROBOTS, 0, ["randomization=none", DELAY, endless])
    prompt = make(request.param, ROBOTS, 0, ["randomization=none", endless])
    yield delayed, prompt
    delayed.close()
    prompt.close()


def delays(env, td):
    return td["physics_parameters"][:, env.simulation.layout.columns["actuator_delay"]][:, 0].long()


def follow(prompt, delayed):
    """Put robots into the states of others."""
    prompt.simulation.physics.set_state(delayed.simulation.physics.state())


def test_a_command_moves_the_robot_exactly_as_many_steps_late_as_its_delay(pair):
    delayed, prompt = pair
    td = delayed.reset()
    prompt_td = prompt.reset()
    assert delays(delayed, td).unique().tolist() == [0, 1, 2, 3]
    generator = torch.Generator().manual_seed(0)
    since = torch.zeros(ROBOTS, dtype=torch.int64)  # step of each robot's last reset
    given = []
    late = delays(delayed, td)
    follow(prompt, delayed)
    for step in range(60):
        if step in (7, 8, 20, 41):
            rows = torch.rand(ROBOTS, 1, generator=generator) < 0.4
            assert 0 < rows.sum() < ROBOTS
            td = delayed.reset(td.set("_reset", rows))
            late, before = delays(delayed, td), late
            assert torch.equal(late[~rows[:, 0]], before[~rows[:, 0]])
            since[rows[:, 0]] = step
            follow(prompt, delayed)
        given.append(2 * torch.rand(ROBOTS, 2, generator=generator) - 1)
        arriving = torch.zeros(ROBOTS, 2)
        for robot in range(ROBOTS):
            from_step = step - int(late[robot])
            if from_step >= since[robot]:
                arriving[robot] = given[from_step][robot]
        stepped = delayed.step(td.set("action", given[-1]))
        assert torch.equal(stepped["action"], given[-1])  # what the learner sees is what the policy said
        td = stepped["next"]
        prompt_td = prompt.step(prompt_td.set("action", arriving))["next"]
        for key in ("joint_position", "joint_velocity"):
            assert torch.equal(td[key], prompt_td[key]), (step, key)


def test_a_robot_stands_still_until_its_first_command_arrives(pair):
    delayed, _ = pair
    td = delayed.reset()
    late = delays(delayed, td)
    start = td["joint_position"]
    for step in range(4):
        td = delayed.step(td.set("action", torch.ones(ROBOTS, 2)))["next"]
        moved = (td["joint_velocity"][:, 0] > 0.01) & (td["joint_position"] != start).any(-1)
        assert torch.equal(moved, late <= step)


def test_a_full_reset_forgets_all_commands_under_way(pair):
    delayed, _ = pair
    td = delayed.reset()
    for _ in range(5):
        td = delayed.step(td.set("action", torch.ones(ROBOTS, 2)))["next"]
    td = delayed.reset()
    late = delays(delayed, td)
    stepped = delayed.step(td.set("action", -torch.ones(ROBOTS, 2)))["next"]
    assert (stepped["joint_velocity"][late > 0].abs() < 1e-3).all()
    assert (stepped["joint_velocity"][late == 0][:, 0] < -0.01).all()
