"""The collision guard: an arm whose policy knows nothing of its links does not touch itself, nor what stands around."""

import numpy as np
import pytest
import torch
from torch import Tensor

from physai.collision import Box
from physai.deploy import Controller, ControllerConfig, Goal, JointState, State, load_policy
from physai.deploy.guard import CollisionGuard
from physai.errors import UserError
from physai.physics import RobotState
from physai.physics.mujoco import MuJoCoPhysics
from physai.physics.shapes import ShapeCollisions
from physai.robots import RobotSpec
from physai.signals import Box as Bounds
from physai.signals import Quantity, Tolerance
from tests.composed import env_config
from tests.deploy.scripted import of_joints, policy_file

DT = 0.02
FAST = {"max_velocity": 1.5, "max_acceleration": 20.0, "limit_margin": 0.3, "progress_timeout": 1e3}


class GoesStraight(torch.nn.Module):
    """Drives each joint to its goal by the shortest way, whatever is in it."""

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return torch.clamp(5.0 * (goal - joint_position), -2.0, 2.0)

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return (goal - joint_position).abs().max(dim=1, keepdim=True)[0]


@pytest.fixture(scope="module")
def panda() -> RobotSpec:
    return RobotSpec.from_config(env_config("panda_reach").robot)


@pytest.fixture(scope="module")
def policies(panda, tmp_path_factory):
    """With the arm's capsules, and without."""
    n = len(panda.joints)
    inputs = [
        of_joints(*names, panda.joints)
        for names in (
            ("joint_position", "joint_position"),
            ("joint_velocity", "joint_velocity"),
            ("goal", "joint_position"),
        )
    ]
    outputs = [of_joints("joint_velocity_command", Quantity.JOINT_VELOCITY, panda.joints)]
    parts = (
        GoesStraight(),
        panda.joints,
        inputs,
        outputs,
        Bounds((-4.0,) * n, (4.0,) * n),
        [Tolerance("worst", "rad", 0.05)],
    )
    loaded = []
    for collision in (panda.collision, None):
        path = tmp_path_factory.mktemp("policy") / "policy.pt"
        path.write_bytes(policy_file(*parts, collision, panda.home))
        loaded.append(load_policy(path))
    return loaded


def drive(policy, panda, config, ticks, seed=0, goals=None):
    """Drive from goal to goal among all configurations; return where the arm was, [T, n], and the controller."""
    controller = Controller(policy, ControllerConfig(**FAST, **config), lambda: 0.0)
    physics = MuJoCoPhysics(panda, 1, DT, motor="impulse", motor_time_constant=0.015, threads=1)
    random, visited, state = np.random.default_rng(seed), [], physics.robot_state()
    for tick in range(ticks):
        goal = None
        if tick % 100 == 10:
            goal = Goal(
                panda.sample(1, random)[0] if goals is None else goals[(tick // 100) % len(goals)], names=panda.joints
            )
        heard = JointState(panda.joints, state.joint_position[0], state.joint_velocity[0], stamp=tick * DT)
        command = controller.update(tick * DT, heard, goal)
        state = physics.step(np.zeros((1, 7)) if command.value is None else command.value[None])
        visited.append(state.joint_position[0])
    physics.close()
    return np.array(visited), controller


@pytest.mark.slow
def test_an_arm_that_would_touch_itself_or_the_floor_does_not(policies, panda):
    guarded, blind = policies
    judge = ShapeCollisions(panda, floor=0.0)
    without, _ = drive(blind, panda, {}, 3000)
    assert judge.touching(without[::3]).any()
    visited, controller = drive(guarded, panda, {"floor": (0.0,)}, 3000)
    assert not judge.touching(visited).any()
    assert controller.snapshot()["counters"]["ticks held back by the collision guard"] > 100
    assert controller.snapshot()["counters"]["goals"] == 30
    assert np.ptp(visited, axis=0).min() > 0.5  # it did move
    judge.close()


def folded(panda):
    """A configuration in which the hand is in the arm, and home; neither is near a limit."""
    samples = panda.sample(2000, np.random.default_rng(3))
    deepest = panda.collision.distance(samples).min(axis=1).argmin()
    return samples[deepest]


@pytest.mark.fault(
    "a motion would bring two links within `collision_margin` (1 cm) of each other, of the floor or of a box, within "
    "`stopping_time` (0.12 s)"
)
def test_what_it_holds_back_it_says_by_the_names_of_both_links_and_away_is_free(policies, panda):
    visited, controller = drive(policies[0], panda, {}, 400, goals=[folded(panda)])
    now = 400 * DT
    assert controller.snapshot()["state"] == State.HOLD.value
    reason = controller.snapshot()["reasons"][-1]
    assert "would come within" in reason
    assert sum(name.link in reason for name in panda.collision.capsules) >= 2
    heard = JointState(panda.joints, visited[-1], np.zeros(7), stamp=now)
    home = controller.update(now, heard, Goal(panda.home, names=panda.joints))
    assert home.state is State.ACTIVE
    assert np.abs(home.value).max() > 0.0


def test_an_arm_slides_past_what_is_on_the_side_of_its_way(policies, panda):
    post = (0.316, 0.173, 0.42, 0.06, 0.06, 0.06)  # the hand hits its upper edge as the arm turns
    beyond = panda.home + np.eye(7)[0]
    judge = ShapeCollisions(panda, boxes=[Box("post", post[:3], post[3:])])
    free, _ = drive(policies[0], panda, {}, 200, goals=[beyond])
    past, controller = drive(policies[0], panda, {"boxes": post}, 300, goals=[beyond])
    assert judge.touching(free).any()
    assert not judge.touching(past).any()
    assert controller.snapshot()["state"] == State.REACHED.value
    assert controller.snapshot()["counters"]["ticks held back by the collision guard"] > 10
    judge.close()


def test_what_stands_in_the_middle_of_the_way_stops_the_arm(policies, panda):
    visited, controller = drive(policies[0], panda, {}, 400, goals=[folded(panda)])
    assert controller.snapshot()["state"] == State.HOLD.value
    assert np.abs(np.diff(visited[-20:], axis=0)).max() < 1e-3
    assert panda.collision.distance(visited).min() > 0.0


def test_neighbours_that_are_always_close_may_come_closer_than_the_margin(policies, panda):
    guard, names = CollisionGuard(policies[0].metadata, ControllerConfig()), panda.collision.names
    at_home = panda.collision.distance(panda.home[None])[0]
    assert {names[row] for row in np.flatnonzero(at_home < 0.02)} == {("panda_link5", "panda_link7")}
    position, fold = panda.home.copy(), np.eye(7)[5] * -0.01  # joint 6
    while guard.apply(fold, position, lambda velocity: (velocity, None))[1] is None:
        position += fold
    assert 0.0 < panda.collision.distance(position[None]).min() < 0.01
    assert position[5] < panda.home[5] - 0.3


def test_boxes_and_floor_are_kept_clear_of(policies, panda):
    wall = (0.45, 0.0, 0.4, 0.05, 0.5, 0.4)  # in front of the arm
    stretched = np.array([0.0, 0.8, 0.0, -0.8, 0.0, 1.6, 0.785])
    free, _ = drive(policies[0], panda, {}, 200, goals=[stretched])
    held, controller = drive(policies[0], panda, {"boxes": wall}, 200, goals=[stretched])
    judge = ShapeCollisions(panda, boxes=[Box("wall", wall[:3], wall[3:])])
    assert judge.touching(free[-1:]).all()
    assert not judge.touching(held).any()
    assert "'box 1'" in controller.snapshot()["reasons"][-1]
    judge.close()


def test_without_capsules_nothing_is_held_back_and_a_box_cannot_be_asked_for(policies, panda):
    visited, _ = drive(policies[1], panda, {}, 150, goals=[folded(panda)])
    assert panda.collision.distance(visited[-1:]).min() < 0.0
    with pytest.raises(UserError, match="the policy file has no capsules of its robot"):
        Controller(policies[1], ControllerConfig(**FAST, floor=(0.0,)))


@pytest.mark.parametrize(
    ("config", "line"),
    [
        ({"boxes": (1.0, 2.0)}, "boxes: 6 numbers a box are needed, got 2"),
        ({"boxes": (0.0, 0.0, 0.0, 1.0, 1.0, -1.0)}, "boxes: box 'box 1': its half_size must be positive"),
        ({"floor": (0.0, 1.0)}, "floor: one height is needed, or none"),
    ],
)
def test_surroundings_that_make_no_sense_are_one_line(policies, config, line):
    with pytest.raises(UserError, match=line):
        Controller(policies[0], ControllerConfig(**FAST, **config))


def test_a_point_in_the_base_the_floor_or_a_box_is_named(panda):
    model = panda.collision.within(floor=0.0, boxes=[Box("shelf", (0.5, 0.0, 0.5), (0.1, 0.1, 0.1))])
    assert model.inside(np.array([0.0, 0.0, 0.05])) == "panda_link0"
    assert model.inside(np.array([0.5, 0.0, -0.01])) == "floor"
    assert model.inside(np.array([0.55, 0.0, 0.45])) == "shelf"
    assert model.inside(np.array([0.5, 0.3, 0.5])) is None


def test_positions_that_are_not_finite_reach_no_guard(policies, panda):
    controller = Controller(policies[0], ControllerConfig(**FAST), lambda: 0.0)
    command = controller.update(0.0, JointState(panda.joints, np.full(7, np.nan), np.zeros(7), stamp=0.0))
    assert command.value is None
    assert RobotState(panda.home[None], np.zeros((1, 7))).joint_position.shape == (1, 7)
