"""A robot to draw, from the URDF that its node publishes."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from urdf_parser_py.urdf import Joint, Robot

from physai.collision import Kinematics
from physai.errors import UserError
from physai.robots.chain import carried, motions
from physai.robots.urdf import load
from physai.robots.visuals import visual_bodies
from physai.web.appearance import Appearance

_TURNING = ("revolute", "continuous")


@dataclass(frozen=True, eq=False)
class Described:
    """A robot as a URDF describes it.

    Attributes:
        joints: Names of the n joints that turn, from the base on.
        appearance: How they are drawn.
        height: Of the link that the first of them turn in, above the root, m: legs hang from it.
    """

    joints: tuple[str, ...]
    appearance: Appearance
    height: float

    @classmethod
    def read(cls, text: str) -> "Described":
        """Read a URDF: an arm, or legs; all of its joints that turn are driven, and the others held at zero.

        Raises:
            UserError: If it is none, or has no joint that turns.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(text)
            robot = load(path)
            base, order = _from_base(robot)
            joints = tuple(joint.name for joint in order if joint.type in _TURNING)
            if not joints:
                raise UserError("the robot's description has no joint that turns")
            meshes = visual_bodies(path, base, joints)
        moves = motions(order, base, joints)
        first = next(joint for joint in order if joint.name == joints[0])
        _, frame = carried(order, base, joints)[first.parent]
        look = Appearance.of_shapes(Kinematics(moves, _ends(order, base, joints, moves.carriers)), meshes)
        return cls(joints, look, float(frame[2, 3]))


def _from_base(robot: Robot) -> tuple[str, list[Joint]]:
    """The link that nothing carries, and all joints, those that carry others before them."""
    carried_links = {joint.child for joint in robot.joints}
    bases = [link.name for link in robot.links if link.name not in carried_links]
    if len(bases) != 1:
        raise UserError(f"the robot's description has {len(bases)} links that nothing carries, not one")
    order: list[Joint] = []
    reached = bases.copy()
    for link in reached:  # grows while it is walked
        below = [joint for joint in robot.joints if joint.parent == link and joint.child not in reached]
        order += below
        reached += [joint.child for joint in below]
    return bases[0], order


def _ends(
    order: list[Joint], base: str, joints: tuple[str, ...], carriers: tuple[int, ...]
) -> tuple[tuple[int, np.ndarray], ...]:
    """The frame of the last link in that of the last body; none where there are several limbs."""
    if carriers != tuple(range(len(joints))):
        return ()
    where = carried(order, base, joints)
    return (next(where[joint.child] for joint in reversed(order) if where[joint.child][0] == len(joints)),)
