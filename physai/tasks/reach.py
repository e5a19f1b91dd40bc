"""Reach: bring the end effector to a point of the base frame's x-y plane."""

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from physai.config import PositiveFloat
from physai.errors import UserError
from physai.physics import RobotState
from physai.robots import EndEffector, ForwardKinematics, RobotSpec
from physai.signals import Quantity, Ring, Signal, Tolerance
from physai.tasks.interface import ObservationModule
from physai.tasks.reaching import Reaching


class ReachObservation(ObservationModule):
    """Joints, end effector and goal, and what helps to bring them together.

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
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        """Map positions [N, n] rad and goals [N, 2] m to the distance of the end effector in the plane, m, [N, 1]."""
        end_effector = self.kinematics(joint_position).narrow(1, 0, 2)
        return torch.linalg.vector_norm(end_effector - goal, dim=1, keepdim=True)


class Reach(Reaching):
    """Goals on a ring around the base, in its x-y plane.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        goal_radius: Inner and outer radius of the ring, m.
        tolerance: Distance that counts as reached, m.
        **judging: How a step is judged, see :class:`Reaching`.

    Raises:
        UserError: If the robot cannot reach the goals.
    """

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        goal_radius: Annotated[list[PositiveFloat], Field(min_length=2, max_length=2)],
        tolerance: PositiveFloat,
        **judging: Any,
    ) -> None:
        super().__init__(spec, (Tolerance("distance", "m", tolerance),), (1.0,), **judging)
        inner, outer = goal_radius
        if inner >= outer:
            raise UserError(f"env.task.goal_radius: the inner radius {inner} must be below the outer radius {outer}")
        if outer > kinematics.reach:
            raise UserError(
                f"env.task.goal_radius: {outer} m is beyond the reach of '{spec.name}', {kinematics.reach:.3f} m"
            )
        self.region = Ring(inner, outer)
        low, high = (tuple(bound.tolist()) for bound in self.region.bounds)
        self.goal = Signal("goal", Quantity.POSITION, (2,), low, high, ("x", "y"), spec.base)
        self.module = ReachObservation(spec, kinematics, tolerance)
        self.observation = _observation(spec, self.goal, kinematics.reach)
        self._end_effector = EndEffector(kinematics)
        self._continuous = spec.continuous.nonzero()[0]

    # The same as the module says, without the cost of torch's calls.

    def error(self, state: RobotState, goal: np.ndarray) -> np.ndarray:
        """Return the distance in the plane, m, [N, 1]."""
        apart = self._end_effector(state.joint_position)[:, :2] - goal
        return np.hypot(apart[:, :1], apart[:, 1:])

    def observe(self, sensed: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the observation, [N, 2n + 4]."""
        position = sensed["joint_position"]
        end_effector = self._end_effector(position)[:, :2]
        seen = np.concatenate([position, sensed["joint_velocity"], end_effector, sensed["goal"]], axis=1)
        for joint in self._continuous:
            seen[:, joint] = (seen[:, joint] + math.pi) % (2 * math.pi) - math.pi
        return seen.astype(np.float32)


def _observation(spec: RobotSpec, goal: Signal, reach: float) -> Signal:
    """What the policy sees; with room, for joint limits are not walls."""
    lower, upper = np.where(spec.continuous, [[-math.pi], [math.pi]], spec.position_limit.T)
    velocity, end_effector, (goal_low, goal_high) = 2.0 * spec.velocity_limit, np.full(2, reach * 1.01), goal.bounds
    low = np.concatenate([lower - 0.5, -velocity, -end_effector, goal_low])
    high = np.concatenate([upper + 0.5, velocity, end_effector, goal_high])
    return Signal("observation", Quantity.VIEW, (len(low),), tuple(low.tolist()), tuple(high.tolist()))
