"""Where links end: feet stand on the floor at home, and all move with the joints as their Jacobian says."""

import numpy as np
import torch

from physai.robots import ForwardKinematics, RobotSpec, ends_at_home, kinematics_of


def test_feet_of_any_legs_stand_on_the_floor_at_home(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    places, _ = ends_at_home(spec)
    radius = [sphere.radius for sphere in spec.floating.spheres if sphere.link in spec.floating.foot_links]
    np.testing.assert_allclose(places[:, 2] + spec.floating.height, radius, atol=0.02)


def test_the_jacobian_says_how_feet_move(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    places, jacobian = ends_at_home(spec)
    step = np.random.default_rng(0).uniform(-1e-3, 1e-3, len(spec.joints))
    moved = kinematics_of(spec).places((spec.home + step)[np.newaxis])[..., 0]
    np.testing.assert_allclose(places + jacobian @ step, moved, atol=1e-6)


def test_the_end_of_an_arm_is_where_forward_kinematics_say_and_moves_as_they_say(any_arm):
    spec = RobotSpec.from_config(any_arm.robot)
    ((place,), (jacobian,)) = ends_at_home(spec)
    home = torch.from_numpy(spec.home).float().unsqueeze(0)
    (linear,) = ForwardKinematics(spec).linearize(torch.cos(home), torch.sin(home)).numpy()
    np.testing.assert_allclose(np.column_stack([jacobian, place]), linear, atol=1e-5)
