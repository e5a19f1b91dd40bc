"""A task whose episodes go on after a success: bring each joint to its goal, and keep it there."""

import numpy as np
import torch
from torch import Tensor

from physai.config import Count, NonNegativeFloat
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Box, Quantity, Signal, Tolerance
from physai.tasks import ObservationModule, Step, Task


class HoldObservation(ObservationModule):
    """The way to go."""

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        return torch.cat([joint_position, joint_velocity, goal], dim=1), goal - joint_position

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return (goal - joint_position).abs()


class Hold(Task):
    """A success is to have been at the goal for a while; nothing but time ends an episode."""

    def __init__(
        self, spec: RobotSpec, kinematics: ForwardKinematics, hold: NonNegativeFloat, max_steps: Count
    ) -> None:
        count = len(spec.joints)
        self.region = Box((-0.5,) * count, (0.5,) * count)
        self.goal = Signal.of_joints("goal", Quantity.JOINT_POSITION, spec.joints, *self.region.bounds)
        self.tolerances = tuple(Tolerance(joint, "rad", 0.05) for joint in spec.joints)
        self.module = HoldObservation()
        self.observation = Signal("observation", Quantity.VIEW, (3 * count,))
        self.max_steps, self._hold = max_steps, hold

    def success(self, step: Step) -> np.ndarray:
        return step.held >= self._hold

    def terminated(self, step: Step, success: np.ndarray) -> np.ndarray:
        return np.zeros(len(success), bool)

    def rewards(self, step: Step, success: np.ndarray) -> dict[str, np.ndarray]:
        return {"error": -step.error.sum(axis=1), "held": step.held, "effort": -0.1 * (step.command**2).sum(axis=1)}
