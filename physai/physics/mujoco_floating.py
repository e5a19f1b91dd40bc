"""Robots whose base nothing holds, on a floor, in MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
from mujoco.batch import Batch

from physai.physics.interface import DynamicsParameters, RobotState
from physai.physics.rotation import rotate, rotate_back
from physai.robots import FloatingBase

_POSITION, _QUATERNION = slice(0, 3), [4, 5, 6, 3]  # MuJoCo has w, x, y, z


def put_on_floor(made: "mujoco.MjSpec", floating: FloatingBase, base: str) -> None:
    """Let the base of a robot go, put a floor below it, and sense which links touch that.

    Only spheres and floor meet, and friction and softness are those of the spheres. Links are told apart by the force
    that a sensor of each body's spheres feels.
    """
    made.body(base).add_freejoint()
    floor = made.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], name="floor")
    floor.contype, floor.conaffinity = 1, 2
    unnamed = {(geom.parent.name, *geom.pos, geom.size[0]): geom for geom in made.geoms if geom is not floor}
    for index, sphere in enumerate(floating.spheres):
        geom = unnamed[(sphere.body, *sphere.center, sphere.radius)]
        geom.name, geom.contype, geom.conaffinity, geom.priority = f"sphere{index}", 2, 1, 1
        sensor = made.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT, name=geom.name)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, geom.name
        sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1]


class FloatingBodies:
    """Poses, twists and contacts of N robots; part of :class:`physai.physics.mujoco.MuJoCoPhysics`.

    Args:
        floating: The robot's.
        base: Name of the body that is its base.
        batch: The robots.
    """

    def __init__(self, floating: FloatingBase, base: str, batch: Batch) -> None:
        self._pose, self._twist = batch.bind("qpos")[:, :7], batch.bind("qvel")[:, :6]
        self._warm_start, self._found = batch.bind("qacc_warmstart"), batch.bind("sensordata")
        model = batch.model
        self._spheres = [model.geom(f"sphere{index}").id for index in range(len(floating.spheres))]
        self._friction, self._contact_time = batch.expand("geom_friction"), batch.expand("geom_solref")
        self._centers = batch.expand("body_ipos")
        self._base = model.body(base).id
        self._center = model.body_ipos[self._base].copy()
        links = [floating.links.index(sphere.link) for sphere in floating.spheres]
        self._of_link = np.eye(len(floating.links), dtype=bool)[links]  # [spheres, links]
        self._contact = np.zeros((batch.nsim, len(floating.links)), bool)

    def reset(self, rows: np.ndarray, state: RobotState) -> None:
        """Put bases into the pose and twist of a state."""
        assert state.base_pose is not None
        assert state.base_twist is not None
        self._pose[rows[:, None], [0, 1, 2, *_QUATERNION]] = state.base_pose
        self._twist[rows, :3] = state.base_twist[:, :3]
        self._twist[rows, 3:] = rotate_back(state.base_pose[:, 3:], state.base_twist[:, 3:])  # MuJoCo's, of the body
        self._warm_start[rows] = 0.0
        self._contact[rows] = False

    def set(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        """Give them new dynamics."""
        self._friction[rows[:, None], self._spheres, 0] = parameters["floor_friction"]
        self._contact_time[rows[:, None], self._spheres, 0] = parameters["contact_time"]
        self._centers[rows, self._base] = self._center + parameters["center_of_mass"]

    def parameters(self) -> DynamicsParameters:
        """Return their dynamics, as MuJoCo holds them."""
        one = self._spheres[:1]
        return {
            "floor_friction": self._friction[:, one, 0],
            "contact_time": self._contact_time[:, one, 0],
            "center_of_mass": self._centers[:, self._base] - self._center,
        }

    def update(self) -> None:
        """See which links touch the floor."""
        self._contact = (self._found > 0) @ self._of_link

    def added_to(self, state: RobotState) -> RobotState:
        """Return a state with what there is to know of the bases."""
        pose = self._pose[:, [0, 1, 2, *_QUATERNION]]
        twist = self._twist.copy()
        twist[:, 3:] = rotate(pose[:, 3:], twist[:, 3:])
        return replace(state, base_pose=pose, base_twist=twist, contact=self._contact.copy())

    def state(self) -> dict[str, np.ndarray]:
        """Return what ``set_state`` needs, after a reset to the same pose and twist, to go on bit for bit."""
        names = {"base": self._pose, "base_velocity": self._twist, "warm_start": self._warm_start}
        told = self.added_to(RobotState(self._pose, self._pose))
        assert told.base_pose is not None
        assert told.base_twist is not None
        poses = {"base_pose": told.base_pose, "base_twist": told.base_twist, "contact": self._contact.copy()}
        return {**{name: value.copy() for name, value in names.items()}, **poses}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what ``state`` returned."""
        self._pose[:], self._twist[:], self._warm_start[:] = state["base"], state["base_velocity"], state["warm_start"]
        self._contact = state["contact"].copy()
