"""Capsules against PyBullet's own shapes: no collision is missed, and few configurations alarm falsely."""

import numpy as np
import pytest

from physai.collision import Box
from physai.physics.shapes import ShapeCollisions
from physai.robots import RobotSpec
from tests.robots.test_collision import FITTED, config_of

TABLE = Box("table", (0.55, 0.0, 0.2), (0.2, 0.3, 0.2))


@pytest.fixture
def judge():
    """Make worlds of shapes that are closed afterwards."""
    made = []

    def judge(*arguments, **surroundings) -> ShapeCollisions:
        made.append(ShapeCollisions(*arguments, **surroundings))
        return made[-1]

    yield judge
    for each in made:
        each.close()
        each.close()


@pytest.mark.slow
@pytest.mark.parametrize("surroundings", [{}, {"floor": 0.0, "boxes": [TABLE]}], ids=["alone", "at a table"])
@pytest.mark.parametrize("robot", FITTED)
def test_capsules_miss_no_collision_of_the_shapes_and_alarm_falsely_in_few_configurations(robot, surroundings, judge):
    spec = RobotSpec.from_config(config_of(robot))
    positions = spec.sample(2000, np.random.default_rng(3))
    touching = judge(spec, **surroundings).touching(positions)
    alarm = (spec.collision.within(**surroundings).distance(positions) <= 0).any(axis=1)
    assert 0.02 < touching.mean() < 0.6
    assert not (touching & ~alarm).any()
    assert (alarm & ~touching).mean() <= 0.08


@pytest.mark.parametrize("robot", FITTED)
def test_a_robot_at_home_touches_nothing(robot, judge):
    spec = RobotSpec.from_config(config_of(robot))
    shapes = judge(spec, floor=0.0)
    assert shapes.links(spec.home) == []
    assert spec.collision.within(floor=0.0).distance(spec.home[np.newaxis]).min() > 0


def test_the_links_that_touch_are_named(judge):
    spec = RobotSpec.from_config(config_of("xarm6"))
    down = spec.home.copy()
    down[1] = 2.0  # the upper arm leans forward until the hand is in the floor
    touching = judge(spec, floor=0.0, boxes=[TABLE]).links(down)
    assert ("link6", "floor") in touching
    model = spec.collision.within(floor=0.0, boxes=[TABLE])
    alarming = {
        names for names, apart in zip(model.names, model.distance(down[np.newaxis])[0], strict=True) if apart < 0
    }
    assert set(touching) <= alarming | {names[::-1] for names in alarming}


def test_distances_of_shapes_are_told_up_to_a_limit_and_never_less_than_those_of_capsules(judge):
    spec = RobotSpec.from_config(config_of("panda"))
    positions = spec.sample(50, np.random.default_rng(4))
    shapes = judge(spec)
    found = shapes.distance(positions, within=0.1)
    assert (found[np.isfinite(found)] <= 0.1).all()
    model = spec.collision
    apart = model.distance(positions)
    compared = 0
    for names, column in zip(shapes.names, found.T, strict=True):
        same = [place for place, pair in enumerate(model.names) if set(pair) == set(names)]
        if same:
            outside = np.isfinite(column) & (column > 0)
            assert (apart[outside][:, same].min(axis=1) <= column[outside] + 1e-3).all()
            compared += outside.sum()
    assert compared > 20
