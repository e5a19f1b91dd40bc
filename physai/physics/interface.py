"""What the rest of physai expects of a physics engine."""

from typing import ClassVar, Protocol

import numpy as np

from physai.robots import RobotSpec

DynamicsParameters = dict[str, np.ndarray]
"""Per robot and absolute, each [rows, k]: ``link_mass`` (kg, one a moving link), ``payload`` (kg at the tip, 1), and
one a joint of ``joint_damping`` (N·m·s/rad), ``joint_friction`` (N·m), ``effort_limit`` (N·m), ``velocity_gain``
(1)."""


def nominal_dynamics(spec: RobotSpec) -> DynamicsParameters:
    """Return the robot as its URDF describes it, one row."""
    joints = len(spec.joints)
    return {
        "link_mass": spec.link_mass[None],
        "payload": np.zeros((1, 1)),
        "joint_damping": spec.damping[None],
        "joint_friction": spec.friction[None],
        "effort_limit": spec.effort_limit[None],
        "velocity_gain": np.ones((1, joints)),
    }


class Physics(Protocol):
    """N robots with n velocity-controlled joints each; arrays are float64, robots are rows.

    Attributes:
        simulated: Whether N is free, and robots can be put into any state and given other dynamics. What is not
            simulated may refuse all of this with a UserError.
    """

    simulated: ClassVar[bool]
    num_robots: int

    def reset(
        self,
        rows: np.ndarray,
        joint_position: np.ndarray,
        joint_velocity: np.ndarray,
        parameters: DynamicsParameters | None = None,
    ) -> None:
        """Put the robots ``rows`` [r] into a state [r, n], rad and rad/s, and give them new dynamics if any are given.

        A reset robot behaves exactly like a fresh one; the others are not touched.
        """

    def step(self, velocity_command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Hold a velocity command [N, n], rad/s, for one control period; return joint positions and velocities."""

    def step_one(self, velocity_command: list[float]) -> tuple[list[float], list[float]]:
        """``step`` of the only robot in plain numbers, n each."""

    def joint_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions [N, n], rad, and velocities [N, n], rad/s."""

    def parameters(self) -> DynamicsParameters:
        """Return the dynamics in force, read back from the engine where it can tell."""

    def state(self) -> dict[str, np.ndarray]:
        """Return all that ``set_state`` of an equal, fresh instance needs to go on bit for bit."""

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what ``state`` returned."""

    def close(self) -> None:
        """Free the engine; may be called twice."""
