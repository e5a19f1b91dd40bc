"""A robot that goes from goal to goal, with parameters that change on its way."""

from dataclasses import replace

import numpy as np
import pytest

from physai.artifact.acting import PolicyFile
from physai.physics import RandomizationConfig
from physai.web.driven import DrivenRobot
from physai.web.live import sensed


@pytest.fixture
def robot(exported_run):
    file = PolicyFile(exported_run / "policy.pt")
    robot = DrivenRobot(*file.deploy(1, 0, sensed(file.randomization)))
    yield robot
    robot.close()


def drive(robot, steps):
    for _ in range(steps):
        robot.step()
    return robot.simulation.error[0, 0]


def test_a_policy_file_brings_its_robot_to_one_goal_after_the_other_and_each_counts_once(robot):
    for goal in ([0.3, 0.2], [-0.3, 0.2], [0.0, -0.4]):
        assert (robot.aim(np.array(goal), True) == goal).all()
        assert drive(robot, 200) < 0.06
        assert robot.finished
    assert robot.goals == 4  # with the one that it began with
    assert robot.reached == 3
    assert robot.settled <= robot.reached
    robot.clear()
    assert (robot.goals, robot.reached, robot.settled) == (1, 0, 0)


def test_a_goal_that_is_still_being_moved_is_followed_and_not_counted(robot):
    before = robot.goals, robot.reached
    robot.aim(np.array([0.3, 0.2]), False)
    assert drive(robot, 200) < 0.06
    assert (robot.goals, robot.reached) == before


def test_a_goal_outside_becomes_the_nearest_one_inside(robot):
    assert robot.aim(np.array([3.0, 0.0]), True) == pytest.approx([robot.simulation.task.region.outer, 0.0])


def test_parameters_change_on_the_way_and_stay_when_the_robot_begins_anew(robot):
    columns = robot.simulation.layout.columns
    drive(robot, 5)
    position = robot.joint_position.copy()
    robot.set_parameter("payload", 2.0)
    robot.set_parameter("actuator_delay", 3.0)
    assert robot.joint_position == pytest.approx(position, abs=1e-6)
    assert robot.simulation.physics.parameters()["payload"] == pytest.approx(np.array([[2.0]]))
    robot.restart()
    assert robot.parameters[columns["payload"]] == 2.0
    assert robot.parameters[columns["actuator_delay"]] == 3.0
    drive(robot, 5)


def test_noise_that_is_set_reaches_what_the_policy_sees(robot):
    robot.set_parameter("position_noise", 0.03)
    drive(robot, 2)
    seen, true = robot._tensordict["joint_position"][0].numpy(), robot.joint_position
    assert np.abs(seen - true).max() > 1e-3


@pytest.fixture
def walker(walking_run):
    file = PolicyFile(walking_run / "policy.pt")
    robot = DrivenRobot(*file.deploy(1, 0, sensed(RandomizationConfig.none())))
    yield robot
    robot.close()


def test_a_robot_on_legs_follows_one_command_until_there_is_another(walker):
    walker.aim(np.array([0.5, 0.0, 0.3]), True)
    drive(walker, 400)  # other commands would have come after 5 s, and an episode would soon be over
    assert walker.goal == pytest.approx([0.5, 0.0, 0.3])
    start = walker.base_pose[:2].copy()
    drive(walker, 100)
    assert np.linalg.norm(walker.base_pose[:2] - start) > 0.6
    assert walker.crashed == 0
    walker.draw_goal()
    assert walker.goal != pytest.approx([0.5, 0.0, 0.3])


def test_a_robot_that_has_fallen_stands_up_and_follows_the_command_that_it_had(walker):
    walker.aim(np.array([0.5, 0.0, 0.3]), True)
    drive(walker, 5)
    simulation = walker.simulation
    over = replace(simulation.state, base_pose=np.array([[0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]]))  # on its back
    simulation.physics.reset(np.arange(1), over)
    drive(walker, 1)
    assert walker.crashed == 1
    assert walker.base_pose[3:] == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=0.1)
    assert walker.goal == pytest.approx([0.5, 0.0, 0.3])
