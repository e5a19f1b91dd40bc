"""Reading a URDF: ROS 2's own parser does it, this module finds what it lets pass and names the culprit."""

import contextlib
import importlib.resources
import io
import math
from pathlib import Path

import numpy as np
from lxml import etree
from urdf_parser_py.urdf import Pose, Robot

from physai.errors import UserError

_NUMERIC = {
    "mass": ["value"],
    "inertia": ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"],
    "origin": ["xyz", "rpy"],
    "axis": ["xyz"],
    "limit": ["lower", "upper", "effort", "velocity"],
    "dynamics": ["damping", "friction"],
}


def resolve(uri: str) -> Path:
    """Return the file that ``package://<python package>/<path>``, or a plain path, stands for.

    Raises:
        UserError: If the package or the file does not exist.
    """
    path = Path(uri).expanduser()
    if uri.startswith("package://"):
        package, _, inside = uri.removeprefix("package://").partition("/")
        try:
            path = Path(str(importlib.resources.files(package))) / inside
        except (ModuleNotFoundError, ValueError) as error:
            raise UserError(f"{uri}: there is no Python package '{package}' here") from error
    if not path.is_file():
        raise UserError(f"{uri}: no such URDF file ({path})")
    return path.resolve()


def parse(path: Path) -> etree._ElementTree:
    """Read the XML of a URDF and check what any robot needs, whatever it will be used for.

    Raises:
        UserError: If the XML is broken, a number is none, or a link or joint contradicts itself.
    """
    try:
        tree = etree.parse(path, etree.XMLParser(remove_comments=True))
    except (etree.XMLSyntaxError, OSError) as error:
        raise UserError(f"{path}: not well-formed XML: {' '.join(str(error).split())}") from error
    root = tree.getroot()
    if root.tag != "robot" or "name" not in root.attrib:
        raise UserError(f"{path}: the top element must be <robot name=...>, found <{root.tag}>")
    links = [_named(path, link) for link in root.findall("link")]
    for name in {name for name in links if links.count(name) > 1}:
        raise UserError(f"{path}: link '{name}' is defined twice")
    for link in root.findall("link"):
        _check_numbers(path, link)
        _check_inertial(path, link)
    for joint in root.findall("joint"):
        _check_numbers(path, joint)
        name = _named(path, joint)
        if (kind := joint.get("type")) in ("floating", "planar"):
            raise UserError(f"{path}: joint '{name}' is {kind}: nothing would hold what hangs on it; make it fixed")
        for end in ("parent", "child"):
            element = joint.find(end)
            link = None if element is None else element.get("link")
            if link not in links:
                raise UserError(f"{path}: joint '{name}': its {end} link '{link}' does not exist")
    return tree


def load(path: Path) -> Robot:
    """Read the links, with their inertia, and the joints of a URDF; no shapes, and nothing else it may hold.

    Raises:
        UserError: See :func:`parse`; or something that a URDF must have is missing.
    """
    robot = parse(path).getroot()
    for element in [*robot.xpath("*[not(self::link or self::joint)]"), *robot.xpath("link/*[not(self::inertial)]")]:
        element.getparent().remove(element)
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # where it names every tag that it does not know
            return Robot.from_xml_string(etree.tostring(robot))
    except Exception as error:  # whatever the parser makes of it
        raise UserError(f"{path}: not a valid URDF: {' '.join(str(error).split()) or type(error).__name__}") from error


def transform(origin: Pose | None) -> np.ndarray:
    """Return the 4 x 4 matrix of an ``<origin>``: roll, pitch and yaw about fixed axes, rad, then the way to go, m."""
    matrix = np.eye(4)
    if origin is not None:
        (cr, cp, cy), (sr, sp, sy) = np.cos(origin.rpy), np.sin(origin.rpy)
        matrix[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        matrix[:3, 3] = origin.xyz
    return matrix


def _named(path: Path, element: etree._Element) -> str:
    name = element.get("name")
    if not name:
        raise UserError(f"{path}: line {element.sourceline}: a <{element.tag}> has no name")
    return name


def _check_numbers(path: Path, element: etree._Element) -> None:
    where = f"{path}: {element.tag} '{_named(path, element)}'"
    for tag, attributes in _NUMERIC.items():
        for child in element.iter(tag):
            for attribute in attributes:
                text = child.get(attribute)
                wanted = 3 if attribute in ("xyz", "rpy") else 1
                if text is None:
                    continue
                try:
                    numbers = [float(part) for part in text.split()]
                except ValueError:
                    numbers = []
                if len(numbers) != wanted or not all(map(math.isfinite, numbers)):
                    many = "a finite number" if wanted == 1 else "three finite numbers"
                    raise UserError(f"{where}: <{tag} {attribute}> is '{text}', which is not {many}")


def _check_inertial(path: Path, link: etree._Element) -> None:
    where = f"{path}: link '{link.get('name')}'"
    inertial = link.find("inertial")
    if inertial is None:
        return
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        raise UserError(f"{where}: <inertial> needs both <mass> and <inertia>")
    if mass.get("value") is None:
        raise UserError(f"{where}: its <mass> has no value")
    if float(mass.get("value")) < 0:
        raise UserError(f"{where}: its mass is negative ({mass.get('value')})")
    xx, xy, xz, yy, yz, zz = (float(inertia.get(key, 0)) for key in _NUMERIC["inertia"])
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if moments[0] < 0:
        raise UserError(f"{where}: its inertia is impossible: a principal moment is negative ({moments[0]:g})")
