"""A quadruped whose URDF has no limits: a YAML gives them, and it stands in each engine."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig, Simulation
from physai.errors import UserError
from physai.robots import RobotSpec

LEGS = ("fr", "fl", "hr", "hl")
LIMITS = {"position": [[-0.8, 0.8], [-2.5, 0.5], [0.2, 2.6]] * 4, "velocity": [40.0] * 12, "effort": [18.0] * 12}
THIGH = [0.002, 0.0, 0.0, 0.002, 0.0, 0.0004]  # that of the URDF is of no body
TOES = [{"link": f"toe_{leg}", "center": [0.0, 0.0, 0.0], "radius": 0.02} for leg in LEGS]
CHEETAH = {
    "name": "mini_cheetah",
    "urdf": "package://pybullet_data/mini_cheetah/mini_cheetah.urdf",
    "joints": [
        name
        for leg in LEGS
        for name in (f"torso_to_abduct_{leg}_j", f"abduct_{leg}_to_thigh_{leg}_j", f"thigh_{leg}_to_knee_{leg}_j")
    ],
    "inertials": {f"thigh_{leg}": {"mass": 0.634, "com": [0.0, 0.0, -0.02], "inertia": THIGH} for leg in LEGS},
    "home": [0.0, -0.8, 1.6] * 4,
    "command_limit": [0.4, 0.7, 0.7] * 4,
    "servo": {"stiffness": [60.0] * 12, "damping": [1.0] * 12},
    "limits": LIMITS,
    "floating": {
        "height": 0.29,
        "feet": [toe["link"] for toe in TOES],
        "spheres": [*TOES, {"link": "body", "center": [0.0, 0.0, 0.0], "radius": 0.05}],
    },
}


def config(physics="mujoco", **changes):
    node = compose("train", ["env=a1_walk", f"physics={physics}", "env.task.stand=1.0"])
    robot = OmegaConf.to_container(node.env.robot)
    floating = robot["floating"] | CHEETAH["floating"]
    OmegaConf.update(node, "env.robot", robot | CHEETAH | {"floating": floating} | changes, force_add=True)
    node.env.start.spread = [0.0] * 12
    return validate(EnvConfig, node.env)


def test_without_limits_the_line_says_what_gives_them():
    with pytest.raises(
        UserError, match=r"joint 'torso_to_abduct_fr_j' has no <limit>: .* the robot's YAML may give 'limits'"
    ):
        RobotSpec.from_config(config(limits=None).robot)


def test_limits_of_the_yaml_take_the_place_of_those_of_the_urdf():
    spec = RobotSpec.from_config(config().robot)
    np.testing.assert_array_equal(spec.position_limit, LIMITS["position"])
    np.testing.assert_array_equal(spec.effort_limit, LIMITS["effort"])
    np.testing.assert_array_equal(spec.velocity_limit, LIMITS["velocity"])


def test_limits_of_another_number_of_joints_are_refused():
    with pytest.raises(UserError, match=r"robot 'mini_cheetah': limits\.effort has 2 values for 12 joints"):
        RobotSpec.from_config(config(limits=LIMITS | {"effort": [18.0, 18.0]}).robot)


@pytest.mark.parametrize("physics", ["mujoco", "pybullet"])
def test_it_stands_where_it_is_put(physics):
    simulation = Simulation(config(physics), 2, seed=0)
    simulation.reset()
    for _ in range(100):
        _, terminated, _ = simulation.step(np.zeros((2, 12), np.float32))
        assert not terminated.any()
    assert simulation.state.base_pose[:, 2] == pytest.approx([0.29, 0.29], abs=0.05)
    assert np.abs(simulation.state.base_twist).max() < 0.1
    simulation.close()
