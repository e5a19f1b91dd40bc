"""The other side of a robot on legs: what its joints do while a mirror image of it moves."""

from dataclasses import dataclass

import numpy as np

from physai.errors import UserError
from physai.robots.ends import ends_at_home
from physai.robots.spec import RobotSpec

_ACROSS = np.array([1.0, -1.0, 1.0])  # the mirror stands on the base's x axis
_NEAR = 0.01  # m, m/rad and rad that two sides may differ by


@dataclass(frozen=True)
class Mirror:
    """Joint k of the mirror image is where ``sign[k]`` times joint ``order[k]`` of the robot is.

    Attributes:
        order: [n].
        sign: 1 or -1, [n].
    """

    order: np.ndarray
    sign: np.ndarray

    @classmethod
    def of(cls, spec: RobotSpec) -> "Mirror":
        """Find the pairs of joints, by how they move the feet at home.

        Raises:
            UserError: If the robot has no legs, or its right side is not like its left one.
        """
        if spec.floating is None:
            raise UserError(f"robot '{spec.name}' stands on no legs: it has no other side")
        places, jacobian = ends_at_home(spec)  # [e, 3], [e, 3, n]
        image, moves = places * _ACROSS, jacobian * _ACROSS[:, np.newaxis]
        ends = np.linalg.norm(image[:, np.newaxis] - places, axis=2)  # [e of the image, e]
        other = ends.argmin(axis=0)  # which end of the image is at each end of the robot
        if ends.min(axis=0).max() > _NEAR:
            raise UserError(f"robot '{spec.name}': its feet on the left are not where those on the right are")
        n = len(spec.joints)
        off = np.zeros((2, n, n))  # for each sign: how far joint k is from being joint j of the image, [k, j]
        for number, sign in enumerate((1.0, -1.0)):
            off[number] = np.abs(moves[other][:, :, np.newaxis] - sign * jacobian[..., np.newaxis]).max(axis=(0, 1))
        best, rows = off.min(axis=0), np.arange(n)
        order = best.argmin(axis=1)
        sign = np.where(off[0] <= off[1], 1.0, -1.0)[rows, order]
        for joint, other_joint in enumerate(order):
            name, like = spec.joints[joint], spec.joints[other_joint]
            if best[joint, other_joint] > _NEAR or (order == other_joint).sum() > 1:
                raise UserError(f"robot '{spec.name}': no joint on its other side moves as {name} does")
            if abs(sign[joint] * spec.home[other_joint] - spec.home[joint]) > _NEAR:
                raise UserError(f"robot '{spec.name}': at home {name} is not where {like} is on the other side")
            for what, values in _drives(spec).items():
                if not np.isclose(values[joint], values[other_joint]):
                    raise UserError(f"robot '{spec.name}': {name} and {like} have not the same {what}")
        return cls(order, sign)

    def links(self, spec: RobotSpec) -> np.ndarray:
        """Return the place in ``spec.moving_links`` of the link that is on the other side of each."""
        names = list(spec.moving_links)
        carried = {body.joint.name: body.name for body in spec.bodies if body.joint is not None}
        of_joint = [names.index(carried[joint]) for joint in spec.joints]
        places = np.arange(len(names))
        places[of_joint] = np.array(of_joint)[self.order]
        return places


def _drives(spec: RobotSpec) -> dict[str, np.ndarray]:
    """What the joints of a pair must have alike, [n] each."""
    assert spec.servo is not None
    servo = {"stiffness": spec.servo.stiffness, "damping": spec.servo.damping}
    return {"command_limit": spec.command_limit, "effort limit": spec.effort_limit, "armature": spec.armature, **servo}
