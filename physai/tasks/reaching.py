"""What tasks share in which an end effector goes to a goal: how a step is judged."""

import numpy as np

from physai.collision import Box
from physai.config import Count, NonNegativeFloat, PositiveFloat
from physai.errors import UserError
from physai.robots import RobotSpec
from physai.signals import Tolerance
from physai.tasks.interface import Step, Task

_NEAR = 0.02  # what being all but in touch costs in a step, as a share of a collision
_SOFT = 0.9  # of the way from the middle of a joint's range to a limit: beyond, it costs


class Reaching(Task):
    """Reward is minus the errors, plus a bonus for success, which may end the episode.

    Args:
        spec: The robot.
        tolerances: One for each column of the errors.
        weights: What one unit of each error costs a step.
        success_reward: Bonus for success, in each step of it.
        success_ends: Whether success ends the episode; else a policy learns to stay there until time is up.
        settle: How long the end effector must stay there to succeed, s; with 0 touching the goal is enough.
        smoothness: Weight of what changes of the action cost: the mean over the joints of their squares, where 1 is
            a joint's largest command. Squares make one large step dearer than two small ones.
        posture: Weight of what being away from home costs: the mean over the joints of the square of
            the distance, as a share of half the joint's range. It keeps an arm from winding up into its limits.
        joint_limits: Weight of being near a joint limit: the sum over the joints of a cost that grows from 0 to 1
            over the last tenth of the way from the middle of the range. A mean, as in ``posture``, lets a joint that
            hardly matters lie at its limit.
        collision: What touching itself, the floor or a box costs, which ends the episode; 0: nothing is looked at.
        safe_distance: Nearer than this, m, costs a share of ``collision`` in each step.
        floor: Its height in the base frame, m; None where there is none.
        boxes: What else stands around, with faces along the axes of the base frame: :class:`physai.collision.Box`.
        max_steps: Control steps until an episode is truncated.

    Raises:
        UserError: If collisions are to be looked at, and the robot's YAML names no capsules.
    """

    def __init__(
        self,
        spec: RobotSpec,
        tolerances: tuple[Tolerance, ...],
        weights: tuple[float, ...],
        success_reward: NonNegativeFloat,
        success_ends: bool,
        settle: NonNegativeFloat,
        smoothness: NonNegativeFloat,
        posture: NonNegativeFloat,
        joint_limits: NonNegativeFloat,
        collision: NonNegativeFloat,
        safe_distance: PositiveFloat,
        floor: float | None,
        boxes: list[Box],
        max_steps: Count,
    ) -> None:
        self.tolerances = tolerances
        self.max_steps = max_steps
        self._weights = weights
        self._success_reward, self._success_ends, self._settle = success_reward, success_ends, settle
        self._smoothness, self._posture, self._joint_limits = smoothness, posture, joint_limits
        self._collision, self._safe_distance = collision, safe_distance
        if collision:
            if spec.collision is None:
                raise UserError(
                    f"env.task.collision: the YAML of '{spec.name}' names no capsules: python -m physai.capsules "
                    f"robot={spec.name} fits them"
                )
            self.surroundings = spec.collision.within(floor, boxes)
            apart = self.surroundings.distance(spec.home[np.newaxis])[0]
            if apart.min(initial=np.inf) <= 0:
                nearest = apart.argmin()
                first, second = self.surroundings.names[nearest]
                raise UserError(
                    f"env.robot.home: '{first}' and '{second}' overlap there by {-1e3 * apart[nearest]:.1f} mm: each "
                    "episode would begin with a collision; move home, env.task.floor or a box, or mend the capsules"
                )
        self._home = spec.home
        self._middle = np.nan_to_num(spec.position_limit).mean(axis=1)  # 0 where a joint turns without end
        self._half_range = (spec.position_limit[:, 1] - spec.position_limit[:, 0]) / 2

    def success(self, step: Step) -> np.ndarray:
        """Whether the end effector is near enough, and has been for long enough."""
        return (step.held > 0) & (step.held >= self._settle - 1e-9)

    def terminated(self, step: Step, success: np.ndarray) -> np.ndarray:
        """A collision ends the episode, and success may."""
        over = success if self._success_ends else np.zeros_like(success)
        return over if step.clearance is None else over | (step.clearance <= 0)

    def clearance(self, joint_position: np.ndarray) -> np.ndarray | None:
        """See :class:`physai.tasks.Task`."""
        return None if self.surroundings is None else self.surroundings.distance(joint_position).min(axis=1)

    def rewards(self, step: Step, success: np.ndarray) -> dict[str, np.ndarray]:
        """Minus the errors, the bonus, and what changing the action, being away from home and collisions cost."""
        terms = {
            tolerance.name: -weight * step.error[:, column]
            for column, (tolerance, weight) in enumerate(zip(self.tolerances, self._weights, strict=True))
        }
        terms["success"] = self._success_reward * success
        if self._smoothness:
            terms["smoothness"] = -self._smoothness * np.square(step.action - step.last_action).mean(axis=1)
        if self._posture:
            away = (step.state.joint_position - self._home) / self._half_range
            terms["posture"] = -self._posture * np.square(away).mean(axis=1)
        if self._joint_limits:
            way = np.abs(step.state.joint_position - self._middle) / self._half_range
            terms["joint_limits"] = -self._joint_limits * np.clip((way - _SOFT) / (1.0 - _SOFT), 0.0, 1.0).sum(axis=1)
        if step.clearance is not None:
            near = np.clip(1.0 - step.clearance / self._safe_distance, 0.0, 1.0)
            terms["collision"] = -self._collision * np.where(step.clearance <= 0, 1.0, _NEAR * near)
        return terms
