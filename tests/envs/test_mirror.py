"""The mirror image of a robot on legs: it moves as the robot does, on the other side."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from physai.envs.mirror import MirrorImage
from physai.envs.simulation import Simulation
from physai.robots import Mirror
from physai.transforms.normalization import Normalizer
from tests.composed import randomization

ROBOTS = 8


@pytest.fixture(scope="module")
def pair(env_config):
    """Robots that differ, and what shall be their mirror images."""
    config = env_config("a1_walk", "physics=mujoco", "env.start.spread=0")
    made = [Simulation(config, ROBOTS, seed=0) for _ in range(2)]
    yield made
    for simulation in made:
        simulation.close()


def image_of(simulation, **frames):
    mirror = MirrorImage(simulation, Normalizer(45, 10.0))
    told = {**simulation.sense(), **simulation.true_base(), **frames}
    told = {name: torch.from_numpy(np.asarray(value)).float() for name, value in told.items()}
    return mirror(TensorDict(told, [ROBOTS]))


def test_robots_that_are_mirrored_and_told_the_mirrored_move_as_the_mirror_image(pair):
    robots, others = pair
    draws = randomization("default")
    parameters = draws.sample(ROBOTS, robots.layout, torch.Generator().manual_seed(0)).numpy()
    columns = robots.layout.columns
    parameters[:, columns["push"]] = 0.0
    robots.reset(parameters=parameters)
    mirrored = image_of(robots, physics_parameters=parameters)["physics_parameters"].numpy()
    # The base of an A1 is heavier on its left; that of these on their right.
    mirrored[:, columns["center_of_mass"].start + 1] -= 2.0 * robots.spec.bodies[0].com[1]
    others.reset(parameters=mirrored)
    others.aim(image_of(robots)["goal"].numpy())
    random = np.random.default_rng(0)
    for _ in range(20):
        action = random.uniform(-0.3, 0.3, (ROBOTS, 12)).astype(np.float32)
        image = image_of(robots, action=action)
        others.step(image["action"].numpy())
        robots.step(action)
    expected, found = image_of(robots), others.sense() | others.true_base()
    own = robots.sense() | robots.true_base()
    for name in (
        "joint_position",
        "joint_velocity",
        "gravity",
        "angular_velocity",
        "base_velocity",
        "last_action",
    ):  # as far as the engine's own rounding grows
        off = np.abs(found[name] - expected[name].numpy()).mean()
        assert off < 0.2 * np.abs(found[name] - own[name]).mean(), name
    np.testing.assert_allclose(others.episode_rewards, robots.episode_rewards, atol=0.05)


def test_the_gait_of_the_mirror_image_is_its_image(pair):
    robots, _ = pair
    robots.reset()
    robots.aim(np.tile(np.float32([[0.5, 0.2, -0.3]]), (ROBOTS, 1)))
    clock = np.linspace(0.0, robots.task.module.period, ROBOTS, endpoint=False)[:, None]
    image, mirror = image_of(robots, clock=clock), Mirror.of(robots.spec)
    told = {name: torch.from_numpy(value).float() for name, value in robots.sense().items()}
    told["clock"] = torch.from_numpy(clock).float()
    _, features = robots.task.module(*(told[name] for name in (*robots.task.module.senses, "goal")))
    suggested = features[:, -12:].numpy()
    np.testing.assert_allclose(image["features"][:, -12:], suggested[:, mirror.order] * mirror.sign, atol=1e-4)
    assert np.abs(suggested).max() > 0.3


def test_the_parameters_of_the_mirror_image_are_those_of_the_other_side(pair):
    robots, _ = pair
    parameters = np.random.default_rng(0).uniform(0.1, 1.0, (ROBOTS, len(robots.layout.nominal)))
    relative = robots.layout.relative(parameters)
    image = image_of(robots, physics_parameters=parameters, relative_parameters=relative)
    found, columns = image["physics_parameters"].numpy(), robots.layout.columns
    np.testing.assert_allclose(image["relative_parameters"], robots.layout.relative(found), rtol=1e-4, atol=1e-4)
    right, left = slice(0, 3), slice(3, 6)  # the front legs
    offset, effort = columns["encoder_offset"], columns["effort_limit"]
    np.testing.assert_allclose(found[:, offset][:, left], parameters[:, offset][:, right] * [-1.0, 1.0, 1.0], rtol=1e-5)
    np.testing.assert_allclose(found[:, effort][:, left], parameters[:, effort][:, right], rtol=1e-5)
    names, mass = list(robots.spec.moving_links), columns["link_mass"].start
    np.testing.assert_allclose(
        found[:, mass + names.index("FL_lower")], parameters[:, mass + names.index("FR_lower")], rtol=1e-5
    )
    np.testing.assert_allclose(found[:, columns["payload"]], parameters[:, columns["payload"]], rtol=1e-5)


def test_the_image_of_the_image_is_what_was_there(pair):
    robots, _ = pair
    robots.reset()
    frames = TensorDict({name: torch.from_numpy(value).float() for name, value in robots.sense().items()}, [ROBOTS])
    frames["past_actions"] = torch.rand(ROBOTS, 48)
    frames["physics_parameters"] = torch.rand(ROBOTS, len(robots.layout.nominal))
    mirror = MirrorImage(robots, Normalizer(45, 10.0))
    twice = mirror(mirror(frames))
    for name in frames.keys():  # noqa: SIM118 (of a TensorDict)
        torch.testing.assert_close(twice[name], frames[name], atol=1e-6, rtol=1e-6)
