"""The robot of a policy as a URDF on a topic, from the kinematics and capsules in the policy file."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as Xml

import numpy as np

from physai.collision import Capsule
from physai.deploy import Metadata

TOPIC = "~/robot_description"
_THICKNESS = 0.03  # of a link without capsules, as a share of its length
_THINNEST = 0.01  # m
_COLOR = "0.95 0.45 0.12 1"


def urdf(metadata: Metadata, prefix: str) -> str:
    """Describe the robot of a policy; tools that know URDFs and joint states can draw it.

    Links look like the capsules of the policy file, or like sticks from joint to joint where it has none. Legs stand on
    the floor as they do at home.

    Args:
        metadata: Of the policy.
        prefix: Of the names of links, so that several robots have frames of their own; empty for none.

    Returns:
        XML.
    """
    motions, ends = metadata.kinematics.motions, metadata.kinematics.ends
    places = motions.constant + motions.cosine  # of joints at zero, in the frame before
    bodies = [prefix + name for name in (metadata.goal.frame or "base", *(f"{j}_body" for j in metadata.joints))]
    robot = Xml.Element("robot", name=metadata.robot)
    Xml.SubElement(robot, "link", name="world")
    stand = np.eye(4)
    stand[2, 3] = metadata.kinematics.height
    _add_joint(robot, f"{prefix}stand", "fixed", "world", bodies[0], stand)
    for number, joint in enumerate(metadata.joints):
        added = _add_joint(
            robot, joint, "revolute", bodies[motions.carriers[number]], bodies[number + 1], places[number]
        )
        Xml.SubElement(added, "axis", xyz=_numbers(_axis(places[number], motions.sine[number])))
        Xml.SubElement(added, "limit", _limit(metadata, number))
    leads_to = [*zip(motions.carriers, places, strict=True), *ends]
    for number, name in enumerate(bodies):
        link = Xml.SubElement(robot, "link", name=name)
        for capsule in _shapes(metadata, number, [end[:3, 3] for body, end in leads_to if body == number]):
            _add_capsule(link, capsule)
    for number, (body, end) in enumerate(ends, 1):
        name = "tip" if len(ends) == 1 else f"foot{number}"
        Xml.SubElement(robot, "link", name=f"{prefix}{name}")
        _add_joint(robot, f"{prefix}to_{name}", "fixed", bodies[body], f"{prefix}{name}", end)
    return Xml.tostring(robot, encoding="unicode")


def _axis(place: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Of the turn in the joint's own frame: at zero its derivative is ``sine``."""
    turn = place[:3, :3].T @ sine[:3, :3]
    return np.array([turn[2, 1], turn[0, 2], turn[1, 0]])


def _limit(metadata: Metadata, number: int) -> dict[str, str]:
    low, high = metadata.position_limit[number]
    bounds = {"lower": low, "upper": high} if math.isfinite(high - low) else {"lower": -1e3, "upper": 1e3}
    values = {**bounds, "effort": metadata.effort_limit[number], "velocity": metadata.velocity_limit[number]}
    return {key: f"{value:g}" for key, value in values.items()}


def _shapes(metadata: Metadata, body: int, ends: Sequence[np.ndarray]) -> Iterator[Capsule]:
    if metadata.collision is not None:
        yield from (capsule for capsule in metadata.collision.capsules if capsule.body == body)
        return
    for end in ends:
        if (length := float(np.linalg.norm(end))) > 0:
            x, y, z = end.tolist()
            yield Capsule("stick", body, (0.0, 0.0, 0.0), (x, y, z), max(_THICKNESS * length, _THINNEST))


def _add_joint(robot: Xml.Element, name: str, kind: str, parent: str, child: str, place: np.ndarray) -> Xml.Element:
    joint = Xml.SubElement(robot, "joint", name=name, type=kind)
    Xml.SubElement(joint, "parent", link=parent)
    Xml.SubElement(joint, "child", link=child)
    Xml.SubElement(joint, "origin", xyz=_numbers(place[:3, 3]), rpy=_numbers(_roll_pitch_yaw(place)))
    return joint


def _add_capsule(link: Xml.Element, capsule: Capsule) -> None:
    """A cylinder and the spheres at its ends: a URDF has no capsules."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    way, radius = end - start, f"{capsule.radius:g}"
    length = float(np.linalg.norm(way))
    for point in (start, end) if length else (start,):
        Xml.SubElement(_add_visual(link, point, (0.0, 0.0, 0.0)), "sphere", radius=radius)
    if length:
        turn = (0.0, math.atan2(math.hypot(way[0], way[1]), way[2]), math.atan2(way[1], way[0]))
        cylinder = _add_visual(link, (start + end) / 2, turn)
        Xml.SubElement(cylinder, "cylinder", radius=radius, length=f"{length:g}")


def _add_visual(link: Xml.Element, at: Sequence[float] | np.ndarray, turn: Sequence[float]) -> Xml.Element:
    visual = Xml.SubElement(link, "visual")
    Xml.SubElement(visual, "origin", xyz=_numbers(at), rpy=_numbers(turn))
    material = Xml.SubElement(visual, "material", name="physai")
    Xml.SubElement(material, "color", rgba=_COLOR)
    return Xml.SubElement(visual, "geometry")


def _roll_pitch_yaw(place: np.ndarray) -> tuple[float, float, float]:
    r = place[:3, :3]
    pitch = math.atan2(-r[2, 0], math.hypot(r[2, 1], r[2, 2]))
    if math.hypot(r[2, 1], r[2, 2]) < 1e-6:  # straight up or down: roll and yaw are one turn
        return math.atan2(-r[1, 2], r[1, 1]), pitch, 0.0
    return math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


@dataclass(frozen=True)
class Transform:
    """Where a link is in the frame of the one before.

    Attributes:
        parent: Name of that link.
        child: Name of the link.
        position: m, [3].
        orientation: Quaternion, x y z w.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class LinkFrames:
    """Where the links of a URDF are whose joints turn.

    Args:
        text: The URDF, of :func:`urdf` or of anybody else.

    Raises:
        ValueError: If it is none.
    """

    def __init__(self, text: str) -> None:
        try:
            self._joints = [_Joint(each) for each in Xml.fromstring(text).iter("joint")]
        except (Xml.ParseError, AttributeError, KeyError, ValueError) as error:
            raise ValueError(f"no URDF: {error}") from error

    @property
    def base(self) -> str:
        """Name of the frame that the first joint turns in: the robot stands there."""
        return next((joint.parent for joint in self._joints if joint.axis is not None), "")

    @property
    def joints(self) -> list[str]:
        """Names of the joints that turn, in the order of the file."""
        return [joint.name for joint in self._joints if joint.axis is not None]

    def at(self, joint_position: Mapping[str, float]) -> list[Transform]:
        """Return a transform for each joint; rad, by name. A joint that is not named is at zero."""
        return [joint.at(joint_position.get(joint.name, 0.0)) for joint in self._joints]


class _Joint:
    def __init__(self, element: Xml.Element) -> None:
        self.name = element.attrib["name"]
        self.parent, self.child = (element.find(key).attrib["link"] for key in ("parent", "child"))  # type: ignore[union-attr]
        origin = element.find("origin")
        place = {} if origin is None else origin.attrib
        x, y, z = map(float, place.get("xyz", "0 0 0").split())
        self.position = x, y, z
        roll, pitch, yaw = map(float, place.get("rpy", "0 0 0").split())
        turns = _turn((0, 0, 1), yaw), _turn((0, 1, 0), pitch), _turn((1, 0, 0), roll)
        self.orientation = _product(_product(turns[0], turns[1]), turns[2])
        self.axis: tuple[float, ...] | None = None
        if element.attrib["type"] in ("revolute", "continuous"):
            axis = element.find("axis")
            told = "1 0 0" if axis is None else axis.attrib["xyz"]
            values = np.array([*map(float, told.split())])
            self.axis = tuple((values / np.linalg.norm(values)).tolist())

    def at(self, angle: float) -> Transform:
        turned = self.orientation if self.axis is None else _product(self.orientation, _turn(self.axis, angle))
        return Transform(self.parent, self.child, self.position, turned)


Quaternion = tuple[float, float, float, float]


def _turn(axis: Sequence[float], angle: float) -> Quaternion:
    x, y, z = (each * math.sin(angle / 2) for each in axis)
    return x, y, z, math.cos(angle / 2)


def _product(one: Quaternion, other: Quaternion) -> Quaternion:
    (ax, ay, az, aw), (bx, by, bz, bw) = one, other
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
