"""Welded links are one body, as heavy and as hard to turn as its parts; inertias that cannot be are named."""

import dataclasses

import numpy as np
import pybullet as bullet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from physai.errors import UserError
from physai.robots import RobotConfig, RobotSpec, engine_urdf
from physai.robots.bodies import merge
from physai.robots.urdf import load, transform
from tests.composed import env_config
from tests.physics.conftest import ENGINES

LINK = (
    '<link name="{name}"><inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass}"/>{inertia}</inertial></link>'
)
BOX = '<inertia ixx="{}" ixy="0" ixz="0" iyy="{}" iyz="0" izz="{}"/>'
numbers = st.floats(-0.5, 0.5)
triples = st.tuples(numbers, numbers, numbers)


def config(env: str) -> RobotConfig:
    return env_config(env).robot


@pytest.fixture(scope="module")
def panda() -> RobotSpec:
    return RobotSpec.from_config(config("panda_reach"))


def text(values) -> str:
    return " ".join(map(repr, values))


def two_links(folder, place=(0, 0, 0), turn=(0, 0, 0), com=(0, 0, 0), second=(0.2, 0.3, 0.4)):
    """A base and a link that turns, on which a second one is welded."""
    first = LINK.format(name="first", xyz="0.1 0 0", rpy="0 0 0", mass=2.0, inertia=BOX.format(0.02, 0.03, 0.04))
    welded = LINK.format(name="welded", xyz=text(com), rpy=text(turn), mass=1.5, inertia=BOX.format(*second))
    path = folder / "robot.urdf"
    path.write_text(
        f'<robot name="r"><link name="base"/>{first}{welded}<link name="tip"/>'
        '<joint name="turns" type="revolute"><parent link="base"/><child link="first"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="5" velocity="3"/></joint>'
        f'<joint name="weld" type="fixed"><parent link="first"/><child link="welded"/>'
        f'<origin xyz="{text(place)}" rpy="{text(turn)}"/></joint>'
        '<joint name="mount" type="fixed"><parent link="welded"/><child link="tip"/><origin xyz="0 0 0.1"/></joint>'
        "</robot>"
    )
    return path


@settings(max_examples=50)
@given(place=triples, turn=triples, com=triples)
def test_a_body_turns_about_any_axis_as_its_parts_do(tmp_path_factory, place, turn, com):
    path = two_links(tmp_path_factory.mktemp("robot"), place, turn, com)
    base, body, tip = merge(path, load(path), ("turns",), "tip", {})
    assert (base.name, body.name, tip.name) == ("base", "first", "tip")
    assert (base.mass, body.mass, tip.mass) == (0.0, 3.5, 0.0)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = Rotation.from_euler("xyz", turn).as_matrix(), place
    centres = np.array([0.1, 0, 0]), frame[:3, :3] @ com + frame[:3, 3]
    np.testing.assert_allclose(body.com, (2 * centres[0] + 1.5 * centres[1]) / 3.5, atol=1e-12)
    twice = frame[:3, :3] @ Rotation.from_euler("xyz", turn).as_matrix()  # the link's, then its inertia's own
    parts = np.diag([0.02, 0.03, 0.04]), twice @ np.diag([0.2, 0.3, 0.4]) @ twice.T
    for axis in np.eye(3):
        about = sum(
            axis @ inertia @ axis + mass * np.sum(np.cross(axis, centre - body.com) ** 2)
            for mass, centre, inertia in zip((2.0, 1.5), centres, parts, strict=True)
        )
        assert axis @ body.inertia @ axis == pytest.approx(about, abs=1e-10)
    np.testing.assert_allclose(tip.origin, frame @ transform(tip.joint.origin), atol=1e-12)


def test_the_arm_weighs_what_its_links_weigh_and_engines_simulate_only_what_moves(panda):
    told = config("panda_reach").inertials
    assert panda.link_mass.sum() == pytest.approx(sum(inertial.mass for inertial in told.values()))
    assert [body.name for body in panda.bodies] == ["panda_link0", *panda.moving_links, "panda_grasptarget"]
    assert panda.moving_links == tuple(f"panda_link{number}" for number in range(1, 8))


@pytest.mark.parametrize("engine", ["pybullet", "impulse"])
def test_an_arm_of_bodies_holds_a_payload_at_its_tip_as_heavy_as_it_is(panda, engine):
    physics = ENGINES[engine](panda, 2, 0.02)
    parameters = physics.parameters()
    parameters["payload"] = np.array([[0.0], [2.5]])
    physics.reset(np.arange(2), physics.robot_state(), parameters)
    np.testing.assert_allclose(physics.parameters()["payload"], parameters["payload"])
    np.testing.assert_allclose(physics.parameters()["link_mass"], parameters["link_mass"], atol=1e-12)
    # Without effort the heavier arm falls no slower, and otherwise: the payload is felt.
    parameters["effort_limit"] = np.full((2, 7), 1e-9)
    physics.reset(np.arange(2), physics.robot_state(), parameters)
    for _ in range(5):
        state = physics.step(np.zeros((2, 7)))
    assert np.abs(state.joint_velocity[0] - state.joint_velocity[1]).max() > 0.02
    physics.close()


def test_the_urdf_for_engines_places_every_body_where_the_robot_s_own_does(panda, tmp_path):
    (tmp_path / "engine.urdf").write_bytes(engine_urdf(panda.bodies, panda.joints))
    client = bullet.connect(bullet.DIRECT)
    places = []
    for path in (panda.urdf, tmp_path / "engine.urdf"):
        robot = bullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        infos = [bullet.getJointInfo(robot, i, client) for i in range(bullet.getNumJoints(robot, client))]
        joints, links = ({info[key].decode(): info[0] for info in infos} for key in (1, 12))
        for name, value in zip(panda.joints, panda.home.tolist(), strict=True):
            bullet.resetJointState(robot, joints[name], value, physicsClientId=client)
        names = [body.name for body in panda.bodies[1:]]
        states = [bullet.getLinkState(robot, links[name], 0, 1, client) for name in names]
        places.append([(*state[4], *np.abs(state[5])) for state in states])
    bullet.disconnect(client)
    np.testing.assert_allclose(places[0], places[1], atol=1e-6)


def test_an_inertia_that_no_body_can_have_names_its_link(tmp_path):
    path = two_links(tmp_path, second=(0.1, 0.1, 0.3))
    with pytest.raises(
        UserError, match=r"link 'welded' moves but its inertia is none that a body can have.*'inertials'"
    ):
        merge(path, load(path), ("turns",), "tip", {})


def test_what_the_yaml_says_of_a_link_counts_and_a_link_that_is_not_there_is_named():
    changed = config("panda_reach").model_dump()
    changed["inertials"]["panda_hand"]["mass"] += 1.0
    heavier = RobotSpec.from_config(RobotConfig.model_validate(changed))
    assert heavier.link_mass[-1] == pytest.approx(RobotSpec.from_config(config("panda_reach")).link_mass[-1] + 1.0)
    changed["inertials"]["panda_hnd"] = changed["inertials"].pop("panda_hand")
    with pytest.raises(UserError, match=r"inertials: .* has no link 'panda_hnd'; did you mean 'panda_hand'\?"):
        RobotSpec.from_config(RobotConfig.model_validate(changed))


def test_dummy_inertias_are_doubted_by_name_and_those_that_the_yaml_gives_are_not(panda):
    assert panda.doubtful == ()
    bare = RobotConfig.model_validate(config("panda_reach").model_dump() | {"inertials": {}})
    (line,) = RobotSpec.from_config(bare).doubtful
    assert "panda_link1" in line
    assert "dummy" in line
    assert "inertials" in line


def test_the_xarm_s_own_inertias_are_refused():
    bare = RobotConfig.model_validate(config("xarm_reach").model_dump() | {"inertials": {}})
    with pytest.raises(UserError, match="link 'link3' moves but its inertia is none that a body can have"):
        RobotSpec.from_config(bare)


@pytest.mark.parametrize("env", ["panda_reach", "kuka7_reach", "xarm_reach"])
def test_arms_stand_still_without_a_command(env):
    spec = RobotSpec.from_config(config(env))
    for engine in ENGINES:
        physics = ENGINES[engine](spec, 1, 0.02)
        for _ in range(50):
            state = physics.step(np.zeros((1, len(spec.joints))))
        np.testing.assert_allclose(state.joint_position[0], spec.home, atol=0.02)
        physics.close()


def test_an_engine_that_refuses_a_body_names_it(panda):
    lopsided = dataclasses.replace(panda.bodies[2], inertia=np.diag([0.1, 0.1, 0.9]))
    broken = dataclasses.replace(panda, bodies=(*panda.bodies[:2], lopsided, *panda.bodies[3:]))
    with pytest.raises(UserError, match=r"MuJoCo cannot load it: .*panda_link2"):
        ENGINES["impulse"](broken, 1, 0.02)
