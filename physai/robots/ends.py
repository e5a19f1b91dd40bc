"""Where the links of a robot end: at its end effector, or at its feet, and how the joints move these."""

import numpy as np

from physai.collision import Kinematics
from physai.robots.chain import carried
from physai.robots.spec import RobotSpec

_STEP = 1e-6  # rad, of the difference quotients


def kinematics_of(spec: RobotSpec) -> Kinematics:
    """Return what each joint of a robot moves, and where its links end; feet are spheres, in their order."""
    height = spec.floating.height if spec.floating else 0.0
    if (tip := spec.tip) is not None:
        return Kinematics(spec.motions, ((len(spec.joints), tip),), height)
    assert spec.floating is not None
    links, feet = carried(spec.linkage, spec.base, spec.joints), []
    for sphere in spec.floating.spheres:
        if sphere.link in spec.floating.foot_links:
            body, frame = links[sphere.body]
            foot = np.eye(4)
            foot[:3, 3] = frame[:3, :3] @ sphere.center + frame[:3, 3]
            feet.append((body, foot))
    return Kinematics(spec.motions, tuple(feet), height)


def ends_at_home(spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return where the e ends are at home in the base's frame, m, [e, 3], and their Jacobian, m/rad, [e, 3, n]."""
    steps = _STEP * np.eye(len(spec.joints))
    places = kinematics_of(spec).places(np.concatenate([spec.home[np.newaxis], spec.home + steps, spec.home - steps]))
    home, ahead, behind = np.split(places, [1, 1 + len(steps)], axis=2)
    return home[..., 0], (ahead - behind) / (2 * _STEP)
