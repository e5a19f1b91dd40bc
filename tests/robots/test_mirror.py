"""Pairs of joints that are each other's mirror image."""

import numpy as np
import pytest

from physai.errors import UserError
from physai.robots import Mirror, RobotSpec


def test_pairs_of_joints_are_found_on_every_robot_on_legs(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    mirror = Mirror.of(spec)
    assert (mirror.order[mirror.order] == np.arange(len(spec.joints))).all()
    assert (mirror.sign[mirror.order] == mirror.sign).all()
    assert (mirror.links(spec)[mirror.links(spec)] == np.arange(len(spec.moving_links))).all()


def test_of_an_a1_the_legs_are_swapped_and_hips_turn_the_other_way(env_config):
    spec = RobotSpec.from_config(env_config("a1_walk").robot)
    mirror = Mirror.of(spec)
    names = [spec.joints[joint] for joint in mirror.order]
    assert names[:3] == ["FL_hip_joint", "FL_upper_joint", "FL_lower_joint"]
    assert mirror.sign.tolist() == [-1.0, 1.0, 1.0] * 4


def test_what_has_no_mirror_image_is_refused_by_name(reacher, env_config):
    with pytest.raises(UserError, match="stands on no legs"):
        Mirror.of(RobotSpec.from_config(reacher.robot))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("home=[0.2,0.8,-1.6,0,0.8,-1.6,0,0.8,-1.6,0,0.8,-1.6]", "its feet on the left are not where"),
        (
            "command_limit=[0.4,0.7,0.7,0.5,0.7,0.7,0.4,0.7,0.7,0.4,0.7,0.7]",
            "FR_hip_joint and FL_hip_joint have not the",
        ),
        (
            "servo.stiffness=[80,80,80,80,80,70,80,80,80,80,80,80]",
            "FR_lower_joint and FL_lower_joint have not the same",
        ),
    ],
)
def test_a_robot_whose_sides_differ_is_refused_in_one_line(env_config, change, said):
    spec = RobotSpec.from_config(env_config("a1_walk", f"env.robot.{change}").robot)
    with pytest.raises(UserError, match=said):
        Mirror.of(spec)
