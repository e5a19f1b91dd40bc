"""Pictures of the capsules of a robot over its shapes, to be checked by eye."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from physai.collision import Capsule
from physai.robots import RobotSpec, urdf
from physai.robots.chain import carried

_SIDES = 14  # of a capsule that is drawn


def plot_capsules(spec: RobotSpec, parts: Mapping[str, Sequence[np.ndarray]], output: Path) -> None:
    """Draw a robot that has capsules at home and in two random poses.

    Args:
        spec: The robot.
        parts: Corners of the convex parts of its links, in their frames, m, [V, 3] each.
        output: The PNG to write.
    """
    assert spec.collision is not None
    carriers = carried(urdf.load(spec.urdf).joints, spec.base, spec.joints)
    bodies = [(carriers[link], points) for link, convex in parts.items() for points in convex]
    shapes = [(body, points @ local[:3, :3].T + local[:3, 3]) for (body, local), points in bodies]
    poses = np.concatenate([spec.home[np.newaxis], spec.sample(2, np.random.default_rng(1))])
    figure = Figure(figsize=(18, 7), layout="constrained")
    for place, pose in enumerate(poses):
        axis = figure.add_subplot(1, 3, place + 1, projection="3d")
        axis.set_title(f"{'home' if place == 0 else 'random'}: {np.array2string(pose, precision=1)} rad")
        _draw(axis, spec.collision.capsules, shapes, spec.collision.motions.frames(pose[np.newaxis])[..., 0])
    figure.savefig(output, dpi=110)


def _draw(
    axis: Axes3D, capsules: Sequence[Capsule], shapes: Sequence[tuple[int, np.ndarray]], frames: np.ndarray
) -> None:
    """Draw capsules, and shapes given by body and corners [V, 3], where the frames of the bodies [n + 1, 3, 4] are."""
    drawn = []
    for body, points in shapes:
        corners = points @ frames[body][:, :3].T + frames[body][:, 3]
        faces = corners[ConvexHull(corners).simplices]
        axis.add_collection3d(Poly3DCollection(faces, facecolor="0.4", edgecolor="none", alpha=0.5))
        drawn.append(corners)
    for capsule in capsules:
        frame = frames[capsule.body]
        surface = _surface(capsule) @ frame[:, :3].T + frame[:, 3]
        color = colormaps["turbo"](capsule.body / (len(frames) - 1))
        axis.plot_wireframe(*np.moveaxis(surface, -1, 0), color=color, linewidth=0.5)
        drawn.append(surface.reshape(-1, 3))
    low, high = np.concatenate(drawn).min(axis=0), np.concatenate(drawn).max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low)
    axis.view_init(15, -60)


def _surface(capsule: Capsule) -> np.ndarray:
    """Points on a capsule in rings from one end to the other, [rings, sides, 3]."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    way = (end - start) if (end != start).any() else np.array([0.0, 0.0, 1.0])
    basis = np.linalg.svd(way[np.newaxis])[2]
    basis[0] = way / np.linalg.norm(way)
    height = np.linspace(-np.pi / 2, np.pi / 2, _SIDES)
    around = np.linspace(0, 2 * np.pi, _SIDES)
    ring = np.cos(around)[:, np.newaxis] * basis[1] + np.sin(around)[:, np.newaxis] * basis[2]
    centers = (
        np.where(height[:, np.newaxis] < 0, start, end) + capsule.radius * np.sin(height)[:, np.newaxis] * basis[0]
    )
    return centers[:, np.newaxis] + capsule.radius * np.cos(height)[:, np.newaxis, np.newaxis] * ring
