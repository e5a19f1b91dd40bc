"""The feet of a robot on legs: what carries them, and how its joints move them."""

import numpy as np

from physai.robots.chain import carried
from physai.robots.spec import RobotSpec

_STEP = 1e-6  # rad, of the difference quotients


def feet(spec: RobotSpec) -> tuple[tuple[int, np.ndarray], ...]:
    """Return for each foot, in the order of the spheres, the number of its body and its frame in that one's, 4 x 4.

    Bodies are numbered as in :class:`physai.collision.Motions`; the origin of a foot is the centre of its sphere.
    """
    assert spec.floating is not None, f"'{spec.name}' has no feet"
    links, found = carried(spec.linkage, spec.base, spec.joints), []
    for sphere in spec.floating.spheres:
        if sphere.link in spec.floating.foot_links:
            body, frame = links[sphere.body]
            foot = np.eye(4)
            foot[:3, 3] = frame[:3, :3] @ sphere.center + frame[:3, 3]
            found.append((body, foot))
    return tuple(found)


def feet_at_home(spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return where the f feet are at home in the base's frame, m, [f, 3], and their Jacobian, m/rad, [f, 3, n]."""
    steps = _STEP * np.eye(len(spec.joints))
    frames = spec.motions.frames(np.concatenate([spec.home[np.newaxis], spec.home + steps, spec.home - steps]))
    places = [np.einsum("ijr,j->ir", frames[body], foot[:, 3]) for body, foot in feet(spec)]
    home, ahead, behind = np.split(np.stack(places), [1, 1 + len(steps)], axis=2)
    return home[..., 0], (ahead - behind) / (2 * _STEP)
