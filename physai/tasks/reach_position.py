"""Reach a position: bring the end effector to a point in space."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physai.collision import CollisionModel
from physai.config import PositiveFloat
from physai.errors import UserError
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Ball, Box, Quantity, Region, Signal, Tolerance
from physai.tasks.interface import ObservationModule
from physai.tasks.reachable import ReachableGoals, made_reachable
from physai.tasks.reaching import Reaching


class ReachPositionObservation(ObservationModule):
    """As :class:`physai.tasks.reach.ReachObservation`, in space.

    The observation is ``[q, qd, ee, goal]``. Features are sine and cosine of the joints; the error e = goal - ee and
    Jᵀe, once in units of the arm and once, saturated, in units of the tolerance; and how far each joint is from home,
    as a share of half its range.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        tolerance: Distance that counts as reached, m.
    """

    def __init__(self, spec: RobotSpec, kinematics: ForwardKinematics, tolerance: float) -> None:
        super().__init__()
        self.kinematics = kinematics
        length, joints = kinematics.reach, len(spec.joints)
        self.coarse: Tensor
        self.fine: Tensor
        self.register_buffer("coarse", torch.tensor([2.0 / length] * 3 + [0.25 / (length * tolerance)] * joints))
        self.register_buffer("fine", torch.tensor([0.5 / tolerance] * 3 + [1.0 / (length * tolerance)] * joints))
        self.posture = Posture(spec)

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions [N, n] rad, velocities [N, n] rad/s and goals [N, 3] m to observation and features.

        Returns:
            Observation [N, 2n + 6] and features [N, 5n + 6].
        """
        sine, cosine = torch.sin(joint_position), torch.cos(joint_position)
        linear = self.kinematics.linearize(cosine, sine)
        end_effector, jacobian = linear[:, :, -1], linear[:, :, :-1]
        error = goal - end_effector
        errors = torch.cat([error, torch.bmm(error.unsqueeze(1), jacobian).squeeze(1)], dim=1)
        wrapped, away = self.posture(joint_position, sine, cosine)
        observation = torch.cat([wrapped, joint_velocity, end_effector, goal], dim=1)
        features = torch.cat([sine, cosine, away, errors * self.coarse, torch.tanh(errors * self.fine)], dim=1)
        return observation, features

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Map positions [N, n] rad and goals [N, 3] m to the distance of the end effector, m, [N, 1]."""
        return torch.linalg.vector_norm(self.kinematics(joint_position) - goal, dim=1, keepdim=True)


class Posture(torch.nn.Module):
    """Joint positions as a network sees them; scriptable.

    Args:
        spec: The robot.
    """

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__()
        half = (spec.position_limit[:, 1] - spec.position_limit[:, 0]) / 2
        self.home: Tensor
        self.scale: Tensor
        self.continuous: Tensor
        self.register_buffer("home", torch.from_numpy(spec.home).float())
        self.register_buffer("scale", torch.from_numpy(1.0 / half).float())  # 0 where a joint turns without end
        self.register_buffer("continuous", torch.from_numpy(spec.continuous))

    def forward(self, joint_position: Tensor, sine: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
        """Map positions, their sines and cosines, [N, n] each, to positions and ways from home, [N, n] each.

        Positions of continuous joints are those within half a turn; the way from home is a share of half the range.
        """
        wrapped = torch.where(self.continuous, torch.atan2(sine, cosine), joint_position)
        return wrapped, (joint_position - self.home) * self.scale


class ReachPosition(Reaching):
    """Goals are points in space.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        region: Where goals lie, a :class:`physai.signals.Box` or :class:`physai.signals.Ball`; or
            :class:`physai.tasks.ReachableGoals`, partly made.
        tolerance: Distance that counts as reached, m.
        **judging: How a step is judged, see :class:`Reaching`.

    Raises:
        UserError: If goals are beyond the robot's reach.
    """

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        region: Any,
        tolerance: PositiveFloat,
        **judging: Any,
    ) -> None:
        super().__init__(spec, (Tolerance("distance", "m", tolerance),), (1.0,), **judging)
        self._goals = goals_in(region, spec, kinematics, self.surroundings)
        self.region = self._goals.region if isinstance(self._goals, ReachableGoals) else self._goals
        low, high = (tuple(bound.tolist()) for bound in self.region.bounds)
        self.goal = Signal("goal", Quantity.POSITION, (3,), low, high, ("x", "y", "z"), spec.base)
        self.module = ReachPositionObservation(spec, kinematics, tolerance)
        self.observation = space_observation(spec, kinematics, self.region.bounds)

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """See :class:`physai.tasks.Task`."""
        return self._goals.sample(rows, generator)


def goals_in(
    region: Any, spec: RobotSpec, kinematics: ForwardKinematics, surroundings: CollisionModel | None
) -> Region | ReachableGoals:
    """Return what draws positions in space.

    Args:
        region: A region of positions, or :class:`ReachableGoals`, partly made.
        spec: The robot.
        kinematics: Its forward kinematics.
        surroundings: What the robot must not touch; None where that is not looked at.

    Raises:
        UserError: If it is no such region, or part of it is beyond the robot's reach, or may be in something.
    """
    if callable(region):
        return made_reachable(region, spec, kinematics, Quantity.POSITION, surroundings)
    if not isinstance(region, Box | Ball) or len(region.bounds[0]) != 3:
        raise UserError(
            "env.task.region: a physai.signals.Box or Ball of three numbers is needed, or a "
            "physai.tasks.ReachableGoals (_partial_: true)"
        )
    low, high = region.bounds
    floor = None if surroundings is None else surroundings.floor
    if surroundings is not None and (surroundings.boxes or (floor is not None and low[2] <= floor)):
        raise UserError(
            "env.task.region: some of these goals may be in a box or below the floor; a physai.tasks.ReachableGoals "
            "(_partial_: true) draws those that the arm reaches"
        )
    shoulder = kinematics.shoulder
    farthest = np.linalg.norm(np.maximum(np.abs(low - shoulder), np.abs(high - shoulder)))
    if isinstance(region, Ball):
        farthest = np.linalg.norm(np.array(region.center) - shoulder) + region.radius
    if farthest > kinematics.reach:
        raise UserError(
            f"env.task.region: parts of it are {farthest:.2f} m from the first joint of '{spec.name}', which reaches "
            f"{kinematics.reach:.2f} m"
        )
    return region


def space_observation(spec: RobotSpec, kinematics: ForwardKinematics, goal: tuple[np.ndarray, np.ndarray]) -> Signal:
    """Declare ``[q, qd, ee, goal]`` with bounds that have room, for joint limits are not walls.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        goal: Bounds of what is seen of a goal.
    """
    lower, upper = np.where(spec.continuous, [[-math.pi], [math.pi]], spec.position_limit.T)
    velocity, end_effector = (
        2.0 * spec.velocity_limit,
        np.full(3, 1.01 * (kinematics.reach + np.linalg.norm(kinematics.shoulder))),
    )
    low = np.concatenate([lower - 0.5, -velocity, -end_effector, goal[0]])
    high = np.concatenate([upper + 0.5, velocity, end_effector, goal[1]])
    return Signal("observation", Quantity.VIEW, (len(low),), tuple(low.tolist()), tuple(high.tolist()))
