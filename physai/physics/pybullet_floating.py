"""Robots whose base nothing holds, on a floor, in PyBullet; and joints that are springs."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pybullet as bullet

from physai.physics.interface import DynamicsParameters, RobotState
from physai.physics.rotation import rotate
from physai.robots import FloatingBase

_FLOOR, _ROBOT = 1, 2  # groups of what can touch; robots touch the floor, and nothing else


def put_on_floor(client: int, bodies: Sequence[int]) -> int:
    """Put a floor below robots, and let them touch it; its friction is 1, so that of the robots counts."""
    shape = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=(0, 0, 1), physicsClientId=client)
    floor = bullet.createMultiBody(baseCollisionShapeIndex=shape, physicsClientId=client)
    bullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
    bullet.setCollisionFilterGroupMask(floor, -1, _FLOOR, _ROBOT, client)
    for body in bodies:
        for link in range(-1, bullet.getNumJoints(body, client)):
            bullet.setCollisionFilterGroupMask(body, link, _ROBOT, _FLOOR, client)
    return int(floor)


class FloatingBodies:
    """Poses, twists and contacts of N robots; part of :class:`physai.physics.pybullet.PyBulletPhysics`.

    Args:
        floating: The robot's.
        row: Client and body of each robot.
        bodies: Names of the robot's bodies with mass.
        indices: PyBullet's numbers of these.
    """

    def __init__(
        self, floating: FloatingBase, row: Sequence[tuple[int, int]], bodies: Sequence[str], indices: Sequence[int]
    ) -> None:
        self._row, self._bodies = row, indices
        info = bullet.getDynamicsInfo(row[0][1], -1, row[0][0])
        self._inertial = info[3], info[4]  # PyBullet speaks of the base's centre of mass and principal axes
        self._frame = bullet.invertTransform(*self._inertial)
        index = dict(zip(bodies, indices, strict=True))
        self._spheres = [
            (index[sphere.body], np.array(sphere.center), sphere.radius, floating.links.index(sphere.link))
            for sphere in floating.spheres
        ]
        self._pose, self._twist = np.zeros((len(row), 7)), np.zeros((len(row), 6))
        self._contact = np.zeros((len(row), len(floating.links)), bool)

    def reset(self, rows: np.ndarray, state: RobotState) -> None:
        """Put bases into the pose and twist of a state."""
        assert state.base_pose is not None
        assert state.base_twist is not None
        turned = rotate(state.base_pose[:, 3:], np.tile(self._inertial[0], (len(rows), 1)))
        linear = state.base_twist[:, :3] + np.cross(state.base_twist[:, 3:], turned)
        for row, pose, twist, velocity in zip(rows.tolist(), state.base_pose, state.base_twist, linear, strict=True):
            client, body = self._row[row]
            placed = bullet.multiplyTransforms(pose[:3].tolist(), pose[3:].tolist(), *self._inertial)
            bullet.resetBasePositionAndOrientation(body, *placed, client)
            bullet.resetBaseVelocity(body, velocity.tolist(), twist[3:].tolist(), client)
        self._pose[rows], self._twist[rows], self._contact[rows] = state.base_pose, state.base_twist, False

    def set(self, rows: np.ndarray, friction: np.ndarray) -> None:
        """Give them another friction, [r, 1]."""
        for row, value in zip(rows.tolist(), friction[:, 0].tolist(), strict=True):
            client, body = self._row[row]
            for link in self._bodies:
                bullet.changeDynamics(body, link, lateralFriction=value, restitution=0.0, physicsClientId=client)

    def update(self) -> None:
        """Read where bases are, and which links touch the floor."""
        for row, (client, body) in enumerate(self._row):
            position, turn = bullet.getBasePositionAndOrientation(body, client)
            self._pose[row] = np.concatenate(bullet.multiplyTransforms(position, turn, *self._frame))
            self._twist[row] = np.concatenate(bullet.getBaseVelocity(body, client))
            self._contact[row] = self._touching(client, body)
        offset = rotate(self._pose[:, 3:], np.tile(self._inertial[0], (len(self._row), 1)))
        self._twist[:, :3] -= np.cross(self._twist[:, 3:], offset)

    def added_to(self, state: RobotState) -> RobotState:
        """Return a state with what there is to know of the bases."""
        told = self._pose.copy(), self._twist.copy(), self._contact.copy()
        return replace(state, base_pose=told[0], base_twist=told[1], contact=told[2])

    def _touching(self, client: int, body: int) -> np.ndarray:
        touching = np.zeros(self._contact.shape[1], bool)
        for point in bullet.getContactPoints(bodyA=body, physicsClientId=client):
            if point[9] <= 0.0:  # near, and no force
                continue
            touching[self._nearest(client, body, point[3], np.array(point[5]))] = True
        return touching

    def _nearest(self, client: int, body: int, link: int, point: np.ndarray) -> int:
        """Which link of the robot has the sphere whose surface a point of one of its bodies is on."""
        spheres = [sphere for sphere in self._spheres if sphere[0] == link]
        if len({sphere[3] for sphere in spheres}) > 1:
            if link < 0:
                position, turn = bullet.getBasePositionAndOrientation(body, client)
                position, turn = bullet.multiplyTransforms(position, turn, *self._frame)
            else:
                position, turn = bullet.getLinkState(body, link, 0, 1, client)[4:6]
            matrix = np.array(bullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
            here = matrix.T @ (point - np.array(position))
            spheres.sort(key=lambda sphere: abs(float(np.linalg.norm(here - sphere[1])) - sphere[2]))
        return int(spheres[0][3])


class Springs:
    """Joints of N robots that are given the effort of a spring and a damper, once a substep.

    Args:
        row: Client and body of each robot.
        joints: PyBullet's numbers of the joints.
    """

    def __init__(self, row: Sequence[tuple[int, int]], joints: Sequence[int]) -> None:
        self._row, self._joints = row, joints
        self._clients = list(dict.fromkeys(client for client, _ in row))
        shape = len(row), len(joints)
        self._stiffness, self._damping, self._limit = (np.zeros(shape) for _ in range(3))

    def substeps(self, control_dt: float, home: np.ndarray, damping: np.ndarray, held: bool) -> int:
        """How many a control period must have, so that the damping of light legs does not make them tremble.

        A damper that is asked once a substep of ``dt`` s must not take more than the velocity away that there is:
        beyond ``damping * dt = 2 * inertia`` it is an engine. Half of that leaves room for other masses.

        Args:
            control_dt: s.
            home: Where the joints are, rad, [n].
            damping: N·m·s/rad, [n].
            held: Whether the base is fixed.
        """
        client, body = self._row[0]
        order = np.argsort(self._joints)
        at_home = [*([] if held else [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), *home[order].tolist()]
        mass = np.array(bullet.calculateMassMatrix(body, at_home, physicsClientId=client))
        inertia = mass[-len(order) :, -len(order) :]
        root = np.sqrt(np.maximum(damping[order], 1e-6))
        lightest = np.linalg.eigvalsh(inertia / np.outer(root, root)).min()
        return math.ceil(control_dt / lightest)

    def set(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        """Give them new dynamics; PyBullet's own motors hold joints as friction would."""
        self._stiffness[rows], self._damping[rows] = parameters["stiffness"], parameters["servo_damping"]
        self._limit[rows] = parameters["effort_limit"]
        zeros = [0.0] * len(self._joints)
        for row, friction in zip(rows.tolist(), parameters["joint_friction"].tolist(), strict=True):
            client, body = self._row[row]
            bullet.setJointMotorControlArray(
                body,
                self._joints,
                bullet.VELOCITY_CONTROL,
                targetVelocities=zeros,
                forces=friction,
                physicsClientId=client,
            )

    def step(self, command: np.ndarray, substeps: int) -> tuple[list[float], list[float], list[float]]:
        """Hold a command [N, n], rad; return positions, velocities and efforts, robot after robot."""
        position, velocity = self._read()
        for _ in range(substeps):
            wanted = self._stiffness * (command - position) - self._damping * velocity
            effort = np.clip(wanted, -self._limit, self._limit)
            for (client, body), efforts in zip(self._row, effort.tolist(), strict=True):
                bullet.setJointMotorControlArray(
                    body, self._joints, bullet.TORQUE_CONTROL, forces=efforts, physicsClientId=client
                )
            for client in self._clients:
                bullet.stepSimulation(client)
            position, velocity = self._read()
        return position.ravel().tolist(), velocity.ravel().tolist(), effort.ravel().tolist()

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        states = [bullet.getJointStates(body, self._joints, client) for client, body in self._row]
        told = np.array([[joint[:2] for joint in robot] for robot in states])
        return told[:, :, 0], told[:, :, 1]
