"""Shapes of <visual> look as their files say, and in daylight."""

import json
import struct

import pytest
import trimesh

from physai.robots.visuals import visual_bodies

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl paint\nf 1/1 2/1 3/1\n"


def shown(folder, file):
    """The material of a mesh, as a page gets it."""
    path = folder / "arm.urdf"
    visual = f"<visual><geometry><mesh filename='{file}'/></geometry></visual>"
    path.write_text(f"<robot name='arm'><link name='base'>{visual}</link></robot>")
    ((mesh,),) = visual_bodies(path, "base", [])
    binary = trimesh.Scene([mesh]).export(file_type="glb")
    header = json.loads(binary[20 : 20 + struct.unpack("<I", binary[12:16])[0]])
    return header["materials"][0]["pbrMetallicRoughness"]


def test_what_a_file_does_not_call_metal_is_none(tmp_path):
    """Metal is black where there is nothing to reflect."""
    (tmp_path / "hand.mtl").write_text("newmtl paint\nKd 0.2 0.6 0.4\n")
    (tmp_path / "hand.obj").write_text(f"mtllib hand.mtl\n{TRIANGLE}")
    look = shown(tmp_path, "hand.obj")
    assert look["metallicFactor"] == pytest.approx(0.1)
    assert look["baseColorFactor"][:3] == pytest.approx([0.2, 0.6, 0.4], abs=0.01)


def test_what_a_file_calls_metal_stays_metal(tmp_path):
    mesh = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    steel = trimesh.visual.material.PBRMaterial(baseColorFactor=(90, 90, 99, 255), metallicFactor=0.9)
    mesh.visual = trimesh.visual.TextureVisuals(material=steel)
    mesh.export(tmp_path / "hand.glb")
    assert shown(tmp_path, "hand.glb")["metallicFactor"] == pytest.approx(0.9)
