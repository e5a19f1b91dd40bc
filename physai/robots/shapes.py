"""The shapes that a URDF gives its links for collisions, as convex parts."""

from pathlib import Path

import numpy as np
import trimesh
from lxml import etree
from scipy.spatial import ConvexHull, QhullError
from urdf_parser_py.urdf import Pose

from physai.errors import UserError
from physai.robots.urdf import parse, transform

_SIDES = 24  # of what stands in for a circle: it is 0.9 % larger at its corners


def collision_parts(path: Path) -> dict[str, list[np.ndarray]]:
    """Return the convex parts of each link that has a ``<collision>``.

    A mesh counts as the convex hull of each of its objects, as in PyBullet; round shapes count as polyhedra that hold
    them.

    Args:
        path: Of the URDF.

    Returns:
        By link, the corners of each part in the link's frame, m, [V, 3].

    Raises:
        UserError: If a shape is unknown, is broken, or its mesh cannot be found or read; or there is none at all.
    """
    found: dict[str, list[np.ndarray]] = {}
    for link in parse(path).getroot().findall("link"):
        parts = [part for shape in link.findall("collision") for part in _parts(path, link.get("name"), shape)]
        if parts:
            found[link.get("name")] = parts
    if not found:
        raise UserError(f"{path}: no link has a <collision>, so there is nothing to fit capsules to")
    return found


def find_mesh(path: Path, filename: str) -> Path:
    """Return the file that a URDF means by the name of a mesh.

    ``package://`` is taken away; what is left lies in the URDF's folder or in one above it.

    Raises:
        UserError: If there is none.
    """
    inside = filename.removeprefix("package://").removeprefix("file://")
    for folder in [path.parent, *list(path.parents)[1:6]]:
        if (folder / inside).is_file():
            return folder / inside
    raise UserError(f"{path}: no mesh '{filename}' in its folder or in one above it")


def geometry(where: str, shape: etree._Element) -> etree._Element:
    """Return what a <collision> or a <visual> looks like: a mesh, box, sphere or cylinder.

    Raises:
        UserError: If it does not say.
    """
    found = shape.find("geometry")
    children = [] if found is None else [child for child in found if isinstance(child.tag, str)]
    if not children:
        raise UserError(f"{where}: its <{shape.tag}> has no geometry")
    return children[0]


def _parts(path: Path, link: str, shape: etree._Element) -> list[np.ndarray]:
    where = f"{path}: link '{link}'"
    element = geometry(where, shape)
    if element.tag == "mesh":
        corners = [points * numbers(where, element, "scale", 3, "1 1 1") for points in _mesh(path, where, element)]
    elif element.tag == "box":
        corners = [0.5 * numbers(where, element, "size", 3) * _CUBE]
    elif element.tag == "sphere":
        corners = [numbers(where, element, "radius", 1) * _BALL]
    elif element.tag == "cylinder":
        radius, length = (numbers(where, element, key, 1) for key in ("radius", "length"))
        corners = [np.concatenate([radius, radius, 0.5 * length]) * _CAN]
    else:
        raise UserError(f"{where}: its <collision> is a <{element.tag}>, not a mesh, box, sphere or cylinder")
    frame = transform(origin(shape))
    return [_hull(points) @ frame[:3, :3].T + frame[:3, 3] for points in corners]


def _mesh(path: Path, where: str, element: etree._Element) -> list[np.ndarray]:
    filename = element.get("filename")
    if not filename:
        raise UserError(f"{where}: its <mesh> has no filename")
    file = find_mesh(path, filename)
    try:
        # Objects, not materials: these would be parts that are smaller together than the hull of the object.
        scene = trimesh.load_scene(file, process=False, split_objects=True, group_material=False, skip_materials=True)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
        parts = [np.asarray(mesh.vertices, dtype=np.float64) for mesh in meshes]
    except Exception as error:  # whatever a reader makes of a broken file
        raise UserError(f"{where}: {file}: not a mesh that can be read: {' '.join(str(error).split())}") from error
    if not parts or not all(len(part) and np.isfinite(part).all() for part in parts):
        raise UserError(f"{where}: {file}: the mesh is empty, or a number of it is not finite")
    return parts


def _hull(points: np.ndarray) -> np.ndarray:
    """Leave out the points that lie between others."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # all in a plane, or fewer than four
        return np.unique(points, axis=0)


def numbers(where: str, element: etree._Element, key: str, count: int, absent: str = "") -> np.ndarray:
    """Read ``count`` numbers of an attribute: positive ones, but a scale may mirror.

    Raises:
        UserError: If it has others; the line begins with ``where``.
    """
    text = element.get(key, absent)
    try:
        numbers = np.array(text.split(), dtype=np.float64)
    except ValueError:
        numbers = np.zeros(0)
    mirrored = key == "scale"  # which may be negative
    if (
        numbers.shape != (count,)
        or not np.isfinite(numbers).all()
        or not (numbers > 0).all() | (mirrored and numbers.all())
    ):
        raise UserError(f"{where}: <{element.tag} {key}> is '{text}', which is not {count} positive number(s)")
    return numbers


def origin(shape: etree._Element) -> Pose | None:
    """Return where a shape is in the frame of its link; None: in the frame itself."""
    element = shape.find("origin")
    if element is None:
        return None
    xyz, rpy = ([float(part) for part in element.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
    return Pose(xyz=xyz, rpy=rpy)


def _ring() -> np.ndarray:
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.cos(np.pi / _SIDES)


def _ball() -> np.ndarray:
    ball = trimesh.creation.icosphere(subdivisions=2)
    inside = np.einsum("fi,fi->f", ball.face_normals, ball.triangles[:, 0]).min()  # how near a face is to the centre
    return np.asarray(ball.vertices) / inside


_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_CAN = np.concatenate([np.column_stack([_ring(), np.full(_SIDES, side)]) for side in (-1.0, 1.0)])
_BALL = _ball()
