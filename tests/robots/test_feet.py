"""Feet: they stand on the floor at home, and move with the joints as their Jacobian says."""

import numpy as np

from physai.robots import RobotSpec, feet, feet_at_home


def test_feet_of_any_legs_stand_on_the_floor_at_home(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    places, _ = feet_at_home(spec)
    radius = [sphere.radius for sphere in spec.floating.spheres if sphere.link in spec.floating.foot_links]
    np.testing.assert_allclose(places[:, 2] + spec.floating.height, radius, atol=0.02)


def test_the_jacobian_says_how_feet_move(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    places, jacobian = feet_at_home(spec)
    step = np.random.default_rng(0).uniform(-1e-3, 1e-3, len(spec.joints))
    (frames,) = np.moveaxis(spec.motions.frames((spec.home + step)[np.newaxis]), -1, 0)
    moved = [(frames[body] @ foot)[:, 3] for body, foot in feet(spec)]
    np.testing.assert_allclose(places + jacobian @ step, moved, atol=1e-6)
