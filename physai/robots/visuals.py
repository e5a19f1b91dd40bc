"""What a URDF says its robot looks like: the shapes of ``<visual>``, body by body."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh
from lxml import etree

from physai.errors import UserError
from physai.robots.chain import carried
from physai.robots.shapes import find_mesh, geometry, numbers, origin
from physai.robots.urdf import load, parse, transform

Color = tuple[int, int, int, int]

GREY: Color = (160, 165, 172, 255)  # of what has no colour
METALLIC = 0.1  # of what nobody calls metal: from 0, as plastic, to 1


def visual_bodies(urdf: Path, base: str, joints: Sequence[str]) -> list[list[trimesh.Trimesh]]:
    """Return what is seen of each body: of the base, then of what each driven joint moves.

    Args:
        urdf: Its file.
        base: Name of the first link.
        joints: Names of the n driven joints, in order.

    Returns:
        Meshes in the body's frame, m, of n + 1 bodies; empty lists where nothing is seen.

    Raises:
        UserError: If a shape is unknown or broken, or its mesh cannot be found or read.
    """
    root = parse(urdf).getroot()
    named = {material.get("name"): _rgba(material) for material in root.iter("material") if _rgba(material)}
    bodies: list[list[trimesh.Trimesh]] = [[] for _ in range(len(joints) + 1)]
    where = carried(load(urdf).joints, base, joints)
    for link in root.findall("link"):
        if link.get("name") not in where:  # what the base itself stands on
            continue
        body, frame = where[link.get("name")]
        for shape in link.findall("visual"):
            material = shape.find("material")
            color = None if material is None else _rgba(material) or named.get(material.get("name"))
            for mesh in _meshes(urdf, link.get("name"), shape, color):
                mesh.apply_transform(frame @ transform(origin(shape)))
                bodies[body].append(mesh)
    return bodies


def _rgba(material: etree._Element) -> Color | None:
    color = material.find("color")
    if color is None:
        return None
    try:
        red, green, blue, alpha = (round(255 * min(max(float(part), 0.0), 1.0)) for part in color.get("rgba").split())
    except (ValueError, AttributeError):
        return None
    return red, green, blue, alpha


def _meshes(path: Path, link: str, shape: etree._Element, color: Color | None) -> Iterator[trimesh.Trimesh]:
    where = f"{path}: link '{link}'"
    element = geometry(where, shape)
    if element.tag == "mesh":
        scale = numbers(where, element, "scale", 3, "1 1 1")
        for mesh in _load(path, where, element):
            mesh.apply_scale(scale)
            if not _has_color(mesh):
                mesh.visual = plain(color)
            yield mesh
        return
    if element.tag == "box":
        mesh = trimesh.creation.box(extents=numbers(where, element, "size", 3))
    elif element.tag == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=float(numbers(where, element, "radius", 1)[0]))
    elif element.tag == "cylinder":
        radius, length = (float(numbers(where, element, key, 1)[0]) for key in ("radius", "length"))
        mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=48)
    else:
        raise UserError(f"{where}: its <visual> is a <{element.tag}>, not a mesh, box, sphere or cylinder")
    mesh.visual = plain(color)
    yield mesh


def _load(path: Path, where: str, element: etree._Element) -> list[trimesh.Trimesh]:
    file = find_mesh(path, element.get("filename") or "")
    try:
        found = [mesh for mesh in trimesh.load_scene(file).dump() if isinstance(mesh, trimesh.Trimesh)]
    except Exception as error:  # whatever a reader makes of a broken file
        raise UserError(f"{where}: {file}: not a mesh that can be read: {' '.join(str(error).split())}") from error
    if not found or not all(len(mesh.vertices) and np.isfinite(mesh.vertices).all() for mesh in found):
        raise UserError(f"{where}: {file}: the mesh is empty, or a number of it is not finite")
    return found


def _has_color(mesh: trimesh.Trimesh) -> bool:
    """Whether the file of a mesh says how it looks."""
    visual = mesh.visual
    return visual is not None and visual.defined and visual.kind in ("texture", "vertex", "face")


def plain(color: Color | None) -> trimesh.visual.TextureVisuals:
    """Return the look of one colour, grey where there is none."""
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=color or GREY, metallicFactor=METALLIC, roughnessFactor=0.6
    )
    return trimesh.visual.TextureVisuals(material=material)
