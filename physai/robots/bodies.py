"""The rigid bodies of a robot: links that nothing moves against each other are one, with the inertia of all of them."""

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from lxml import etree
from pydantic import Field
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import Joint, Link, Robot

from physai.config import Config, NonNegativeFloat, nearest
from physai.errors import UserError
from physai.robots.urdf import transform

_ROUNDING = 0.01  # of a principal moment, by which it may be larger than the two others together


class InertialConfig(Config):
    """Of a link: its mass, kg, the centre of mass in its frame, m, and its inertia about that, kg·m².

    ``inertia`` is xx, xy, xz, yy, yz, zz, along the axes of the link's frame.
    """

    mass: NonNegativeFloat
    com: Annotated[list[float], Field(min_length=3, max_length=3)]
    inertia: Annotated[list[float], Field(min_length=6, max_length=6)]


@dataclass(frozen=True)
class Body:
    """A link, with all that is welded to it.

    Attributes:
        name: The link's.
        joint: What carries it, welded where no motor drives it; None for the base.
        parent: Name of the body that carries the joint; empty for the base.
        origin: Where the joint is in the parent's frame, 4 x 4.
        mass: kg.
        com: Centre of mass in the link's frame, m, [3].
        inertia: About the centre of mass, along the link's axes, kg·m², [3, 3].
    """

    name: str
    joint: Joint | None
    parent: str
    origin: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray


def merge(
    path: Path,
    robot: Robot,
    driven: tuple[str, ...],
    tip: str | None,
    inertials: Mapping[str, InertialConfig],
    floats: bool = False,
) -> tuple[Body, ...]:
    """Join the links of a robot that only ``driven`` joints move, from the base on; ``tip`` stays by itself.

    An engine's step costs as many bodies as there are. A tip carries the payload, so it must be one.

    Args:
        path: Of the URDF, for errors.
        robot: Its links and joints.
        driven: Joints that move; the others are held at zero.
        tip: The link at the end, if there is one.
        inertials: Of links whose inertia in the URDF is not to be believed.
        floats: Whether the base moves, too, so that its inertia matters.

    Raises:
        UserError: If a link's inertia is none that a body can have, or ``inertials`` names no link; it says which.
    """
    links = {link.name: link for link in robot.links}
    for name in inertials:
        if name not in links:
            raise UserError(f"inertials: {path} has no link '{name}'{nearest(name, links)}")
    children = {joint.child: joint for joint in robot.joints}
    carriers: dict[str, tuple[str, np.ndarray]] = {}
    parts: dict[str, list[tuple[float, np.ndarray, np.ndarray]]] = {}
    placed: dict[str, tuple[Joint | None, str, np.ndarray]] = {}
    for name in _from_the_base(links, robot.joints):
        joint = children.get(name)
        parent, before = carriers[joint.parent] if joint else ("", np.eye(4))
        here = before @ transform(joint.origin) if joint else before
        if joint is None or joint.name in driven or name == tip:
            placed[name], parts[name] = (joint, parent, here), []
            parent, here = name, np.eye(4)
        carriers[name] = parent, here
        mass, com, inertia = _inertial(path, links[name], inertials.get(name), moves=floats or bool(placed[parent][0]))
        if mass:  # what weighs nothing resists nothing, whatever else its <inertial> says
            turn = here[:3, :3]
            parts[parent].append((mass, turn @ com + here[:3, 3], turn @ inertia @ turn.T))
    return tuple(Body(name, *placed[name], *_together(parts[name])) for name in placed)


def engine_urdf(
    bodies: tuple[Body, ...],
    driven: tuple[str, ...],
    spheres: Iterable[tuple[str, tuple[float, ...], float]] = (),
) -> bytes:
    """Return the URDF that engines are given: bodies, of which only the ``driven`` joints move.

    Their only shapes are ``spheres``: the name of a body, the centre in its frame and the radius, m.
    """
    shapes = tuple(spheres)
    root = etree.Element("robot", name="robot")
    for body in bodies:
        link = etree.SubElement(root, "link", name=body.name)
        inertial = etree.SubElement(link, "inertial")  # of what weighs nothing, too: PyBullet would guess 1 kg
        etree.SubElement(inertial, "origin", xyz=_text(body.com), rpy="0 0 0")
        etree.SubElement(inertial, "mass", value=repr(float(body.mass)))
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = ([repr(value) for value in row] for row in body.inertia.tolist())
        etree.SubElement(inertial, "inertia", ixx=xx, ixy=xy, ixz=xz, iyy=yy, iyz=yz, izz=zz)
        for _, center, radius in (shape for shape in shapes if shape[0] == body.name):
            collision = etree.SubElement(link, "collision")
            etree.SubElement(collision, "origin", xyz=_text(np.array(center)), rpy="0 0 0")
            etree.SubElement(etree.SubElement(collision, "geometry"), "sphere", radius=repr(radius))
        joint = body.joint
        if joint is None:
            continue
        moves = joint.name in driven
        made = etree.SubElement(root, "joint", name=joint.name, type=joint.type if moves else "fixed")
        etree.SubElement(made, "parent", link=body.parent)
        etree.SubElement(made, "child", link=body.name)
        etree.SubElement(made, "origin", xyz=_text(body.origin[:3, 3]), rpy=_text(_rpy(body.origin)))
        if moves:
            etree.SubElement(made, "axis", xyz=_text(np.array(joint.axis or [1.0, 0.0, 0.0])))
            limit = {key: repr(float(getattr(joint.limit, key) or 0)) for key in ("effort", "velocity")}
            if joint.type != "continuous":
                limit |= {key: repr(float(getattr(joint.limit, key) or 0)) for key in ("lower", "upper")}
            etree.SubElement(made, "limit", **limit)
    return bytes(etree.tostring(root, encoding="utf-8", xml_declaration=True))


def dummies(robot: Robot, names: list[str], inertials: Mapping[str, InertialConfig]) -> list[str]:
    """Name the links whose inertia is surely a dummy: the same as that of a link with quite another mass."""
    given = {name: next(link for link in robot.links if link.name == name).inertial for name in names}
    told = {
        name: (each.mass, np.array(each.inertia.to_matrix()).tobytes())
        for name, each in given.items()
        if name not in inertials and each is not None and each.mass and each.inertia is not None
    }
    return [
        name
        for name, (mass, inertia) in told.items()
        if any(inertia == other and abs(mass - heavy) > 0.2 * mass for heavy, other in told.values())
    ]


def _from_the_base(links: Mapping[str, Link], joints: list[Joint]) -> list[str]:
    children = {joint.child for joint in joints}
    ordered = [name for name in links if name not in children]
    for parent in ordered:
        ordered += [joint.child for joint in joints if joint.parent == parent]
    return ordered


def _inertial(
    path: Path, link: Link, instead: InertialConfig | None, moves: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    if instead is not None:
        xx, xy, xz, yy, yz, zz = instead.inertia
        mass, com = instead.mass, np.array(instead.com)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    elif link.inertial is None or not link.inertial.mass or link.inertial.inertia is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    else:
        frame = transform(link.inertial.origin)
        mass, com = float(link.inertial.mass), frame[:3, 3]
        inertia = frame[:3, :3] @ np.array(link.inertial.inertia.to_matrix()) @ frame[:3, :3].T
    least, middle, most = np.linalg.eigvalsh(inertia)
    where = f"{path}: link '{link.name}' moves but its inertia"
    if moves and mass and not least > 0:
        raise UserError(f"{where} is not positive")
    if moves and mass and most > (1 + _ROUNDING) * (least + middle):
        raise UserError(
            f"{where} is none that a body can have: of its principal moments {least:.3g}, {middle:.3g} and {most:.3g} "
            f"kg m2 the largest is more than the others together; give it under 'inertials' in the robot's YAML"
        )
    return mass, com, inertia


def _together(parts: list[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Add up masses, centres and inertias (the parallel axis theorem)."""
    if len(parts) == 1:
        return parts[0]
    mass = sum(part[0] for part in parts)
    if not mass:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    com = sum((m * c for m, c, _ in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for m, c, about in parts:
        away = c - com
        inertia += about + m * (away @ away * np.eye(3) - np.outer(away, away))
    return mass, com, inertia


def _rpy(frame: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw, rad, of :func:`physai.robots.urdf.transform`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a link that looks straight up: it takes one of the answers
        return Rotation.from_matrix(frame[:3, :3]).as_euler("xyz")


def _text(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))
