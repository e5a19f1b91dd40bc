"""A robot to draw, from the URDF that its node publishes."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from urdf_parser_py.urdf import Joint, Robot

from physai.errors import UserError
from physai.robots.chain import motions
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
    """

    joints: tuple[str, ...]
    appearance: Appearance

    @classmethod
    def read(cls, text: str) -> "Described":
        """Read a URDF: the longest arm in it, with what hangs on it held at zero.

        Raises:
            UserError: If it is none, or has no joint that turns.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(text)
            robot = load(path)
            chain = _longest(robot)
            joints = tuple(joint.name for joint in chain if joint.type in _TURNING)
            if not joints:
                raise UserError("the robot's description has no joint that turns")
            meshes = visual_bodies(path, chain[0].parent, joints)
        moves, tip = motions(chain, joints)
        return cls(joints, Appearance.of_shapes(moves, meshes, tip))


def _longest(robot: Robot) -> list[Joint]:
    """Of the ways from the root to an end, that with the most joints that turn."""
    above = {joint.child: joint for joint in robot.joints}
    best: list[Joint] = []
    for link in robot.links:
        chain: list[Joint] = []
        end = link.name
        while end in above and len(chain) <= len(above):
            chain.insert(0, above[end])
            end = chain[0].parent
        best = max(best, chain, key=lambda found: (sum(joint.type in _TURNING for joint in found), len(found)))
    return best
