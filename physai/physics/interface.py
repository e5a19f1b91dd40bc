"""What the rest of physai expects of a physics engine."""

from dataclasses import dataclass, fields, replace
from typing import ClassVar, Protocol

import numpy as np

from physai.robots import RobotSpec

DynamicsParameters = dict[str, np.ndarray]
"""Per robot and absolute, each [rows, k]: ``link_mass`` (kg, one a moving link), ``payload`` (kg at the tip, 1), and
one a joint of ``joint_damping`` (N·m·s/rad), ``joint_friction`` (N·m), ``effort_limit`` (N·m), ``armature`` (of the
rotor, as the joint feels it through the gears, kg·m²), and ``velocity_gain`` (in (0, 1]: the share of the missing
velocity that a motor makes up for in one control period of one step; at any number of substeps, a gain g is a motor
with the time constant (1 - g) / g, in control periods).

Joints that are springs have, in the place of that gain, ``stiffness`` (N·m/rad) and ``servo_damping`` (N·m·s/rad). A
robot whose base floats has ``floor_friction`` (a coefficient, 1), ``contact_time`` (of contacts with the floor: the
time constant with which what has sunk in is pushed out, s, 1; MuJoCo's have two of its steps at least), and
``center_of_mass`` (of the base: how far it is from where the description has it, m, in the base's frame, 3)."""


def nominal_dynamics(spec: RobotSpec) -> DynamicsParameters:
    """Return the robot as its URDF describes it, one row."""
    nominal = {
        "link_mass": spec.link_mass[None],
        "payload": np.zeros((1, 1)),
        "joint_damping": spec.damping[None],
        "joint_friction": spec.friction[None],
        "effort_limit": spec.effort_limit[None],
        "armature": spec.armature[None],
    }
    if spec.servo is None:
        nominal["velocity_gain"] = np.ones((1, len(spec.joints)))
    else:
        nominal |= {"stiffness": spec.servo.stiffness[None], "servo_damping": spec.servo.damping[None]}
    if spec.floating is not None:
        of_floor = {"floor_friction": spec.floating.friction, "contact_time": spec.floating.contact_time}
        nominal |= {name: np.full((1, 1), value) for name, value in of_floor.items()}
        nominal["center_of_mass"] = np.zeros((1, 3))
    return nominal


def at_home(spec: RobotSpec, num_robots: int) -> "RobotState":
    """Return robots that rest at home; those whose base floats stand there, where the world's axes meet."""
    position = np.tile(spec.home, (num_robots, 1))
    state = RobotState(position, np.zeros_like(position))
    if spec.floating is None:
        return state
    pose = np.tile([0.0, 0.0, spec.floating.height, 0.0, 0.0, 0.0, 1.0], (num_robots, 1))
    return replace(state, base_pose=pose, base_twist=np.zeros((num_robots, 6)))


def loaded_links(spec: RobotSpec) -> tuple[str, ...]:
    """Name what weighs something: the moving links, and what carries the payload, though it may weigh nothing else."""
    return tuple(dict.fromkeys((*spec.moving_links, spec.carrier)))


def loaded_mass(spec: RobotSpec, parameters: DynamicsParameters) -> np.ndarray:
    """Return the masses of :func:`loaded_links` with the payload, kg, [rows, links]."""
    links, mass = loaded_links(spec), parameters["link_mass"]
    mass = np.pad(mass, ((0, 0), (0, len(links) - mass.shape[1])))
    mass[:, links.index(spec.carrier)] += parameters["payload"][:, 0]
    return mass


@dataclass(frozen=True)
class RobotState:
    """What N robots do; float64, robots are rows. None stands for what an engine or a robot does not tell.

    Attributes:
        joint_position: rad, [N, n].
        joint_velocity: rad/s, [N, n].
        joint_effort: What motors gave in the last substep and friction left of it, as a torque sensor behind the gears
            would say; zeros after a reset; N·m, [N, n].
        base_pose: Of a floating base in the world: x, y, z in m, then a quaternion x, y, z, w, [N, 7].
        base_twist: Its velocity, m/s, then its angular velocity, rad/s, in the world, [N, 6].
        contact: Whether each link that can (:attr:`physai.robots.FloatingBase.links`) touched the floor in the last
            substep; none does after a reset, [N, links].
    """

    joint_position: np.ndarray
    joint_velocity: np.ndarray
    joint_effort: np.ndarray | None = None
    base_pose: np.ndarray | None = None
    base_twist: np.ndarray | None = None
    contact: np.ndarray | None = None

    def of(self, rows: np.ndarray) -> "RobotState":
        """Return what some of the robots do, those of ``rows`` [r]."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: value[rows] for name, value in values.items() if value is not None})


class Physics(Protocol):
    """N robots with n joints each, driven by what their description says: joint velocities or joint positions.

    Made from a robot, their number, the control period and the substeps of a period. An engine that cannot do what a
    description asks for, such as a floating base, refuses it by name with a UserError. Dynamics parameters mean the
    same in each engine and at any number of substeps.

    Attributes:
        simulated: Whether N is free, and robots can be put into any state and given other dynamics. What is not
            simulated may refuse all of this with a UserError.
        ignores: Dynamics parameters that it leaves as described, whatever it is given.
    """

    simulated: ClassVar[bool]
    ignores: ClassVar[tuple[str, ...]] = ()
    num_robots: int

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        """Put the robots ``rows`` [r] into a state of r rows, and give them new dynamics if any are given.

        Efforts and contacts of the state do not matter; the pose and twist of a base that floats do.

        A reset robot behaves exactly like a fresh one; the others are not touched.
        """

    def step(self, command: np.ndarray) -> RobotState:
        """Hold a command [N, n], rad/s or rad, for one control period; return where it led to."""

    def robot_state(self) -> RobotState:
        """Return what the robots do now."""

    def parameters(self) -> DynamicsParameters:
        """Return the dynamics in force, read back from the engine where it can tell."""

    def state(self) -> dict[str, np.ndarray]:
        """Return all that ``set_state`` of an equal, fresh instance needs to go on bit for bit."""

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what ``state`` returned."""

    def close(self) -> None:
        """Free the engine; may be called twice."""
