"""A quadruped whose URDF has no limits: a YAML gives them, and it stands in each engine."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from physai.config import validate
from physai.envs.simulation import EnvConfig, Simulation
from physai.errors import UserError
from physai.robots import RobotSpec
from tests.composed import composed
from tests.docs.blocks import shown_files


@pytest.fixture(scope="module")
def cheetah():
    """The robot of docs/walk.md."""
    robot = OmegaConf.create(shown_files("docs/walk.md")["conf/robot/mini_cheetah.yaml"])
    del robot["defaults"]
    return robot


@pytest.fixture
def config(cheetah):
    """Compose the config of an env with it, and with changes to it."""

    def config(physics="mujoco", **changes):
        node = composed("env=a1_walk", f"physics={physics}", "env.task.stand=1.0", "env.start.spread=0.0")
        robot = OmegaConf.merge(OmegaConf.to_container(node.env.robot), cheetah, changes)
        OmegaConf.update(node, "env.robot", robot, force_add=True)
        return validate(EnvConfig, node.env)

    return config


def test_without_limits_the_line_says_what_gives_them(config):
    with pytest.raises(
        UserError, match=r"joint 'torso_to_abduct_fr_j' has no <limit>: .* the robot's YAML may give 'limits'"
    ):
        RobotSpec.from_config(config(limits=None).robot)


def test_limits_of_the_yaml_take_the_place_of_those_of_the_urdf(config, cheetah):
    spec, limits = RobotSpec.from_config(config().robot), cheetah.limits
    np.testing.assert_array_equal(spec.position_limit, limits.position)
    np.testing.assert_array_equal(spec.effort_limit, np.full(12, limits.effort))
    np.testing.assert_array_equal(spec.velocity_limit, np.full(12, limits.velocity))


@pytest.mark.parametrize(("key", "values"), [("effort", [18.0, 18.0]), ("position", [[-1.0, 1.0]])])
def test_limits_of_another_number_of_joints_are_refused(config, key, values):
    line = rf"robot 'mini_cheetah': limits\.{key} has {len(values)} values for 12 joints"
    with pytest.raises(UserError, match=line):
        RobotSpec.from_config(config(limits={key: values}).robot)


@pytest.mark.parametrize("physics", ["mujoco", "pybullet"])
def test_it_stands_where_it_is_put(config, physics):
    simulation = Simulation(config(physics), 2, seed=0)
    simulation.reset()
    for _ in range(100):
        _, terminated, _ = simulation.step(np.zeros((2, 12), np.float32))
        assert not terminated.any()
    assert simulation.state.base_pose[:, 2] == pytest.approx([0.29, 0.29], abs=0.05)
    assert np.abs(simulation.state.base_twist).max() < 0.1
    simulation.close()
