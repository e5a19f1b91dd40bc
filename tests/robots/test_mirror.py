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
    crooked = env_config("a1_walk", "env.robot.home=[0.2,0.8,-1.6,0,0.8,-1.6,0,0.8,-1.6,0,0.8,-1.6]")
    with pytest.raises(UserError, match=r"its feet on the left are not|no joint on its other side"):
        Mirror.of(RobotSpec.from_config(crooked.robot))
