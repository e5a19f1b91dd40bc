"""What a task is: a goal, what a policy sees of it, and how a step is judged."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from physai.collision import CollisionModel
from physai.physics import RobotState
from physai.signals import Region, Signal, Tolerance


class ObservationModule(nn.Module):
    """From what a robot senses to what its policy sees; scriptable, and part of the exported policy.

    Attributes:
        senses: The signals that it maps, in the order of its arguments, of those that the robot has
            (:attr:`physai.envs.simulation.Simulation.senses`); the goal comes after them.
        suggests: Whether the last n features are the latent actions of a controller without learning, to which a
            :class:`physai.policies.ResidualActor` adds.
        measures: Whether ``error`` tells from joint positions how far the robot is from its goal.
        period: After which the ``clock`` begins again, s, where one is sensed.
    """

    senses: tuple[str, ...] = ("joint_position", "joint_velocity")
    suggests: bool = False
    measures: bool = True
    period: float = math.inf

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, g] to observation and features.

        A module with other ``senses`` has other arguments.

        Returns:
            Observation [N, o], which is normalized, and features [N, f], which a policy sees as they are.
        """
        raise NotImplementedError

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Map positions [N, n] rad and goals [N, g] to how far they are apart, one column a tolerance, [N, e]."""
        raise NotImplementedError


@dataclass(frozen=True)
class Step:
    """Where one control step has led N robots.

    Attributes:
        state: What the robots do now.
        command: What they were told, rad/s or rad, [N, n].
        action: What the policy asked for, in [-1, 1], [N, n]: a share of each joint's largest command.
        last_action: The same of the step before, [N, n]; zeros when an episode begins.
        goal: [N, g].
        error: How far they are from it, one column a tolerance, [N, e].
        held: For how long all errors have been within their tolerances without a break, s, [N].
        clearance: How far the robots are from touching anything, m, [N]; None where the task does not look at that.
        length: Control steps since the episode began, [N].
        mean_error: Mean of each error since then, [N, e].
    """

    state: RobotState
    command: np.ndarray
    action: np.ndarray
    last_action: np.ndarray
    goal: np.ndarray
    error: np.ndarray
    held: np.ndarray
    clearance: np.ndarray | None
    length: np.ndarray
    mean_error: np.ndarray


class Task(Protocol):
    """What N robots shall do; made from a robot, its kinematics, and what its YAML says.

    A task judges, and keeps nothing between two steps. Inherit from it: the methods with a body are taken as they are,
    or written again where that is faster.

    Attributes:
        goal: What is asked of the robot; its name is ``goal``.
        region: Where goals lie.
        tolerances: One for each column of the errors.
        observation: What the observation module makes, with bounds.
        module: The observation module.
        max_steps: Control steps until an episode is truncated.
        goal_steps: Control steps after which another goal is asked for in the midst of an episode; 0: never.
        needs_end_effector: Whether it is for robots that have one; others get no kinematics.
        surroundings: The robot's capsules and what stands around, where the task looks at collisions; else None.
    """

    goal: Signal
    region: Region
    tolerances: tuple[Tolerance, ...]
    observation: Signal
    module: ObservationModule
    max_steps: int
    goal_steps: int = 0
    needs_end_effector: ClassVar[bool] = True
    surroundings: CollisionModel | None = None

    def success(self, step: Step) -> np.ndarray:
        """Whether the robots do what they shall, [N]; an episode is a success if its last step is one."""

    def terminated(self, step: Step, success: np.ndarray) -> np.ndarray:
        """Whether their episodes are over, [N], for a reason other than time."""

    def rewards(self, step: Step, success: np.ndarray) -> dict[str, np.ndarray]:
        """Return the terms of the reward by name, [N] each; the reward is their sum."""

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw goals of episodes, [rows, g]."""
        return self.region.sample(rows, generator)

    def clearance(self, joint_position: np.ndarray) -> np.ndarray | None:
        """Return how far robots [N, n], rad, are from touching anything, m, [N]; None where that is not looked at."""

    @torch.no_grad()
    def error(self, state: RobotState, goal: np.ndarray) -> np.ndarray:
        """Return how far the robots are from their goals [N, g], one column a tolerance, [N, e]."""
        arrays = state.joint_position, goal
        return self.module.error(*(torch.from_numpy(array).float() for array in arrays)).numpy()

    @torch.no_grad()
    def observe(self, sensed: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the observation of what a robot senses and its goal, by name, [N, o], as the module makes it."""
        arrays = (sensed[name] for name in (*self.module.senses, "goal"))
        observation, _ = self.module(*(torch.from_numpy(array).float() for array in arrays))
        return observation.numpy()
