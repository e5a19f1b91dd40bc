"""What a robot looks like, body by body: its URDF's shapes, or its capsules, or sticks from joint to joint."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from omegaconf import DictConfig

from physai.collision import Capsule, CollisionModel, Motions
from physai.config import validate
from physai.deploy import Metadata
from physai.errors import UserError
from physai.robots import RobotConfig, RobotSpec
from physai.robots.visuals import plain, visual_bodies

_ORANGE = (242, 115, 31, 255)  # of what stands in for the robot's own shapes
_STICK = 0.03  # its radius, as a share of the robot's reach


@dataclass(frozen=True, eq=False)
class Appearance:
    """A robot to draw; many scenes of robots of one kind may share it.

    Attributes:
        motions: What each driven joint moves.
        bodies: glTF binaries of n + 1 bodies in their frames: of the base, then of what each driven joint moves; None
            where nothing is seen.
        reach: Length of the stretched robot, m; of legs, from the middle of the base on.
        floor: The lowest point of a fixed base, m; zero or below.
        tip: The end effector's frame in that of the last body, 4 x 4; None where nobody has told.
    """

    motions: Motions
    bodies: tuple[bytes | None, ...]
    reach: float
    floor: float
    tip: np.ndarray | None

    @classmethod
    def of_robot(cls, spec: RobotSpec) -> "Appearance":
        """Read the shapes of a robot's URDF.

        Raises:
            UserError: If a shape is broken, or its mesh cannot be found or read.
        """
        meshes = visual_bodies(spec.urdf, spec.base, spec.joints)
        if not any(meshes) and spec.collision:
            meshes = _of_model(spec.collision)
        look = cls.of_shapes(spec.motions, meshes, spec.tip)
        return look if spec.floating is None else replace(look, floor=0.0)

    @classmethod
    def of_policy(cls, metadata: Metadata) -> "Appearance":
        """Draw the robot of a policy file: by its URDF, if it is here and the same, else by what the file tells.

        Raises:
            UserError: If the URDF is not here, and the file holds no capsules.
        """
        try:
            spec = robot_of(metadata)
            if hashlib.sha256(spec.urdf.read_bytes()).hexdigest() != metadata.raw["robot"]["urdf_sha256"]:
                raise UserError(f"{spec.urdf}: not the URDF that the policy was trained with")
            return cls.of_robot(spec)
        except UserError as error:
            if metadata.collision is None:
                raise UserError(f"'{metadata.robot}' cannot be drawn: the policy has no capsules; {error}") from error
        return cls.of_shapes(metadata.collision.motions, _of_model(metadata.collision), None)

    @classmethod
    def of_shapes(cls, moves: Motions, meshes: list[list[trimesh.Trimesh]], tip: np.ndarray | None) -> "Appearance":
        """Draw meshes of n + 1 bodies, in their frames; where there are none at all, sticks from joint to joint.

        Args:
            moves: What each driven joint moves.
            meshes: Of the base, then of what each driven joint moves.
            tip: The end effector's frame in that of the last body, 4 x 4; None where nobody has told.
        """
        if not any(meshes):
            meshes = _sticks(moves, np.eye(4) if tip is None else tip)
        floor = min((float(mesh.bounds[0, 2]) for mesh in meshes[0]), default=0.0)
        reach = _reach(moves, np.eye(4) if tip is None else tip)
        return cls(moves, tuple(_gltf(each) for each in meshes), reach, min(floor, 0.0), tip)

    @property
    def joints(self) -> int:
        """How many joints it draws, n."""
        return len(self.motions)

    def frames(self, joint_position: np.ndarray) -> np.ndarray:
        """Return the frame of each body at joint positions [n], rad, in the base's: [n + 1, 3, 4]."""
        return self.motions.frames(np.asarray(joint_position, dtype=np.float64)[np.newaxis])[..., 0]

    def tip_position(self, joint_position: np.ndarray) -> np.ndarray | None:
        """Return where the end effector is at joint positions [n], rad, in the base's frame, m, [3]."""
        return None if self.tip is None else self.frames(joint_position)[-1] @ self.tip[:, 3]


def robot_of(metadata: Metadata) -> RobotSpec:
    """Read the robot that a policy was trained for; nothing that its file names is run.

    Raises:
        UserError: If its description is damaged, or its URDF is not here.
    """
    robot = metadata.raw["config"].get("env", {}).get("robot")
    if not isinstance(robot, dict):
        raise UserError("the policy does not describe its robot")
    return RobotSpec.from_config(validate(RobotConfig, DictConfig(robot)))


def _reach(moves: Motions, tip: np.ndarray) -> float:
    lengths, arm = [0.0], moves.carriers.count(0) == 1
    for body, place in zip(moves.carriers, moves.constant[:, :3, 3], strict=True):
        lengths.append(lengths[body] + (0.0 if arm and not body else float(np.linalg.norm(place))))
    lengths[-1] += float(np.linalg.norm(tip[:3, 3]))
    return max(*lengths, 0.1)


def _of_model(model: CollisionModel) -> list[list[trimesh.Trimesh]]:
    return _of_capsules(len(model.motions) + 1, model.capsules)


def _of_capsules(bodies: int, capsules: Iterable[Capsule]) -> list[list[trimesh.Trimesh]]:
    meshes: list[list[trimesh.Trimesh]] = [[] for _ in range(bodies)]
    for capsule in capsules:
        start, end = np.array(capsule.start), np.array(capsule.end)
        length = float(np.linalg.norm(end - start))
        # trimesh's stands on its lower end; what it is turned to by `align_vectors` is its axis.
        mesh = trimesh.creation.capsule(height=length, radius=capsule.radius, count=(16, 24))
        if length:
            mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
            mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end - start))
        mesh.apply_translation((start + end) / 2 - (0.0 if length else mesh.bounds.mean(axis=0)))
        mesh.visual = plain(_ORANGE)
        meshes[capsule.body].append(mesh)
    return meshes


def _sticks(moves: Motions, tip: np.ndarray) -> list[list[trimesh.Trimesh]]:
    """From each joint to those that it carries, and to the end effector."""
    ends = [*zip(moves.carriers, moves.constant[:, :3, 3], strict=True), (len(moves), tip[:3, 3])]
    radius, origin = _STICK * _reach(moves, tip), (0.0, 0.0, 0.0)
    sticks = [Capsule("", body, origin, tuple(end.tolist()), radius) for body, end in ends]
    return _of_capsules(len(ends), sticks)


def _gltf(meshes: list[trimesh.Trimesh]) -> bytes | None:
    if not meshes:
        return None
    exported = trimesh.Scene(meshes).export(file_type="glb")
    assert isinstance(exported, bytes)
    return exported
