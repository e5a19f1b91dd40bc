import numpy as np
import pybullet as bullet
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from physai.robots import (
    EndEffector,
    ForwardKinematics,
    RobotConfig,
    RobotSpec,
    angle_between,
    quaternion_matrix,
    rotation_vector,
)
from physai.robots.urdf import resolve

SEVEN = [f"lbr_iiwa_joint_{number}" for number in range(1, 8)]


@pytest.fixture(scope="module")
def spec(any_arm):
    return RobotSpec.from_config(any_arm.robot)


def first_joints(config: RobotConfig, joints: int) -> RobotSpec:
    """A KUKA that drives as many of its joints."""
    changes = {"joints": SEVEN[:joints], "home": [0.0] * joints, "command_limit": [0.5] * joints}
    return RobotSpec.from_config(RobotConfig.model_validate({**config.model_dump(), **changes}))


def link_positions(spec: RobotSpec, joint_position: np.ndarray) -> np.ndarray:
    """Where PyBullet puts the frame of the end effector in the robot's own URDF; all other joints are at zero."""
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(spec.urdf), useFixedBase=True, physicsClientId=client)
        infos = [bullet.getJointInfo(body, index, client) for index in range(bullet.getNumJoints(body, client))]
        joints = {info[1].decode(): info[0] for info in infos}
        links = {info[12].decode(): info[0] for info in infos}
        positions = []
        for row in joint_position.tolist():
            for name, value in zip(spec.joints, row, strict=True):
                bullet.resetJointState(body, joints[name], value, physicsClientId=client)
            state = bullet.getLinkState(
                body, links[spec.end_effector], computeForwardKinematics=1, physicsClientId=client
            )
            positions.append(state[4])
        return np.array(positions)
    finally:
        bullet.disconnect(client)


def reference(spec: RobotSpec, joint_position: np.ndarray) -> np.ndarray:
    """The textbook product of homogeneous matrices in float64, [3]."""
    angles = dict(zip(spec.joints, joint_position, strict=True))
    pose = np.eye(4)
    for joint in spec.linkage:
        if joint.origin is not None:
            before = np.eye(4)
            before[:3, :3] = Rotation.from_euler("xyz", joint.origin.rpy).as_matrix()
            before[:3, 3] = joint.origin.xyz
            pose = pose @ before
        angle = angles.get(joint.name, 0.0)
        axis = np.array(joint.axis if joint.axis is not None and any(joint.axis) else (0.0, 0.0, 1.0))
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(4)
        turn[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        pose = pose @ turn
    return pose[:3, 3]


def random_positions(rows: int, joints: int, seed: int = 0) -> torch.Tensor:
    return torch.empty(rows, joints).uniform_(-6.0, 6.0, generator=torch.Generator().manual_seed(seed))


def linearize(kinematics, joint_position):
    return kinematics.linearize(torch.cos(joint_position), torch.sin(joint_position))


def test_end_effector_is_where_pybullet_has_it_on_a_thousand_poses(spec):
    joint_position = random_positions(1000, len(spec.joints))
    found = ForwardKinematics(spec)(joint_position).numpy()
    np.testing.assert_allclose(found, link_positions(spec, joint_position.numpy()), rtol=0, atol=1e-5)


def test_a_joint_whose_urdf_names_no_axis_turns_about_x_as_pybullet_has_it(reacher, tmp_path):
    path = tmp_path / "arm.urdf"
    text = resolve(reacher.robot.urdf).read_text()
    assert text.count('<axis xyz="0 0 1"/>') == 2
    path.write_text(text.replace('<axis xyz="0 0 1"/>', "", 1))
    spec = RobotSpec.from_config(reacher.robot.model_copy(update={"urdf": str(path)}))
    joint_position = random_positions(100, 2)
    found = ForwardKinematics(spec)(joint_position).numpy()
    assert np.abs(found[:, 2]).max() > 0.1  # out of the plane
    np.testing.assert_allclose(found, link_positions(spec, joint_position.numpy()), rtol=0, atol=1e-5)


def test_only_the_direction_of_a_joint_s_axis_counts(reacher, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(resolve(reacher.robot.urdf).read_text().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 2"/>'))
    spec = RobotSpec.from_config(reacher.robot.model_copy(update={"urdf": str(path)}))
    joint_position = random_positions(20, 2)
    expected = ForwardKinematics(RobotSpec.from_config(reacher.robot))(joint_position)
    assert torch.equal(ForwardKinematics(spec)(joint_position), expected)


def test_all_seven_joints_of_the_kuka_match_pybullet(kuka_reacher):
    spec = first_joints(kuka_reacher.robot, 7)
    joint_position = random_positions(200, 7)
    found = ForwardKinematics(spec)(joint_position).numpy()
    np.testing.assert_allclose(found, link_positions(spec, joint_position.numpy()), rtol=0, atol=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_any_chain_of_turned_joints_matches_pybullet(tmp_path, seed):
    random = np.random.default_rng(seed)
    inertial = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    kinds = ["fixed", "revolute", "continuous", "fixed", "revolute", "revolute", "fixed"]
    parts = ['<link name="l0"/>']
    for index, kind in enumerate(kinds):
        axis = random.normal(size=3)
        axis /= np.linalg.norm(axis)
        xyz, rpy = random.uniform(-0.3, 0.3, 3), random.uniform(-1.5, 1.5, 3)
        text = [" ".join(f"{number:.12f}" for number in vector) for vector in (xyz, rpy, axis)]
        parts.append(
            f'<joint name="j{index}" type="{kind}"><parent link="l{index}"/><child link="l{index + 1}"/>'
            f'<origin xyz="{text[0]}" rpy="{text[1]}"/><axis xyz="{text[2]}"/>'
            f'<limit lower="-7" upper="7" effort="1" velocity="1"/></joint>'
            f'<link name="l{index + 1}">{inertial}</link>'
        )
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain">{"".join(parts)}</robot>')
    # joint j4 is left out: it is held at zero, in the middle of the chain
    config = RobotConfig(
        name="chain",
        urdf=str(path),
        joints=["j1", "j2", "j5"],
        end_effector="l7",
        home=[0.0] * 3,
        command="joint_velocity",
        action="speed",
        command_limit=[1.0] * 3,
        position_gain=20.0,
        servo=None,
        floating=None,
        limits=None,
        damping=None,
        friction=None,
        gravity=[0.0, 0.0, -9.81],
        armature=0.0,
        inertials={},
        collision=None,
    )
    spec = RobotSpec.from_config(config)
    joint_position = random_positions(50, 3, seed)
    found = ForwardKinematics(spec)(joint_position).numpy()
    np.testing.assert_allclose(found, link_positions(spec, joint_position.numpy()), rtol=0, atol=1e-5)


def test_slopes_equal_finite_differences_of_textbook_kinematics(spec):
    joint_position = random_positions(50, len(spec.joints), seed=1)
    slopes = linearize(ForwardKinematics(spec), joint_position)[:, :, :-1].mT.numpy()
    step = 1e-6
    for row, q in enumerate(joint_position.double().numpy()):
        for joint in range(len(spec.joints)):
            shift = step * np.eye(len(spec.joints))[joint]
            slope = (reference(spec, q + shift) - reference(spec, q - shift)) / (2 * step)
            np.testing.assert_allclose(slopes[row, joint], slope, rtol=0, atol=2e-6)


def test_slopes_equal_the_gradient_and_the_last_column_the_position(spec):
    kinematics = ForwardKinematics(spec).double()
    for q in random_positions(20, len(spec.joints), seed=2).double():
        columns = linearize(kinematics, q[None])[0]
        jacobian = torch.autograd.functional.jacobian(lambda q: kinematics(q[None])[0], q)
        torch.testing.assert_close(columns[:, :-1], jacobian, rtol=0, atol=1e-12)
        torch.testing.assert_close(columns[:, -1], kinematics(q[None])[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("rows", [0, 1, 7])
def test_scripted_kinematics_equals_eager_bit_for_bit(spec, rows):
    kinematics = ForwardKinematics(spec)
    scripted = torch.jit.script(kinematics)
    q = random_positions(rows, len(spec.joints))
    for _ in range(4):  # the profiling executor changes what it runs in the first calls
        assert torch.equal(scripted(q), kinematics(q))
        assert torch.equal(linearize(scripted, q), linearize(kinematics, q))
    assert kinematics(q).shape == (rows, 3)
    assert linearize(kinematics, q).shape == (rows, 3, len(spec.joints) + 1)


def test_reach_bounds_the_distance_from_the_first_joint_and_is_attained_by_the_planar_arm(reacher, kuka_reacher):
    for config in (reacher, kuka_reacher):
        spec = RobotSpec.from_config(config.robot)
        kinematics = ForwardKinematics(spec)
        shoulder = torch.tensor(spec.linkage[0].origin.xyz, dtype=torch.float32)
        distance = torch.linalg.vector_norm(kinematics(random_positions(1000, 2)) - shoulder, dim=-1)
        assert distance.max() <= kinematics.reach + 1e-6
    planar = ForwardKinematics(RobotSpec.from_config(reacher.robot))
    assert planar.reach == pytest.approx(0.55)
    torch.testing.assert_close(planar(torch.zeros(1, 2)), torch.tensor([[0.55, 0.0, 0.0]]))


def assert_same_in_numbers_and_arrays(spec):
    expected = ForwardKinematics(spec).double()
    end_effector = EndEffector(ForwardKinematics(spec))
    joint_position = random_positions(200, len(spec.joints), seed=3).double()
    q, positions = joint_position.numpy(), expected(joint_position).numpy()
    many = end_effector(q)
    assert many.shape == (200, 3)
    np.testing.assert_allclose(many, positions, rtol=0, atol=1e-12)
    one_by_one = [end_effector(row[None]) for row in q]
    np.testing.assert_allclose(np.concatenate(one_by_one), positions, rtol=0, atol=1e-12)


def test_the_end_effector_of_a_robot_is_to_the_last_bit_where_it_would_be_without_the_others(spec):
    end_effector = EndEffector(ForwardKinematics(spec))
    q = random_positions(64, len(spec.joints)).double().numpy()
    together = end_effector(q)
    for rows in (2, 3, 7):
        apart = [end_effector(q[first : first + rows]) for first in range(0, 63, rows)]
        np.testing.assert_array_equal(np.concatenate(apart)[:63], together[:63])


def test_the_end_effector_without_torch_is_that_of_the_module(spec):
    assert_same_in_numbers_and_arrays(spec)


@pytest.mark.parametrize("joints", [1, 7])
def test_the_end_effector_without_torch_is_that_of_the_module_for_any_number_of_joints(kuka_reacher, joints):
    assert_same_in_numbers_and_arrays(first_joints(kuka_reacher.robot, joints))


def turned(spec: RobotSpec, joint_position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where PyBullet puts the end effector, as a quaternion x, y, z, w, [N, 4], and its angular Jacobian, [N, 3, n]."""
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(spec.urdf), useFixedBase=True, physicsClientId=client)
        infos = [bullet.getJointInfo(body, index, client) for index in range(bullet.getNumJoints(body, client))]
        joints = {info[1].decode(): info[0] for info in infos}
        tip = {info[12].decode(): info[0] for info in infos}[spec.end_effector]
        free = [info[0] for info in infos if info[2] != bullet.JOINT_FIXED]
        columns = [free.index(joints[name]) for name in spec.joints]
        quaternions, jacobians = [], []
        for row in joint_position.tolist():
            angles = dict(zip((joints[name] for name in spec.joints), row, strict=True))
            for joint, value in angles.items():
                bullet.resetJointState(body, joint, value, physicsClientId=client)
            quaternions.append(bullet.getLinkState(body, tip, computeForwardKinematics=1, physicsClientId=client)[5])
            place = [angles.get(joint, 0.0) for joint in free]
            zeros = [0.0] * len(free)
            _, angular = bullet.calculateJacobian(body, tip, [0.0] * 3, place, zeros, zeros, client)
            jacobians.append(np.array(angular)[:, columns])
        return np.array(quaternions), np.array(jacobians)
    finally:
        bullet.disconnect(client)


def test_orientation_and_angular_jacobian_are_pybullet_s(spec):
    kinematics = torch.jit.script(ForwardKinematics(spec))
    low, high = np.nan_to_num(spec.position_limit, posinf=6.0, neginf=-6.0).T
    q = np.random.default_rng(0).uniform(low, high, (20, len(spec.joints)))
    joint_position = torch.from_numpy(q).float()
    linear, rotation, angular = kinematics.linearize_pose(torch.cos(joint_position), torch.sin(joint_position))
    quaternion, jacobian = turned(spec, q)
    np.testing.assert_allclose(rotation.numpy(), Rotation.from_quat(quaternion).as_matrix(), atol=2e-5)
    np.testing.assert_allclose(angular.numpy(), jacobian, atol=2e-5)
    assert torch.equal(linear, kinematics.linearize(torch.cos(joint_position), torch.sin(joint_position)))


def test_the_angular_jacobian_is_how_a_rotation_changes(spec):
    kinematics = ForwardKinematics(spec).double()
    q = torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, (1, len(spec.joints))))
    _, before, angular = kinematics.linearize_pose(torch.cos(q), torch.sin(q))
    for joint in range(len(spec.joints)):
        moved = q.clone()
        moved[0, joint] += 1e-6
        _, after, _ = kinematics.linearize_pose(torch.cos(moved), torch.sin(moved))
        np.testing.assert_allclose(rotation_vector(before, after)[0] / 1e-6, angular[0, :, joint], atol=1e-4)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_the_turn_between_two_rotations_is_the_shorter_way_for_a_quaternion_and_its_opposite(first, second):
    assume(np.linalg.norm(first) > 0.1)
    assume(np.linalg.norm(second) > 0.1)
    start, end = (quaternion_matrix(torch.tensor([q], dtype=torch.float64)) for q in (first, second))
    assert torch.equal(start, quaternion_matrix(-torch.tensor([first], dtype=torch.float64)))
    np.testing.assert_allclose(start[0], Rotation.from_quat(first).as_matrix(), atol=1e-9)
    expected = (Rotation.from_quat(second) * Rotation.from_quat(first).inv()).as_rotvec()
    angle = float(angle_between(start, end))
    assert angle == pytest.approx(np.linalg.norm(expected), abs=1e-6)
    if angle < np.pi - 0.03:
        np.testing.assert_allclose(rotation_vector(start, end)[0], expected, atol=1e-6)


def test_a_turn_jumps_nowhere_also_not_at_half_a_turn():
    angles = np.linspace(np.pi - 0.04, np.pi + 0.04, 801)
    ends = torch.from_numpy(Rotation.from_rotvec(np.outer(angles, [1.0, 0.0, 0.0])).as_matrix()).float()
    turns = rotation_vector(torch.eye(3).expand(801, 3, 3), ends)
    assert float(turns.diff(dim=0).abs().max()) < 0.02


def test_no_turn_and_half_a_turn_are_told_in_single_precision():
    same = quaternion_matrix(torch.tensor([[0.3, -0.2, 0.5, 0.1]]))
    assert torch.equal(rotation_vector(same, same), torch.zeros(1, 3))
    half = torch.bmm(quaternion_matrix(torch.tensor([[1.0, 0.0, 0.0, 0.0]])), same)
    assert float(angle_between(same, half)) == pytest.approx(np.pi, abs=1e-3)
