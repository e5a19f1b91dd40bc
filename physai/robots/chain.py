"""What turns and what is carried along: the joints of a URDF as matrices."""

from collections.abc import Sequence

import numpy as np
from urdf_parser_py.urdf import Joint

from physai.collision import Motions
from physai.errors import UserError
from physai.robots.urdf import transform


def axis_of(joint: Joint) -> np.ndarray:
    """The direction of its axis in the frame of the joint, [3]."""
    axis = np.array(joint.axis or [1.0, 0.0, 0.0])  # what a URDF means that names none
    direction: np.ndarray = axis / np.linalg.norm(axis)
    return direction


def motions(joints: Sequence[Joint], base: str, driven: Sequence[str]) -> Motions:
    """Return what each driven joint does to the points of the link behind it.

    Args:
        joints: Of the whole robot, or of a part that begins at the base; those that are not driven are held at zero.
        base: The first link.
        driven: Names of the joints that move; a joint comes after those that carry it.

    Raises:
        UserError: If one comes before them.
    """
    constant, cosine, sine = np.zeros((3, len(driven), 4, 4))
    carriers = carried(joints, base, driven)
    named = {joint.name: joint for joint in joints}
    bodies = []
    for row, name in enumerate(driven):
        joint = named[name]
        body, frame = carriers[joint.parent]
        if body > row:
            raise UserError(f"joint '{name}' is carried by '{driven[body - 1]}', and must be named after it")
        fixed = frame @ transform(joint.origin)
        x, y, z = axis_of(joint)
        along = np.outer([x, y, z], [x, y, z])
        across = np.eye(3) - along
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        constant[row] = fixed
        constant[row, :3, :3] = fixed[:3, :3] @ along
        cosine[row, :3, :3] = fixed[:3, :3] @ across
        sine[row, :3, :3] = fixed[:3, :3] @ cross
        bodies.append(body)
    return Motions(constant, cosine, sine, tuple(bodies))


def welded(joints: Sequence[Joint], base: str, bodies: Sequence[str]) -> dict[str, tuple[str, np.ndarray]]:
    """Return what carries each link: of ``bodies``, the one that it is welded to, and its frame in that one's, 4 x 4.

    Args:
        joints: Of the whole robot; those that carry no body are held at zero.
        base: The first link.
        bodies: Names of the links that bodies begin with.
    """
    found = {base: (base, np.eye(4))}
    links = [base]
    for parent in links:  # grows while it is walked
        body, frame = found[parent]
        for joint in joints:
            if joint.parent == parent:
                own = joint.child in bodies
                found[joint.child] = (joint.child, np.eye(4)) if own else (body, frame @ transform(joint.origin))
                links.append(joint.child)
    return found


def carried(joints: Sequence[Joint], base: str, driven: Sequence[str]) -> dict[str, tuple[int, np.ndarray]]:
    """Return what carries each link.

    Args:
        joints: Of the whole robot; those that are not driven are held at zero.
        base: The first link.
        driven: Names of the joints that move, in order.

    Returns:
        By link, the index of the body (0 the base, k what the k-th driven joint moves) and the link's frame in that
        body's, 4 x 4.
    """
    found = {base: (0, np.eye(4))}
    links = [base]
    for parent in links:  # grows while it is walked
        body, frame = found[parent]
        for joint in joints:
            if joint.parent != parent:
                continue
            if joint.child in found:
                raise UserError(f"joint '{joint.name}' closes a loop: '{joint.child}' is carried already")
            turns = joint.name in driven
            here = (driven.index(joint.name) + 1, np.eye(4)) if turns else (body, frame @ transform(joint.origin))
            found[joint.child] = here
            links.append(joint.child)
    return found
