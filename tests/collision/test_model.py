"""Distances of a robot's capsules, and their way through a file."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from physai.collision import Box, Capsule, CollisionModel, Motions


def turning(*offsets: tuple[float, float, float]) -> Motions:
    """Joints about z, each at an offset from the one before."""
    constant, cosine, sine = np.zeros((3, len(offsets), 4, 4))
    constant[:, 2, 2] = constant[:, 3, 3] = 1.0
    constant[:, :3, 3] = offsets
    cosine[:, 0, 0] = cosine[:, 1, 1] = sine[:, 1, 0] = 1.0
    sine[:, 0, 1] = -1.0
    return Motions(constant, cosine, sine)


def arm() -> CollisionModel:
    """A post, and two links of 0.5 m, 3 cm thick; the fingertip is a ball."""
    capsules = (
        Capsule("post", 0, (-0.3, 0.0, 0.0), (-0.3, 0.0, 0.4), 0.05),
        Capsule("upper", 1, (0.0, 0.0, 0.2), (0.5, 0.0, 0.2), 0.03),
        Capsule("fore", 2, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), 0.03),
        Capsule("tip", 2, (0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 0.04),
    )
    return CollisionModel(turning((0.0, 0.0, 0.0), (0.5, 0.0, 0.2)), capsules, ((0, 2), (0, 3), (3, 1)))


def random_positions(rows: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (rows, 2))


def test_distances_are_between_surfaces():
    stretched, folded = arm().distance(np.array([[0.0, 0.0], [0.0, np.pi]]))
    np.testing.assert_allclose(stretched, [0.8 - 0.08, 1.3 - 0.09, 0.5 - 0.07], atol=1e-12)
    np.testing.assert_allclose(folded, [0.3 - 0.08, 0.3 - 0.09, -0.07], atol=1e-9)
    assert arm().names == (("post", "fore"), ("post", "tip"), ("tip", "upper"))


def test_each_robot_of_a_batch_has_the_distances_that_it_has_alone():
    model = arm().within(floor=0.0, boxes=[Box("table", (0.6, 0.0, 0.1), (0.2, 0.3, 0.05))])
    positions = random_positions(700)  # more than one block
    alone = np.concatenate([model.distance(row[np.newaxis]) for row in positions])
    np.testing.assert_allclose(model.distance(positions), alone, atol=1e-8)
    assert model.distance(positions[:0]).shape == (0, len(model.names))


def test_what_a_joint_moves_is_held_against_the_floor_and_each_box():
    table, lamp = Box("table", (0.7, 0.0, 0.1), (0.1, 0.1, 0.02)), Box("lamp", (0.0, 0.8, 0.2), (0.1, 0.1, 0.1))
    model = arm().within(floor=0.1, boxes=[table, lamp])
    links = ("upper", "fore", "tip")
    assert model.names == (*arm().names, *((link, other) for other in ("floor", "table", "lamp") for link in links))
    found = dict(zip(model.names, model.distance(np.zeros((1, 2)))[0], strict=True))
    assert found["upper", "floor"] == pytest.approx(0.1 - 0.03)
    assert found["tip", "floor"] == pytest.approx(0.1 - 0.04)
    assert found["fore", "table"] == pytest.approx(0.08 - 0.03)
    assert found["upper", "table"] == pytest.approx(np.hypot(0.1, 0.08) - 0.03)
    turned = dict(zip(model.names, model.distance(np.array([[np.pi / 2, 0.0]]))[0], strict=True))
    assert turned["fore", "lamp"] == pytest.approx(-0.03)  # its axis is within
    assert arm().within(floor=None).names == arm().names


def test_a_robot_on_which_nothing_can_meet_has_no_distances():
    model = CollisionModel(turning((0.0, 0.0, 0.0)), arm().capsules[:2], ())
    assert model.distance(np.zeros((3, 1))).shape == (3, 0)


def test_a_model_comes_back_from_json_as_it_was():
    model = arm().within(floor=-0.1, boxes=[Box("table", (0.6, 0.0, 0.1), (0.2, 0.3, 0.05))])
    again = CollisionModel.from_description(json.loads(json.dumps(model.describe(), allow_nan=False)))
    assert (again.capsules, again.pairs, again.floor, again.boxes) == (
        model.capsules,
        model.pairs,
        model.floor,
        model.boxes,
    )
    np.testing.assert_array_equal(again.distance(random_positions(9)), model.distance(random_positions(9)))


def _set(described: dict, path: list, value: object) -> None:
    for key in path[:-1]:
        described = described[key]
    described[path[-1]] = value


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["floor"], float("nan"), "floor must be 1 finite number"),
        (["pairs"], [[0, 4]], "two indices of the 4 capsules"),
        (["pairs"], [[0, -1]], "two indices of the 4 capsules"),
        (["pairs"], [[0, 1.0]], "two indices of the 4 capsules"),
        (["pairs"], [[0, 1, 2]], "two indices of the 4 capsules"),
        (["pairs"], [0], "a list of two indices"),
        (["pairs"], [[2, 3]], "'fore' and 'tip' of [2, 3] are on the same body"),
        (["pairs"], [[0, 2], [2, 0]], "one is named twice"),
        (["pairs"], {"0": 1}, "pairs must be a list"),
        (["capsules"], None, "capsules must be a list"),
        (["capsules", 1], [], "capsules[1]: it must hold link, body"),
        (["capsules", 1, "body"], 3, "capsule of 'upper': there are bodies 0 to 2, not 3"),
        (["capsules", 1, "body"], -1, "a whole number from 0 on"),
        (["capsules", 1, "body"], True, "a whole number from 0 on"),
        (["capsules", 1, "radius"], 0.0, "must be positive"),
        (["capsules", 1, "radius"], "thick", "radius must be 1 finite number"),
        (["capsules", 1, "start"], [0.0, 0.0], "start must be 3 finite numbers"),
        (["capsules", 1, "end"], [0.0, 0.0, float("inf")], "end must be 3 finite numbers"),
        (["capsules", 1, "link"], 7, "link must be a text"),
        (["boxes"], [{"name": "table"}], "boxes[0]: it must hold name, center, half_size"),
        (["boxes"], [{"name": "a", "center": [0, 0, 0], "half_size": [1, 1, 0]}], "half_size must be positive"),
        (["motions"], None, "motions: it must hold constant, cosine, sine"),
        (["motions", "sine"], [[1.0]], "sine must be 4 x 4 for each joint"),
        (["motions", "sine"], [[[0.0] * 4] * 4], "are of (2, 2, 1) joints"),
        (["motions", "sine"], "flat", "sine is no array of numbers"),
        (["motions", "sine", 0, 0, 0], float("nan"), "sine has a number that is not finite"),
        (["more"], 1, "collision: it must hold motions, capsules, pairs, floor, boxes, not"),
    ],
)
def test_what_no_model_can_be_is_refused_in_one_line(path, value, words):
    described = arm().describe()
    _set(described, path, value)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        CollisionModel.from_description(described)
    assert len(str(caught.value).splitlines()) == 1


def test_it_needs_numpy_alone():
    code = "import sys, physai.collision; assert not {'torch', 'pydantic', 'scipy', 'pybullet'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
