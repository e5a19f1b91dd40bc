"""The gait: the joints lead the feet along the paths that it names."""

import numpy as np
import pytest
import torch

from physai.errors import UserError
from physai.robots import RobotSpec, ends_at_home, kinematics_of
from physai.tasks.gait import Gait, joint_gait
from physai.tasks.walk import WalkObservation

STILL = {"start": 0.0, "middle": 0.0}
GAIT = {"frequency": 2.0, "lift": 0.0, "reach": 0.0, "forward": STILL, "outward": STILL, "stride": 1.0}
GAIT["yaw_correction"] = 0.0
VELOCITY = np.array([0.06, 0.0, 0.0])  # m/s: small enough for a Jacobian


@pytest.fixture(scope="module")
def spec(env_config):
    return RobotSpec.from_config(env_config("a1_walk").robot)


def feet_in_time(spec, command=VELOCITY, yaw_rate=0.0, **gait):
    """Where the feet are for 24 moments of a period of 0.5 s, from home, m, [24, feet, 3]."""
    module = WalkObservation(spec, Gait.model_validate(GAIT | gait))
    rows, joints = 24, len(spec.joints)
    zero = torch.zeros(rows, 3)
    turning = zero.clone()
    turning[:, 2] = yaw_rate
    home = torch.from_numpy(spec.home).float().expand(rows, joints)
    clock = torch.arange(rows).unsqueeze(1) * (0.5 / rows)
    goal = torch.from_numpy(command).float().expand(rows, 3)
    _, features = module(turning, zero, home, torch.zeros(rows, joints), torch.zeros(rows, joints), clock, goal)
    offset = torch.tanh(features[:, -joints:]).double().numpy() * spec.command_limit
    places = kinematics_of(spec).places(spec.home + offset).transpose(2, 0, 1)
    return places - ends_at_home(spec)[0]


def test_over_a_stance_a_foot_goes_back_as_far_as_the_base_goes_forward(spec):
    x = feet_in_time(spec)[:, :, 0]
    stands = 0.25 * VELOCITY[0]  # m, in half a period
    np.testing.assert_allclose(x.max(axis=0) - x.min(axis=0), stands, rtol=0.03)
    right, left = x[:, 0], x[:, 1]
    assert right[0] == pytest.approx(-stands / 2, rel=0.03)  # the right front foot begins to swing
    assert left[0] == pytest.approx(stands / 2, rel=0.03)  # and the left one to stand


def test_feet_of_a_diagonal_step_together_and_are_up_only_while_they_swing(spec):
    z = feet_in_time(spec, lift=0.01)[:, :, 2]
    np.testing.assert_allclose(z[:, [0, 1]], z[:, [3, 2]], atol=1e-3)
    assert z[6, 0] == pytest.approx(0.01, rel=0.1)
    assert np.abs(z[12:, 0]).max() < 1e-3
    assert np.abs(z[:12, 1]).max() < 1e-3


def test_to_turn_feet_go_around_the_base(spec):
    x, y = feet_in_time(spec, np.array([0.0, 0.0, 0.2]))[0, :, :2].T  # at the beginning of the swing of two
    place = ends_at_home(spec)[0]
    way = 0.125 * 0.2 * np.array([1, -1, -1, 1])
    np.testing.assert_allclose(x, way * place[:, 1], atol=2e-4)
    np.testing.assert_allclose(y, -way * place[:, 0], atol=2e-4)


def test_feet_sway_forward_together_and_outward_to_either_side(spec):
    moved = feet_in_time(spec, forward={"start": 0.0, "middle": 0.01}, stride=1e-6)
    assert moved[6, :, 0] == pytest.approx([0.01, -0.01, -0.01, 0.01], abs=1e-3)
    moved = feet_in_time(spec, outward={"start": 0.01, "middle": 0.0}, stride=1e-6)
    assert moved[0, :, 1] == pytest.approx([-0.01, -0.01, 0.01, 0.01], abs=1e-3)


def test_a_turn_that_is_missing_moves_the_feet_against_it(spec):
    there = feet_in_time(spec, yaw_rate=-0.2, yaw_correction=0.1)
    without = feet_in_time(spec, yaw_rate=-0.2)
    place = ends_at_home(spec)[0]
    np.testing.assert_allclose((there - without)[0, :, 1], -0.02 * place[:, 0], atol=5e-4)


def test_where_it_shall_stand_nothing_moves(spec):
    assert np.abs(feet_in_time(spec, np.zeros(3), lift=0.1)).max() < 1e-6


def stretched(config, knee):
    return {"home": [0.0, 0.0, knee] * 4}


def on_one_line(config, _):
    return {"floating": config.floating.model_copy(update={"feet": ["FR_toe", "FR_lower", "RL_toe", "RL_lower"]})}


def two(config, _):
    return {"floating": config.floating.model_copy(update={"feet": ["FR_toe", "FL_toe"]})}


@pytest.mark.parametrize(
    ("change", "knee", "line"),
    [
        (stretched, 0.0, "its legs are too straight to lift the feet: bend the knees in 'home'"),
        (stretched, -0.1, "its legs are too straight to lift the feet: bend the knees in 'home'"),
        (on_one_line, None, "a trot needs four feet, one at each corner, with a leg of its own"),
        (two, None, "a trot needs four feet, one at each corner, with a leg of its own"),
    ],
)
def test_legs_that_cannot_trot_are_refused_in_one_line(env_config, change, knee, line):
    config = env_config("a1_walk").robot
    spec = RobotSpec.from_config(config.model_copy(update=change(config, knee)))
    with pytest.raises(UserError, match=f"robot 'a1': {line}"):
        WalkObservation(spec, Gait.model_validate(GAIT | {"lift": 0.1}))


def test_feet_may_slide_without_being_lifted(spec):
    moved = feet_in_time(spec, reach=0.03)
    assert np.abs(moved[:, :, 2]).max() < 5e-3


def test_a_foot_of_two_spheres_is_one_foot(env_config, spec):
    config = env_config("a1_walk").robot
    heel = [sphere.model_copy(update={"center": [-0.05, 0.0, 0.0]}) for sphere in config.floating.spheres[:4]]
    floating = config.floating.model_copy(update={"spheres": [*config.floating.spheres, *heel]})
    more = RobotSpec.from_config(config.model_copy(update={"floating": floating}))
    gait = Gait.model_validate(GAIT)
    np.testing.assert_array_equal(joint_gait(gait, more).phase, joint_gait(gait, spec).phase)
