"""What tasks share in which an end effector goes to a goal: how a step is judged."""

import numpy as np

from physai.config import Count, NonNegativeFloat
from physai.robots import RobotSpec
from physai.signals import Tolerance
from physai.tasks.interface import Step, Task


class Reaching(Task):
    """Reward is minus the errors, plus a bonus for success, which may end the episode.

    Args:
        spec: The robot.
        tolerances: One for each column of the errors.
        weights: What one unit of each error costs a step.
        success_reward: Bonus for success, in each step of it.
        success_ends: Whether success ends the episode; else a policy learns to stay there until time is up.
        settle: How long the end effector must stay there to succeed, s; with 0 touching the goal is enough.
        smoothness: Weight of what changes of the action cost: their mean over the joints, as a share of the action.
        posture: Weight of what being away from home costs: the mean over the joints of the square of the distance, as a
            share of half the joint's range. It keeps an arm from winding up into its limits, goal after goal.
        max_steps: Control steps until an episode is truncated.
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
        max_steps: Count,
    ) -> None:
        self.tolerances = tolerances
        self.max_steps = max_steps
        self._weights = weights
        self._success_reward, self._success_ends, self._settle = success_reward, success_ends, settle
        self._smoothness, self._posture = smoothness, posture
        self._home = spec.home
        self._half_range = (spec.position_limit[:, 1] - spec.position_limit[:, 0]) / 2

    def success(self, step: Step) -> np.ndarray:
        """Whether the end effector is near enough, and has been for long enough."""
        return (step.held > 0) & (step.held >= self._settle - 1e-9)

    def terminated(self, step: Step, success: np.ndarray) -> np.ndarray:
        """Success ends the episode, or nothing does."""
        return success if self._success_ends else np.zeros_like(success)

    def rewards(self, step: Step, success: np.ndarray) -> dict[str, np.ndarray]:
        """Minus the errors, the bonus, and what changing the action and being away from home cost, if they do."""
        terms = {
            tolerance.name: -weight * step.error[:, column]
            for column, (tolerance, weight) in enumerate(zip(self.tolerances, self._weights, strict=True))
        }
        terms["success"] = self._success_reward * success
        if self._smoothness:
            terms["smoothness"] = -self._smoothness * np.abs(step.action - step.last_action).mean(axis=1)
        if self._posture:
            away = (step.state.joint_position - self._home) / self._half_range
            terms["posture"] = -self._posture * np.square(away).mean(axis=1)
        return terms
