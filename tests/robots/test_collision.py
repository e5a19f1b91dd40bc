"""The capsules of a robot's YAML sit on the bodies that carry its links, and hold what the URDF gives these."""

import numpy as np
import pytest
import torch

from physai.compose import conf_dir
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.robots import ForwardKinematics, RobotConfig, RobotSpec
from physai.robots.shapes import collision_parts
from tests.composed import composed

FITTED = sorted(path.stem for path in (conf_dir() / "robot" / "collision").glob("*.yaml"))


def config_of(robot: str) -> RobotConfig:
    return validate(EnvConfig, composed(f"robot@env.robot={robot}").env).robot


def changed(config: RobotConfig, collision: dict | None) -> RobotSpec:
    return RobotSpec.from_config(RobotConfig.model_validate({**config.model_dump(), "collision": collision}))


@pytest.mark.parametrize("robot", FITTED)
def test_the_capsules_of_a_link_hold_its_shapes(robot):
    config = config_of(robot)
    assert config.collision is not None
    for link, parts in collision_parts(RobotSpec.from_config(config).urdf).items():
        points = np.concatenate(parts)
        distance = []
        for capsule in (capsule for capsule in config.collision.capsules if capsule.link == link):
            start, way = np.array(capsule.start), np.array(capsule.end) - capsule.start
            share = np.clip((points - start) @ way / max(way @ way, 1e-12), 0, 1)[:, None]
            distance.append(np.linalg.norm(points - start - share * way, axis=1) - capsule.radius)
        assert np.min(distance, axis=0).max() < -0.0005


@pytest.mark.parametrize("robot", FITTED)
def test_the_last_body_is_where_forward_kinematics_has_the_end_effector(robot):
    spec = RobotSpec.from_config(config_of(robot))
    positions = spec.sample(5, np.random.default_rng(0))
    tip = ForwardKinematics(spec)(torch.from_numpy(positions).float()).numpy()
    frames = spec.collision.motions.frames(positions)[-1]
    local = np.einsum("jin,jn->in", frames[:, :3], tip.T - frames[:, 3])  # of the tip in the last body's frame
    np.testing.assert_allclose(local, np.broadcast_to(local[:, :1], local.shape), atol=1e-5)


def test_a_robot_without_capsules_has_no_model():
    assert RobotSpec.from_config(config_of("planar_arm")).collision is None


def test_pairs_that_joints_which_are_held_cannot_move_are_left_out():
    capsules = config_of("kuka_iiwa7").collision
    spec = changed(config_of("kuka_iiwa"), capsules.model_dump())
    assert 0 < len(spec.collision.pairs) < len(capsules.pairs)
    assert {capsule.body for capsule in spec.collision.capsules} == {0, 1, 2}


CAPSULE = {"link": "panda_link1", "start": [0.0, 0.0, 0.0], "end": [0.0, 0.0, 0.1], "radius": 0.05}


@pytest.mark.parametrize(
    ("capsules", "pairs", "words"),
    [
        ([{**CAPSULE, "link": "panda_lnk1"}], [], "no link 'panda_lnk1'; did you mean 'panda_link1'?"),
        ([CAPSULE], [[0, 1]], "collision.pairs.0: [0, 1] must be places among the 1 capsules, from 0"),
        ([CAPSULE, {**CAPSULE, "link": "panda_link4"}], [[0, 1], [1, 0]], "collision: pairs: one is named twice"),
    ],
)
def test_capsules_that_cannot_be_are_refused_in_one_line(capsules, pairs, words):
    with pytest.raises(UserError) as caught:
        changed(config_of("panda"), {"capsules": capsules, "pairs": pairs})
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
