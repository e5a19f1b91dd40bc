"""The shapes of a URDF's links are read as convex parts, and a shape that cannot be read is named."""

import re

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from physai.errors import UserError
from physai.robots.shapes import collision_parts, find_mesh

TWO_OBJECTS = (
    "o first\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    "o second\nv 5 0 0\nv 6 0 0\nv 5 1 0\nv 5 0 1\nf 5 6 7\nf 5 6 8\nf 5 7 8\nf 6 7 8\n"
)


def urdf(folder, *shapes: str):
    collisions = "".join(f"<collision><origin xyz='1 0 0' rpy='0 0 1.5707963'/>{shape}</collision>" for shape in shapes)
    path = folder / "arm.urdf"
    path.write_text(f"<robot name='arm'><link name='base'/><link name='hand'>{collisions}</link></robot>")
    return path


def geometry(shape: str) -> str:
    return f"<geometry>{shape}</geometry>"


def test_a_box_has_its_corners_where_its_origin_says(tmp_path):
    parts = collision_parts(urdf(tmp_path, geometry("<box size='0.2 0.4 0.6'/>")))
    assert list(parts) == ["hand"]
    (corners,) = parts["hand"]
    np.testing.assert_allclose(corners.min(axis=0), [0.8, -0.1, -0.3], atol=1e-7)
    np.testing.assert_allclose(corners.max(axis=0), [1.2, 0.1, 0.3], atol=1e-7)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ("<sphere radius='0.1'/>", 4 / 3 * np.pi * 0.1**3),
        ("<cylinder radius='0.1' length='0.3'/>", np.pi * 0.1**2 * 0.3),
    ],
)
def test_what_stands_in_for_a_round_shape_holds_it_and_is_little_larger(tmp_path, shape, volume):
    hull = ConvexHull(collision_parts(urdf(tmp_path, geometry(shape)))["hand"][0])
    assert volume <= hull.volume <= 1.1 * volume
    assert (hull.equations[:, :3] @ [1, 0, 0] + hull.equations[:, 3]).max() <= -0.1 + 1e-6  # how near its faces are


def test_each_object_of_a_mesh_is_a_part_and_its_scale_may_mirror_it(tmp_path):
    (tmp_path / "two.obj").write_text(TWO_OBJECTS)
    parts = collision_parts(urdf(tmp_path, geometry("<mesh filename='two.obj' scale='1 -1 2'/>")))["hand"]
    near, far = sorted((part.max(axis=0) for part in parts), key=lambda corner: corner[1])
    np.testing.assert_allclose(near, [2.0, 1.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(far, [2.0, 6.0, 2.0], atol=1e-6)


def test_a_package_is_looked_for_beside_the_urdf_and_above(tmp_path):
    folder = tmp_path / "description" / "urdf"
    folder.mkdir(parents=True)
    for place in (folder / "near.stl", tmp_path / "description" / "meshes" / "far.stl"):
        place.parent.mkdir(exist_ok=True)
        place.touch()
    assert find_mesh(folder / "arm.urdf", "near.stl") == folder / "near.stl"
    for name in ("package://meshes/far.stl", "package://description/meshes/far.stl"):
        assert find_mesh(folder / "arm.urdf", name) == tmp_path / "description" / "meshes" / "far.stl"


@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        ([], "no link has a <collision>, so there is nothing to fit capsules to"),
        ([""], "link 'hand': its <collision> has no geometry"),
        ([geometry("<cone/>")], "its <collision> is a <cone>, not a mesh, box, sphere or cylinder"),
        ([geometry("<box size='1 2'/>")], "<box size> is '1 2', which is not 3 positive"),
        ([geometry("<sphere radius='-1'/>")], "<sphere radius> is '-1', which is not 1 positive"),
        ([geometry("<cylinder radius='1'/>")], "<cylinder length> is '', which is not 1 positive"),
        ([geometry("<mesh/>")], "its <mesh> has no filename"),
        ([geometry("<mesh filename='none.stl'/>")], "no mesh 'none.stl' in its folder or in one above it"),
        ([geometry("<mesh filename='broken.stl'/>")], "broken.stl: the mesh is empty"),
        ([geometry("<mesh filename='arm.urdf'/>")], "arm.urdf: not a mesh that can be read"),
    ],
)
def test_a_shape_that_cannot_be_read_is_named_in_one_line(tmp_path, shapes, words):
    (tmp_path / "broken.stl").write_bytes(b"solid but no more")
    with pytest.raises(UserError, match=re.escape(words)) as caught:
        collision_parts(urdf(tmp_path, *shapes))
    assert len(str(caught.value).splitlines()) == 1
