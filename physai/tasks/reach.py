"""Reach: bring the end effector to a point of the base frame's x-y plane."""

import math
from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from physai.config import Count, NonNegativeFloat, PositiveFloat
from physai.errors import UserError
from physai.robots import ForwardKinematics, RobotSpec

Columns = Iterable[Any]
"""Numbers, or arrays of one shape."""


class ReachObservation(nn.Module):
    """From what a robot senses to what its policy sees; scriptable, and part of the exported policy.

    The observation is ``[q, qd, ee_x, ee_y, goal_x, goal_y]``. Features say the same in terms that a small network
    learns from quickly: sine and cosine of the joints, the error e = goal - ee, and Jᵀe, the direction in joint space
    that shortens it fastest (Khatib, 1987); both errors appear once in units of the arm and once, saturated, in units
    of the tolerance. Positions of continuous joints are those within half a turn: an arm that has turned around many
    times looks like one that has not.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        tolerance: Distance that counts as reached, m.
    """

    def __init__(self, spec: RobotSpec, kinematics: ForwardKinematics, tolerance: float) -> None:
        super().__init__()
        self.kinematics = kinematics
        length, joints = kinematics.reach, kinematics.constant.shape[0]
        self.coarse: Tensor
        self.fine: Tensor
        # Scales of [e, Jᵀe]: buffers, for TorchScript turns a number into a tensor again at every call.
        self.register_buffer("coarse", torch.tensor([2.0 / length] * 2 + [0.25 / (length * tolerance)] * joints))
        self.register_buffer("fine", torch.tensor([0.5 / tolerance] * 2 + [1.0 / (length * tolerance)] * joints))
        self.continuous: Tensor
        self.register_buffer("continuous", torch.from_numpy(spec.continuous))
        self.wraps = bool(spec.continuous.any())

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 2] m to observation and features.

        Returns:
            Observation [N, 2n + 4] and features [N, 4n + 4].
        """
        sine, cosine = torch.sin(joint_position), torch.cos(joint_position)
        plane = self.kinematics.linearize(cosine, sine)[:, :2]
        end_effector, jacobian = plane[:, :, -1], plane[:, :, :-1]
        error = goal - end_effector
        errors = torch.cat([error, torch.bmm(error.unsqueeze(1), jacobian).squeeze(1)], dim=1)
        if self.wraps:
            joint_position = torch.where(self.continuous, torch.atan2(sine, cosine), joint_position)
        observation = torch.cat([joint_position, joint_velocity, end_effector, goal], dim=1)
        features = torch.cat([sine, cosine, errors * self.coarse, torch.tanh(errors * self.fine)], dim=1)
        return observation, features

    @torch.jit.export
    def distance(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Distance of the end effector to the goal in the plane, m: [N, n] rad and [N, 2] m to [N, 1]."""
        end_effector = self.kinematics(joint_position).narrow(1, 0, 2)
        return torch.linalg.vector_norm(end_effector - goal, dim=1, keepdim=True)


class Reach:
    """Goals on a ring around the base; reward is minus the distance, plus a bonus at the goal, which ends the episode.

    Args:
        goal_radius: Inner and outer radius of the ring, m.
        tolerance: Distance that counts as reached, m.
        success_reward: Bonus at the goal.
        max_steps: Control steps until an episode is truncated.
        start_spread: Episodes start uniformly within the home pose plus or minus this, rad, one value a joint.
    """

    goal_size = 2

    def __init__(
        self,
        goal_radius: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)],
        tolerance: PositiveFloat,
        success_reward: NonNegativeFloat,
        max_steps: Count,
        start_spread: list[NonNegativeFloat],
    ) -> None:
        self.goal_radius = goal_radius
        self.tolerance = tolerance
        self.success_reward = success_reward
        self.max_steps = max_steps
        self.start_spread = start_spread

    @property
    def goal_region(self) -> tuple[float, float]:
        """Nearest and farthest goal from the origin of the base frame, m."""
        return self.goal_radius[0], self.goal_radius[1]

    def check(self, spec: RobotSpec, kinematics: ForwardKinematics) -> None:
        """Raise a UserError if this robot cannot do the task."""
        inner, outer = self.goal_radius
        if inner >= outer:
            raise UserError(f"env.task.goal_radius: the inner radius {inner} must be below the outer radius {outer}")
        if outer > kinematics.reach:
            raise UserError(
                f"env.task.goal_radius: {outer} m is beyond the reach of '{spec.name}', {kinematics.reach:.3f} m"
            )
        if len(self.start_spread) != len(spec.joints):
            raise UserError(f"env.task.start_spread has {len(self.start_spread)} values for {len(spec.joints)} joints")

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw goals [rows, 2], m: angle uniform in [0, 2π), radius uniform between the ring's radii."""
        draw = torch.rand(rows, 2, generator=generator).numpy()
        angle = 2 * math.pi * draw[:, :1]
        inner, outer = self.goal_radius
        radius = inner + (outer - inner) * draw[:, 1:]
        return radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)

    def sample_start(self, rows: int, spec: RobotSpec, generator: torch.Generator) -> np.ndarray:
        """Draw joint positions [rows, n], rad, around the home pose and within the limits."""
        if not any(self.start_spread):
            # Nothing is drawn: a seed gives the same goals to robots one after the other as to robots side by side.
            return np.tile(spec.home, (rows, 1))
        draw = torch.rand(rows, len(spec.joints), generator=generator, dtype=torch.float64).numpy()
        start = spec.home + (2 * draw - 1) * np.array(self.start_spread)
        lower, upper = spec.position_limit.T
        return np.minimum(np.maximum(start, lower), upper)

    def observation(self, spec: RobotSpec, kinematics: ForwardKinematics) -> ReachObservation:
        """Return the module that makes observation and features for a robot."""
        return ReachObservation(spec, kinematics, self.tolerance)

    def observation_bounds(self, spec: RobotSpec, kinematics: ForwardKinematics) -> tuple[Tensor, Tensor]:
        """Lower and upper bound of an observation, [2n + 4] each; with room, for joint limits are not walls."""
        velocity = 2.0 * torch.from_numpy(spec.velocity_limit)
        limits = torch.from_numpy(spec.position_limit).clone()
        limits[spec.continuous] = torch.tensor([-math.pi, math.pi], dtype=limits.dtype)
        lower, upper = limits.T
        end_effector = torch.full((2,), kinematics.reach * 1.01)
        goal = torch.full((2,), self.goal_radius[1])
        return (
            torch.cat([lower - 0.5, -velocity, -end_effector, -goal]).float(),
            torch.cat([upper + 0.5, velocity, end_effector, goal]).float(),
        )

    # What follows is asked at every step: of one robot in plain numbers, of many in arrays.

    def observe(
        self, continuous: list[int], joint_position: Columns, joint_velocity: Columns, tip: Columns, goal: Columns
    ) -> Columns:
        """The observation of :class:`ReachObservation` from the true state, 2n + 4 numbers or arrays.

        Args:
            continuous: Which joints turn without end.
            joint_position: n, rad.
            joint_velocity: n, rad/s.
            tip: End effector in the plane, 2, m.
            goal: 2, m.
        """
        seen = [*joint_position, *joint_velocity, *tip, *goal]
        for joint in continuous:
            seen[joint] = (seen[joint] + math.pi) % (2 * math.pi) - math.pi
        return seen

    def success(self, distance: Any) -> Any:
        """Whether the goal is reached."""
        return distance < self.tolerance

    def reward(self, distance: Any, success: Any) -> Any:
        """Reward of the step that led here."""
        return self.success_reward * success - distance
