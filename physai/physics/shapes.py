"""What touches what by PyBullet's own shapes of a URDF: another method than capsules, to choose and to judge these."""

from collections.abc import Iterable

import numpy as np
import pybullet as bullet

from physai.collision import Box
from physai.robots import RobotSpec

_ALWAYS = 200  # random configurations, in all of which links touch that are no collision


class ShapeCollisions:
    """A robot's links by the convex shapes of their ``<collision>``; links without any meet nothing.

    Links that a joint joins, that no driven joint moves against each other, or that touch wherever the robot is, are no
    collisions.

    Args:
        spec: The robot.
        floor: Height of the floor in the base frame, m; None where there is none.
        boxes: What else stands around. Links that a joint moves must meet neither these nor the floor.

    Attributes:
        names: The pairs that are looked at: of two links, or a link and the floor or a box.
    """

    def __init__(self, spec: RobotSpec, floor: float | None = None, boxes: Iterable[Box] = ()) -> None:
        self._client = bullet.connect(bullet.DIRECT)
        self._body = bullet.loadURDF(str(spec.urdf), useFixedBase=True, physicsClientId=self._client)
        # What PyBullet places is the base's centre of mass; what is meant is the frame of its link.
        dynamics = bullet.getDynamicsInfo(self._body, -1, self._client)
        bullet.resetBasePositionAndOrientation(self._body, dynamics[3], dynamics[4], self._client)
        infos = [
            bullet.getJointInfo(self._body, index, self._client)
            for index in range(bullet.getNumJoints(self._body, self._client))
        ]
        self._joints = [next(info[0] for info in infos if info[1].decode() == name) for name in spec.joints]
        base = bullet.getBodyInfo(self._body, self._client)[0].decode()
        names = {-1: base} | {info[0]: info[12].decode() for info in infos}
        parent = {info[0]: info[16] for info in infos}
        body = {-1: 0}
        for index in parent:
            turns = index in self._joints
            body[index] = self._joints.index(index) + 1 if turns else body[parent[index]]
        shaped = [index for index in names if bullet.getCollisionShapeData(self._body, index, self._client)]
        self._pairs = [
            (self._body, first, second)
            for place, first in enumerate(shaped)
            for second in shaped[place + 1 :]
            if body[first] != body[second] and parent.get(second) != first
        ]
        self.names = [(names[first], names[second]) for _, first, second in self._pairs]
        around = [(box.name, self._box(box.center, box.half_size)) for box in boxes]
        if floor is not None:
            around.append(("floor", self._box((0.0, 0.0, floor - 1.0), (10.0, 10.0, 1.0))))
        for name, other in around:
            moving = [index for index in shaped if body[index]]
            self._pairs += [(other, index, -1) for index in moving]
            self.names += [(names[index], name) for index in moving]
        touching = self.distance(spec.sample(_ALWAYS, np.random.default_rng(0)), within=0.0).max(axis=0) <= 0
        self._pairs = [pair for pair, always in zip(self._pairs, touching, strict=True) if not always]
        self.names = [name for name, always in zip(self.names, touching, strict=True) if not always]

    def _box(self, center: Iterable[float], half_size: Iterable[float]) -> int:
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=list(half_size), physicsClientId=self._client)
        return bullet.createMultiBody(
            baseCollisionShapeIndex=shape, basePosition=list(center), physicsClientId=self._client
        )

    def distance(self, joint_position: np.ndarray, within: float) -> np.ndarray:
        """Map joint positions [N, n], rad, to distances [N, P], m; infinite where it is more than ``within``."""
        found = np.full((len(joint_position), len(self._pairs)), np.inf)
        for row, positions in zip(found, joint_position.tolist(), strict=True):
            for joint, position in zip(self._joints, positions, strict=True):
                bullet.resetJointState(self._body, joint, position, 0.0, self._client)
            for place, (other, first, second) in enumerate(self._pairs):
                points = bullet.getClosestPoints(self._body, other, within, first, second, physicsClientId=self._client)
                if points:
                    row[place] = min(point[8] for point in points)
        return found

    def touching(self, joint_position: np.ndarray) -> np.ndarray:
        """Whether anything touches at joint positions [N, n], rad, [N]."""
        return np.any(self.distance(joint_position, within=0.0) <= 0, axis=1)

    def links(self, joint_position: np.ndarray) -> list[tuple[str, str]]:
        """Which pairs touch at joint positions [n], rad."""
        touching = self.distance(joint_position[np.newaxis], within=0.0)[0] <= 0
        return [name for name, touches in zip(self.names, touching, strict=True) if touches]

    def close(self) -> None:
        """Free the world; may be called twice."""
        if self._client >= 0:
            bullet.disconnect(self._client)
            self._client = -1
