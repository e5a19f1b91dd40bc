"""Pictures: a goal is seen where it is, in the plane, in space, and as where joints would bring a robot."""

import sys

import numpy as np
import pytest
import torch

from physai.envs.simulation import Simulation
from physai.envs.viewing import make_viewer, show
from physai.errors import UserError

HOLD = ("~env.task", "+env.task={_target_: tests.tasks.hold.Hold, hold: 0.1, max_steps: 80}")


@pytest.fixture
def simulate(env_config):
    """Make a simulation with a viewer; both are closed after the test."""
    made = []

    def make(*overrides, name="reacher"):
        simulation = Simulation(env_config(name, *overrides), 2, seed=0)
        made.extend([simulation, viewer := make_viewer(simulation)])
        return simulation, viewer

    yield make
    for each in made:
        each.close()


def centre(image):
    """Row and column of what is green, and how many pixels are."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    rows, columns = ((green > 60) & (green > 1.5 * red) & (green > 1.5 * blue)).nonzero()
    return rows.mean(), columns.mean(), len(rows)


@pytest.mark.parametrize("name", ["reacher", "kuka_reacher"])
def test_a_goal_in_space_is_a_ball_at_its_height(simulate, name):
    simulation, viewer = simulate(name=name)
    pose = simulation.spec.home
    low, high = (centre(viewer.show(pose, np.array([0.35, 0.3, z]))) for z in (0.1, 0.5))
    assert low[0] > high[0] + 30  # rows count from the top
    assert low[2] > 30
    flat = centre(viewer.show(pose, np.array([0.35, 0.3])))
    again = centre(viewer.show(pose, np.array([0.35, 0.3, 0.1])))
    assert flat[2] > 30
    assert again == low  # the disc is gone


def test_a_goal_of_joints_is_shown_where_they_bring_the_end_effector(simulate):
    simulation, viewer = simulate(*HOLD)
    place = np.array([0.30, 0.25, 0.0])  # of the end effector at 0 and a right angle
    simulation.goal = np.array([[0.0, 0.0], [0.0, np.pi / 2]])
    pose = simulation.state.joint_position[1]
    np.testing.assert_array_equal(show(viewer, simulation, row=1), viewer.show(pose, place))
    assert abs(centre(show(viewer, simulation))[1] - centre(show(viewer, simulation, row=1))[1]) > 20


def test_without_pybullet_robots_are_drawn_as_lines(simulate, monkeypatch):
    """As on Python 3.12 and later, for which there are no wheels of it."""
    simulation, _ = simulate()
    simulation.reset()
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "physai.physics.viewer")
    viewer = make_viewer(simulation)
    first, second = show(viewer, simulation), show(viewer, simulation, row=1)
    assert first.shape == second.shape == (360, 480, 3)
    assert first.dtype == np.uint8
    assert (first != second).any(axis=2).sum() > 500
    position = simulation.state.joint_position
    tip = simulation.kinematics(torch.from_numpy(position).float()).numpy()
    np.testing.assert_allclose([viewer.points(pose)[-1] for pose in position], tip, atol=1e-5)
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(UserError, match="a window needs 'pybullet', which is not installed"):
        make_viewer(simulation, window=True)
