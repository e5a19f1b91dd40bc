"""What a robot looks like, body by body: its URDF's shapes, or its capsules, or sticks from joint to joint."""

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from omegaconf import DictConfig

from physai.collision import Capsule, CollisionModel, Kinematics
from physai.config import validate
from physai.deploy import Metadata
from physai.errors import UserError
from physai.robots import RobotConfig, RobotSpec, kinematics_of
from physai.robots.visuals import METALLIC, plain, visual_bodies

_ORANGE = (242, 115, 31, 255)  # of what stands in for the robot's own shapes
_STICK = 0.03  # its radius, as a share of the robot's reach


@dataclass(frozen=True, eq=False)
class Appearance:
    """A robot to draw; many scenes of robots of one kind may share it.

    Attributes:
        kinematics: What each driven joint moves, and where the links end.
        bodies: glTF binaries of n + 1 bodies in their frames: of the base, then of what each driven joint moves; None
            where nothing is seen.
        reach: Length of the stretched robot, m; of legs, from the middle of the base on.
        floor: The lowest point of a fixed base, m; zero or below.
    """

    kinematics: Kinematics
    bodies: tuple[bytes | None, ...]
    reach: float
    floor: float

    @classmethod
    def of_robot(cls, spec: RobotSpec) -> "Appearance":
        """Read the shapes of a robot's URDF.

        Raises:
            UserError: If a shape is broken, or its mesh cannot be found or read.
        """
        meshes = visual_bodies(spec.urdf, spec.base, spec.joints)
        if not any(meshes) and spec.collision:
            meshes = _of_model(spec.collision)
        return cls.of_shapes(kinematics_of(spec), meshes)

    @classmethod
    def of_policy(cls, metadata: Metadata) -> "Appearance":
        """Draw the robot of a policy file: by its URDF, if it is here and the same, else by what the file tells."""
        with suppress(UserError):  # it is not here
            spec = robot_of(metadata)
            if hashlib.sha256(spec.urdf.read_bytes()).hexdigest() == metadata.raw["robot"]["urdf_sha256"]:
                return cls.of_robot(spec)
        return cls.of_shapes(metadata.kinematics, _of_model(metadata.collision) if metadata.collision else [])

    @classmethod
    def of_shapes(cls, kinematics: Kinematics, meshes: list[list[trimesh.Trimesh]]) -> "Appearance":
        """Draw meshes of n + 1 bodies, in their frames; where there are none at all, sticks from joint to joint.

        Args:
            kinematics: What each driven joint moves, and where the links end.
            meshes: Of the base, then of what each driven joint moves.
        """
        if not any(meshes):
            meshes = _sticks(kinematics)
        floor = min((float(mesh.bounds[0, 2]) for mesh in meshes[0]), default=0.0)
        bodies, reach = tuple(_gltf(each) for each in meshes), _reach(kinematics)
        return cls(kinematics, bodies, reach, 0.0 if kinematics.height else min(floor, 0.0))

    @property
    def joints(self) -> int:
        """How many joints it draws, n."""
        return len(self.kinematics.motions)

    def frames(self, joint_position: np.ndarray) -> np.ndarray:
        """Return the frame of each body at joint positions [n], rad, in the base's: [n + 1, 3, 4]."""
        return self.kinematics.motions.frames(np.asarray(joint_position, dtype=np.float64)[np.newaxis])[..., 0]

    def tip_position(self, joint_position: np.ndarray) -> np.ndarray | None:
        """Return where the end effector is at joint positions [n], rad, in the base's frame, m, [3]; None of legs."""
        if self.kinematics.height or len(self.kinematics.ends) != 1:
            return None
        place: np.ndarray = self.kinematics.places(np.asarray(joint_position, np.float64)[np.newaxis])[0, :, 0]
        return place


def robot_of(metadata: Metadata) -> RobotSpec:
    """Read the robot that a policy was trained for; nothing that its file names is run.

    Raises:
        UserError: If its description is damaged, or its URDF is not here.
    """
    robot = metadata.raw["config"].get("env", {}).get("robot")
    if not isinstance(robot, dict):
        raise UserError("the policy does not describe its robot")
    return RobotSpec.from_config(validate(RobotConfig, DictConfig(robot)))


def _reach(kinematics: Kinematics) -> float:
    moves, lengths = kinematics.motions, [0.0]
    arm = moves.carriers.count(0) == 1
    for body, place in zip(moves.carriers, moves.constant[:, :3, 3], strict=True):
        lengths.append(lengths[body] + (0.0 if arm and not body else float(np.linalg.norm(place))))
    ends = [lengths[body] + float(np.linalg.norm(frame[:3, 3])) for body, frame in kinematics.ends]
    return max(*lengths, *ends, 0.1)


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


def _sticks(kinematics: Kinematics) -> list[list[trimesh.Trimesh]]:
    """From each joint to those that it carries, and to where the links end."""
    moves = kinematics.motions
    ends = [*zip(moves.carriers, moves.constant[:, :3, 3], strict=True)]
    ends += [(body, frame[:3, 3]) for body, frame in kinematics.ends]
    radius, origin = _STICK * _reach(kinematics), (0.0, 0.0, 0.0)
    sticks = [Capsule("", body, origin, tuple(end.tolist()), radius) for body, end in ends]
    return _of_capsules(len(moves) + 1, sticks)


def _gltf(meshes: list[trimesh.Trimesh]) -> bytes | None:
    if not meshes:
        return None
    exported = trimesh.Scene(meshes).export(file_type="glb", tree_postprocessor=_not_metal)
    assert isinstance(exported, bytes)
    return exported


def _not_metal(tree: dict[str, Any]) -> None:
    """What a file does not call metal, as COLLADA, OBJ and PLY do not, is none; in glTF it would be all metal."""
    materials = tree.setdefault("materials", [])
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            if "material" not in part:
                part["material"] = len(materials)
                materials.append({})
    for material in materials:
        material.setdefault("pbrMetallicRoughness", {}).setdefault("metallicFactor", METALLIC)
