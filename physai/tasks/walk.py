"""Walk: follow a velocity on legs, without a fall."""

from typing import Annotated, Any

import numpy as np
import torch
from omegaconf import OmegaConf
from pydantic import Field
from torch import Tensor

from physai.config import C, Config, Count, NonNegativeFloat, PositiveFloat, validate
from physai.errors import UserError
from physai.physics import RobotState
from physai.physics.rotation import rotate_back
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Box, Quantity, Signal, Tolerance
from physai.tasks.gait import Gait, joint_gait
from physai.tasks.interface import ObservationModule, Step, Task

_STILL = 0.05  # m/s and rad/s: a command below it asks to stand

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class WalkObservation(ObservationModule):
    """What a robot on legs knows of itself: its IMU, its joints, what it did last, and what is asked of it.

    The observation is ``[angular velocity, gravity, joints about home, joint velocities, last action, command]``. To
    the features come gravity and the command as they are, where in its gait the robot is, as sine and cosine, and what
    the gait suggests to do (after Iscen et al., "Policies Modulating Trajectory Generators", CoRL 2018); to stand
    still, where that is asked.

    Args:
        spec: The robot.
        gait: What is suggested.
    """

    senses = ("angular_velocity", "gravity", "joint_position", "joint_velocity", "last_action", "clock")
    suggests = True
    measures = False

    def __init__(self, spec: RobotSpec, gait: Gait) -> None:
        super().__init__()
        self.frequency, self.still, self.period = gait.frequency, _STILL, 1.0 / gait.frequency
        self.home: Tensor
        self.phase: Tensor
        self.swing: Tensor
        self.sway: Tensor
        self.stride: Tensor
        self.yaw_correction: Tensor
        self.register_buffer("home", torch.from_numpy(spec.home).float())
        of_joints = joint_gait(gait, spec)
        self.register_buffer("phase", torch.from_numpy(of_joints.phase).float())
        for name in ("swing", "sway", "stride", "yaw_correction"):  # as actions
            self.register_buffer(name, torch.from_numpy(getattr(of_joints, name) / spec.command_limit).float())

    def forward(  # type: ignore[override]
        self,
        angular_velocity: Tensor,
        gravity: Tensor,
        joint_position: Tensor,
        joint_velocity: Tensor,
        last_action: Tensor,
        clock: Tensor,
        goal: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Map what is sensed, [N, 3], [N, 3], [N, n] three times, [N, 1], and commands [N, 3].

        Returns:
            Observation [N, 3n + 9] and features [N, n + 8].
        """
        seen = [angular_velocity, gravity, joint_position - self.home, joint_velocity, last_action, goal]
        turn = 2.0 * torch.pi * (self.frequency * clock + self.phase)
        sine, cosine = torch.sin(turn), torch.cos(turn)
        moves = (goal.abs().amax(dim=1, keepdim=True) > self.still).to(goal.dtype)
        way = self.swing * torch.relu(sine) + self.sway[0] * cosine + self.sway[1] * sine + goal @ self.stride * cosine
        way = way + self.yaw_correction * (goal[:, 2:] - angular_velocity[:, 2:])
        suggested = torch.atanh(torch.clamp(moves * way, -0.95, 0.95))
        now = 2.0 * torch.pi * self.frequency * clock
        features = [gravity, goal, moves * torch.sin(now), moves * torch.cos(now), suggested]
        return torch.cat(seen, dim=1), torch.cat(features, dim=1)


class WalkRewards(Config):
    """Weights of the terms of the reward, which are per second, but for ``fall``.

    ``velocity`` and ``yaw_rate``: of following the command, exp(-(error / width)²), at most 1, with the ``width`` of
    each, m/s and rad/s. All others are costs: ``bounce``, of vertical velocity, (m/s)²; ``sway``, of roll and pitch
    rates, (rad/s)²; ``tilt``, of the horizontal part of gravity's direction, squared; ``height``, of the way from the
    height at home, as a share of it, squared; ``posture``, of joints away from home, rad²; ``smoothness``, of the
    action's change, squared; ``effort``, of the squared share of the effort limits; ``knock``, of links that touch the
    floor beside feet; these are sums over joints or links, and ``fall`` is of a whole episode.
    """

    velocity: NonNegativeFloat
    velocity_width: PositiveFloat
    yaw_rate: NonNegativeFloat
    yaw_rate_width: PositiveFloat
    bounce: NonNegativeFloat
    sway: NonNegativeFloat
    tilt: NonNegativeFloat
    height: NonNegativeFloat
    posture: NonNegativeFloat
    smoothness: NonNegativeFloat
    effort: NonNegativeFloat
    knock: NonNegativeFloat
    fall: NonNegativeFloat


class Walk(Task):
    """Commands are the velocity of the base along its own x and y axes, level with the floor, and its yaw rate.

    An episode ends with a fall; it is a success if it lasts all its time with a mean error below the tolerances.

    Args:
        spec: The robot.
        kinematics: None; legs have no end effector.
        low: Smallest command: m/s, m/s, rad/s.
        high: Largest command.
        stand: Share of the commands that ask to stand.
        tolerance: Largest mean error of the velocity, m/s.
        yaw_rate_tolerance: Largest mean error of the yaw rate, rad/s.
        lean: How far the base may lean until it counts as a fall, rad.
        lowest: Height of the base below which it has fallen, as a share of that at home.
        gait: What the task suggests to begin with.
        reward: Weights of the terms.
        control_dt: Control period, s.
        goal_steps: Control steps until another command is drawn.
        max_steps: Control steps until an episode is truncated.

    Raises:
        UserError: If the robot stands on no feet.
    """

    needs_end_effector = False

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics | None,
        low: Vector,
        high: Vector,
        stand: Annotated[float, Field(ge=0, le=1)],
        tolerance: PositiveFloat,
        yaw_rate_tolerance: PositiveFloat,
        lean: PositiveFloat,
        lowest: Annotated[float, Field(gt=0, lt=1)],
        gait: Gait,
        reward: WalkRewards,
        control_dt: PositiveFloat,
        goal_steps: Count,
        max_steps: Count,
    ) -> None:
        if spec.floating is None:
            raise UserError(f"env.task: '{spec.name}' does not walk: its base is fixed")
        if not all(a <= b for a, b in zip(low, high, strict=True)):
            raise UserError(f"env.task.low: {low} must not be above env.task.high, {high}")
        self.goal_steps, self.max_steps = goal_steps, max_steps
        # A command to stand is one, too, wherever the others are.
        ends = tuple(min(0.0, value) for value in low), tuple(max(0.0, value) for value in high)
        self.region = Box(*ends)
        self._commands, self._stand = Box(tuple(low), tuple(high)), stand
        self.goal = Signal("goal", Quantity.TWIST, (3,), *ends, ("vx", "vy", "yaw_rate"), spec.base)
        self.tolerances = Tolerance("velocity", "m/s", tolerance), Tolerance("yaw_rate", "rad/s", yaw_rate_tolerance)
        self.module = WalkObservation(spec, _checked(Gait, gait, "env.task.gait"))
        self.observation = _observation(spec, self.goal)
        self._reward = _checked(WalkRewards, reward, "env.task.reward")
        self._home, self._height, self._effort = spec.home, spec.floating.height, spec.effort_limit
        self._others = [link for link in range(len(spec.floating.links)) if link not in spec.floating.feet]
        self._upright, self._lowest, self._dt = np.cos(lean), lowest * spec.floating.height, control_dt

    def sample_goal(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw commands [rows, 3]."""
        stands = torch.rand(rows, 1, generator=generator).numpy() < self._stand
        return np.where(stands, 0.0, self._commands.sample(rows, generator))

    def error(self, state: RobotState, goal: np.ndarray) -> np.ndarray:
        """Return the error of the velocity, m/s, and of the yaw rate, rad/s, [N, 2]."""
        linear, angular, _ = _in_heading(state)
        away = np.hypot(linear[:, 0] - goal[:, 0], linear[:, 1] - goal[:, 1])
        return np.stack([away, np.abs(angular[:, 2] - goal[:, 2])], axis=1)

    def success(self, step: Step) -> np.ndarray:
        """Whether an episode is over without a fall, and its command was followed."""
        followed = (step.mean_error <= [tolerance.value for tolerance in self.tolerances]).all(axis=1)
        return (step.length >= self.max_steps) & followed & ~self._fallen(step.state)

    def terminated(self, step: Step, success: np.ndarray) -> np.ndarray:
        """Whether robots have fallen."""
        return self._fallen(step.state)

    def _fallen(self, state: RobotState) -> np.ndarray:
        assert state.base_pose is not None
        x, y = state.base_pose[:, 3], state.base_pose[:, 4]
        up = 1.0 - 2.0 * (x * x + y * y)
        return (up < self._upright) | (state.base_pose[:, 2] < self._lowest) | ~np.isfinite(up)

    def rewards(self, step: Step, success: np.ndarray) -> dict[str, np.ndarray]:
        """Return the terms of :class:`WalkRewards`."""
        state, weight, dt = step.state, self._reward, self._dt
        linear, angular, gravity = _in_heading(state)
        assert state.base_pose is not None
        assert state.contact is not None
        assert state.joint_effort is not None
        rates = {
            "velocity": weight.velocity * np.exp(-np.square(step.error[:, 0] / weight.velocity_width)),
            "yaw_rate": weight.yaw_rate * np.exp(-np.square(step.error[:, 1] / weight.yaw_rate_width)),
            "bounce": -weight.bounce * np.square(linear[:, 2]),
            "sway": -weight.sway * np.square(angular[:, :2]).sum(axis=1),
            "tilt": -weight.tilt * np.square(gravity[:, :2]).sum(axis=1),
            "height": -weight.height * np.square(state.base_pose[:, 2] / self._height - 1.0),
            "posture": -weight.posture * np.square(state.joint_position - self._home).sum(axis=1),
            "smoothness": -weight.smoothness * np.square(step.action - step.last_action).sum(axis=1),
            "effort": -weight.effort * np.square(state.joint_effort / self._effort).sum(axis=1),
            "knock": -weight.knock * state.contact[:, self._others].sum(axis=1),
        }
        return {
            **{name: dt * rate for name, rate in rates.items()},
            "fall": -weight.fall * self._fallen(state),
        }


def _checked(model: type[C], part: C | dict[str, Any], where: str) -> C:
    """Return a part of a config as its model, which it may be already."""
    if isinstance(part, model):
        return part
    if not isinstance(part, dict):
        raise UserError(f"{where}: keys and values are needed, got {part!r}")
    return validate(model, OmegaConf.create(part), f"{where}.")


def _in_heading(state: RobotState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return velocity, m/s, and angular velocity, rad/s, in the frame of the base, and gravity's direction there."""
    assert state.base_pose is not None
    assert state.base_twist is not None
    turn = state.base_pose[:, 3:]
    gravity = rotate_back(turn, np.broadcast_to([0.0, 0.0, -1.0], (len(turn), 3)))
    return rotate_back(turn, state.base_twist[:, :3]), rotate_back(turn, state.base_twist[:, 3:]), gravity


def _observation(spec: RobotSpec, goal: Signal) -> Signal:
    """What the policy sees; with room, for a robot that falls turns fast."""
    n = len(spec.joints)
    lower, upper = spec.position_limit.T - spec.home
    velocity, (low, high) = 2.0 * spec.velocity_limit, goal.bounds
    least = np.concatenate([np.full(3, -100.0), np.full(3, -1.0), lower - 0.5, -velocity, np.full(n, -1.0), low])
    most = np.concatenate([np.full(3, 100.0), np.full(3, 1.0), upper + 0.5, velocity, np.full(n, 1.0), high])
    return Signal("observation", Quantity.VIEW, (len(least),), tuple(least.tolist()), tuple(most.tolist()))
