"""What the controller gives away, and all of it with the real policy and the real simulation."""

import json

import numpy as np
import pytest

from physai.deploy import Controller, Goal, JointState, State
from physai.envs.simulation import Simulation
from tests.deploy.robot import FAR_GOAL, NAMES, PERIOD, Robot

# The snapshot.


def test_the_snapshot_is_plain_and_tells_state_reasons_and_counters(robot):
    snapshot = robot.controller.snapshot()
    assert snapshot["state"] == "waiting"
    assert snapshot["joint_state_age"] is None
    assert snapshot["command"] is None
    assert snapshot["goal"] is None
    assert snapshot["counters"] == {}
    robot.drive()
    robot.ticks(7, state=None)
    snapshot = json.loads(json.dumps(robot.controller.snapshot(), allow_nan=False))
    assert snapshot["state"] == "hold"
    assert snapshot["state_since"] == pytest.approx(robot.now - PERIOD)
    assert snapshot["reasons"] == ["the last joint state is 0.140 s old", "5 more good joint states are needed"]
    assert snapshot["last_hold"] == "the last joint state is 0.140 s old"
    assert snapshot["joint_state_age"] == pytest.approx(0.14)
    assert snapshot["recovery_states_needed"] == 5
    assert snapshot["goal"] == FAR_GOAL.value
    assert snapshot["command"] == [0.0, 0.0]
    assert snapshot["policy_sha256"] == robot.policy.sha256
    counters = snapshot["counters"]
    assert counters["updates"] == 28
    assert counters["states"] == 21
    assert counters["goals"] == 1
    assert counters["entered active"] == counters["entered hold"] == 1


def test_commands_can_be_compared_and_kept_in_sets(moving):
    command, other = moving.tick(), moving.tick()
    assert command != other
    assert len({command, other, command}) == 2


def test_what_it_gives_away_does_not_lead_back_inside(moving, policy):
    undisturbed = Robot(policy)
    undisturbed.drive()
    moving.tick().value[:] = 99.0
    undisturbed.tick()
    snapshot = moving.controller.snapshot()
    snapshot["goal"][0], snapshot["counters"]["updates"] = 99.0, -1
    assert moving.tick().value.tolist() == undisturbed.tick().value.tolist()
    assert moving.counters == undisturbed.counters


# All together, with the real policy and the real simulation.


@pytest.mark.slow
@pytest.mark.parametrize("command", ["joint_velocity", "joint_position"])
def test_it_brings_the_simulated_arm_to_at_least_9_of_10_goals_within_its_limits(request, env_config, command):
    policy = request.getfixturevalue("policy" if command == "joint_velocity" else "position_policy")
    robots, config = 10, env_config("reacher", f"env.robot.command={command}")
    simulation = Simulation(config, robots, seed=7)
    simulation.reset()
    # A stopwatch of its own: on a busy machine a policy now and then takes longer than its 10 ms.
    controllers = [Controller(policy, stopwatch=lambda: 0.0) for _ in range(robots)]
    limit = policy.metadata.position_limit
    reached, last = np.zeros(robots, dtype=bool), np.zeros((robots, 2))
    for tick in range(round(40 / PERIOD)):
        position = simulation.state.joint_position
        velocity = simulation.state.joint_velocity
        assert (position >= limit[:, 0]).all()
        assert (position <= limit[:, 1]).all()
        assert (np.abs(velocity) <= 0.3 * 1.05).all()
        commands, standing = np.zeros((robots, 2)), np.zeros((robots, 1), dtype=bool)
        for row, controller in enumerate(controllers):
            state = JointState(NAMES, position[row], velocity[row], tick * PERIOD)
            goal = Goal(simulation.goal[row], "base") if tick == 0 else None
            answer = controller.update(tick * PERIOD, state, goal)
            standing[row] = answer.state is State.REACHED
            commands[row] = answer.value
        reached |= standing[:, 0]
        moved = commands - simulation.last_command  # what an action makes of the last command
        rates = moved / PERIOD if command == "joint_position" else commands
        speeds = np.where(standing, 0.0, rates)
        assert (np.abs(speeds) <= 0.3 + 1e-6).all()
        assert (np.abs(speeds - last)[speeds != 0] <= 2.0 * PERIOD + 1e-6).all()
        last = speeds
        simulation.step(rates / policy.metadata.command_limit)
        if reached.all():
            break
    simulation.close()
    assert reached.sum() >= 9
    for controller in controllers:
        assert set(controller.snapshot()["counters"]) <= {
            "updates",
            "states",
            "goals",
            "entered active",
            "entered reached",
            "ticks at a position limit",
        }
