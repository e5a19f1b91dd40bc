"""What a robot looks like, and a goal that is dragged: without a browser."""

import asyncio
import io
import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from physai.deploy import read_metadata
from physai.envs.simulation import Simulation
from physai.errors import UserError
from physai.robots import ForwardKinematics, RobotSpec, kinematics_of
from physai.web import Appearance, GoalMarker, RobotScene, serve
from physai.web.appearance import robot_of
from physai.web.scene import on_the_spot


@pytest.mark.slow
def test_any_arm_has_something_to_show_of_each_body_that_moves_and_its_tip_is_where_kinematics_say(any_arm):
    spec = RobotSpec.from_config(any_arm.robot)
    look = Appearance.of_robot(spec)
    assert look.joints == len(spec.joints)
    assert all(body is not None and body[:4] == b"glTF" for body in look.bodies)
    position = spec.sample(1, np.random.default_rng(0))
    expected = ForwardKinematics(spec)(torch.from_numpy(position).float())[0].numpy()
    assert look.tip_position(position[0]) == pytest.approx(expected, abs=1e-5)


def test_any_legs_have_something_to_show_and_stand_on_the_floor_at_home(any_legged):
    spec = RobotSpec.from_config(any_legged.robot)
    look = Appearance.of_robot(spec)
    assert all(body is not None and body[:4] == b"glTF" for body in look.bodies)
    assert look.tip_position(spec.home) is None
    frames, lowest = look.frames(spec.home), np.inf
    for body, frame in zip(look.bodies, frames, strict=True):
        points = trimesh.load_scene(io.BytesIO(body), file_type="glb").to_mesh().vertices
        lowest = min(lowest, float((points @ frame[2, :3] + frame[2, 3]).min()))
    assert lowest + spec.floating.height == pytest.approx(look.floor, abs=0.02)


def test_a_base_that_floats_is_drawn_where_it_is_and_walks_on_the_spot(env_config):
    look = Appearance.of_robot(RobotSpec.from_config(env_config("a1_walk").robot))
    with serve("127.0.0.1", 0, "a1", look.reach) as server:
        robot = RobotScene(server, "robot", look, (1.0, 2.0, 0.0))
        robot.move_base(on_the_spot(np.array([5.0, 6.0, 0.3, 0.0, 0.0, 1.0, 0.0])))
        assert robot._base.position == pytest.approx([0.0, 0.0, 0.3])
        assert robot._base.wxyz == pytest.approx([0.0, 0.0, 0.0, 1.0])
        for bad in ([0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0], [2.0, 0.0, 0.0, 0.0]):
            robot.turn_base(np.array(bad), 0.3)
            robot.move_base(np.array([np.inf, 0.0, 0.3, *bad]))
        assert robot._base.wxyz == pytest.approx([0.0, 0.0, 0.0, 1.0])
        robot.turn_base(np.array([0.0, 1.05, 0.0, 0.0]), 0.3)
        assert robot._base.wxyz == pytest.approx([0.0, 0.0, 1.0, 0.0])
        assert robot._base.position == pytest.approx([0.0, 0.0, 0.6])  # its trunk, 0.3 m above, stays where it was


def test_a_policy_file_is_drawn_by_its_urdf_and_not_by_another(exported_run, monkeypatch):
    metadata = read_metadata(exported_run / "policy.pt")
    whole = Appearance.of_robot(robot_of(metadata))
    assert Appearance.of_policy(metadata).bodies == whole.bodies
    monkeypatch.setitem(metadata.raw["robot"], "urdf_sha256", "of another one")
    told = Appearance.of_policy(metadata)
    assert told.bodies != whole.bodies
    assert told.tip_position([0.3, 0.4]) == pytest.approx(whole.tip_position([0.3, 0.4]))


@pytest.mark.parametrize("env", ["kuka7_reach", "a1_walk"])  # by capsules, and by sticks
def test_a_policy_file_whose_urdf_is_elsewhere_is_drawn_by_what_it_tells(env_config, env):
    spec = RobotSpec.from_config(env_config(env).robot)
    told = {"collision": spec.collision, "kinematics": kinematics_of(spec)}
    look = Appearance.of_policy(SimpleNamespace(raw={"config": {}}, robot="a robot", **told))
    whole = Appearance.of_robot(spec)
    assert [body is not None for body in look.bodies].count(True) >= len(spec.joints)
    assert look.frames(spec.home) == pytest.approx(whole.frames(spec.home))
    assert (look.reach, look.floor) == (whole.reach, pytest.approx(whole.floor, abs=0.1))


@pytest.mark.slow
@pytest.mark.parametrize("env", ["reacher", "xarm_reach", "panda_pose"])
def test_a_goal_that_is_dragged_is_told_as_the_task_has_it(env_config, env):
    simulation = Simulation(env_config(env, "physics=mujoco"), 1, 0)
    simulation.close()
    spec, task = simulation.spec, simulation.task
    goal = simulation.task.sample_goal(1, simulation.generator)[0]
    look, told = Appearance.of_robot(spec), []
    with serve("127.0.0.1", 0, env, look.reach) as server:
        robot = RobotScene(server, "robot", look)
        marker = GoalMarker(
            robot, server, task.goal, task.tolerances, task.region, spec.home, lambda *event: told.append(event)
        )
        marker.show(goal)
        handle = marker._handle
        event = SimpleNamespace(target=handle, phase="update")
        asyncio.run(marker._dragged(event))
        asyncio.run(marker._dragged(SimpleNamespace(target=handle, phase="end")))
    assert [released for _, released in told] == [False, True]
    assert told[0][0] == pytest.approx(goal, abs=1e-6)


def test_numbers_that_are_none_leave_a_robot_as_it_is_and_too_few_are_refused(env_config):
    spec = RobotSpec.from_config(env_config("reacher").robot)
    with serve("127.0.0.1", 0, "reacher", 0.55) as server:
        robot = RobotScene(server, "robot", Appearance.of_robot(spec))
        robot.show(np.array([0.3, 0.4]))
        before = robot._bodies[2].position.copy()
        robot.show(np.array([np.nan, 0.4]))
        assert (robot._bodies[2].position == before).all()
        with pytest.raises(ValueError, match="2 joint positions are needed"):
            robot.show(np.zeros(3))


def test_a_port_that_is_taken_is_refused_in_one_line():
    with (
        serve("127.0.0.1", 0, "first", 1.0) as server,
        pytest.raises(UserError, match=r"cannot listen on 127\.0\.0\.1, port \d+: Address already in use"),
        serve("127.0.0.1", server.get_port(), "second", 1.0),
    ):
        pass


def test_no_client_can_have_the_page_shown_to_the_internet():
    with serve("127.0.0.1", 0, "page", 1.0) as server:
        assert server.request_share_url() is None
        assert server._share_tunnel is None


@pytest.mark.parametrize("ending", ["obj", "ply", "glb"])
def test_only_what_a_mesh_calls_metal_is_metal_and_it_keeps_its_colour(tmp_path, env_config, ending):
    """A page has no surroundings; metal, which reflects them, is black."""
    mesh = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    red = (200, 30, 30, 255)
    if ending == "ply":
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=[red] * 8)
    elif ending == "obj":
        paint = trimesh.visual.material.SimpleMaterial(diffuse=red)
        mesh.visual = trimesh.visual.TextureVisuals(np.zeros((8, 2)), paint)
    else:
        steel = trimesh.visual.material.PBRMaterial(baseColorFactor=red, metallicFactor=0.9)
        mesh.visual = trimesh.visual.TextureVisuals(material=steel)
    mesh.export(tmp_path / f"hand.{ending}")
    read = trimesh.load_scene(tmp_path / f"hand.{ending}").dump()
    spec = RobotSpec.from_config(env_config("reacher").robot)
    look = Appearance.of_shapes(kinematics_of(spec), [read, [], []])
    tree = json.loads(look.bodies[0][20 : 20 + struct.unpack("<I", look.bodies[0][12:16])[0]])
    (part,) = tree["meshes"][0]["primitives"]
    material = tree["materials"][part["material"]]["pbrMetallicRoughness"]
    assert material["metallicFactor"] == (0.9 if ending == "glb" else 0.1)
    if ending == "ply":
        assert "COLOR_0" in part["attributes"]
    else:
        assert material["baseColorFactor"][:3] == pytest.approx([c / 255 for c in red[:3]], abs=0.01)
