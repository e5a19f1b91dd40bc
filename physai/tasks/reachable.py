"""Goals of which is known that an arm reaches them: where its end effector is in configurations drawn at random."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from physai.collision import CollisionModel
from physai.config import PositiveFloat
from physai.errors import UserError
from physai.robots import ForwardKinematics, RobotSpec
from physai.signals import Quantity, Reachable

_POOL = 4096  # configurations
_EXAMPLES = 256  # of them in the policy file
_BATCHES = 50  # of as many as the pool holds are drawn at most
_NEAR = 0.1  # rad, by which a joint of a drawn configuration may differ from that in the pool


class ReachableGoals:
    """Goals within a box that the end effector reaches.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        quantity: What a goal is: a position or a pose.
        low: Smallest x, y, z, m.
        high: Largest x, y, z, m.
        share: Of each joint's range, around its middle, that configurations are drawn from.
        surroundings: What the robot must not touch; it must not touch itself either.

    Attributes:
        region: What a policy file says about it, with examples.

    Raises:
        UserError: If hardly any configuration leads there.
    """

    def __init__(
        self,
        spec: RobotSpec,
        kinematics: ForwardKinematics,
        quantity: Quantity,
        low: Sequence[float],
        high: Sequence[float],
        share: PositiveFloat,
        surroundings: CollisionModel | None = None,
    ) -> None:
        lower, upper = np.where(spec.continuous, [[-np.pi], [np.pi]], spec.position_limit.T)
        middle, half = (lower + upper) / 2, share * (upper - lower) / 2
        self._lower, self._upper = middle - half, middle + half
        self._low, self._high = np.array(low), np.array(high)
        self._kinematics, self._quantity, self._surroundings = kinematics, quantity, surroundings
        self._pool = self._draw_pool(torch.Generator().manual_seed(0))
        turns = [1.0] * (4 if quantity is Quantity.POSE else 0)
        examples = self._goals(self._pool[:_EXAMPLES])
        self.region = Reachable((*low, *[-each for each in turns]), (*high, *turns), tuple(examples.ravel().tolist()))

    def known(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return configurations [count, n], rad, and the goals that they lead to, [count, g]."""
        return self._pool[:count], self._goals(self._pool[:count])

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw goals [rows, g]: a configuration of the pool, of which each joint is moved a little."""
        known = self._pool[torch.randint(len(self._pool), (rows,), generator=generator).numpy()]
        draw = torch.rand(known.shape, generator=generator, dtype=torch.float64).numpy()
        moved = np.clip(known + _NEAR * (2 * draw - 1), self._lower, self._upper)
        goals = self._goals(moved)
        return np.where(self._allowed(moved, goals)[:, None], goals, self._goals(known))

    def _draw_pool(self, generator: torch.Generator) -> np.ndarray:
        found: list[np.ndarray] = []
        for _ in range(_BATCHES):
            draw = torch.rand(_POOL, len(self._lower), generator=generator, dtype=torch.float64).numpy()
            configurations = self._lower + (self._upper - self._lower) * draw
            found.append(configurations[self._allowed(configurations, self._goals(configurations))])
            if sum(map(len, found)) >= _POOL:
                return np.concatenate(found)[:_POOL]
        raise UserError(
            f"env.task.region: of {_BATCHES * _POOL:,} configurations of the robot only {sum(map(len, found)):,} lead, "
            f"without touching anything, into the box from {self._low.tolist()} to {self._high.tolist()}"
        )

    def _allowed(self, configurations: np.ndarray, goals: np.ndarray) -> np.ndarray:
        allowed: np.ndarray = np.all((goals[:, :3] >= self._low) & (goals[:, :3] <= self._high), axis=1)
        if self._surroundings is not None:
            inside = allowed.nonzero()[0]
            allowed[inside] = (self._surroundings.distance(configurations[inside]) > 0).all(axis=1)
        return allowed

    @torch.no_grad()
    def _goals(self, configurations: np.ndarray) -> np.ndarray:
        joint_position = torch.from_numpy(configurations).float()
        if self._quantity is Quantity.POSITION:
            return self._kinematics(joint_position).double().numpy()
        linear, rotation, _ = self._kinematics.linearize_pose(torch.cos(joint_position), torch.sin(joint_position))
        quaternion = Rotation.from_matrix(rotation.double().numpy()).as_quat(canonical=True)
        return np.concatenate([linear[:, :, -1].double().numpy(), quaternion], axis=1)


def made_reachable(
    region: Any,
    spec: RobotSpec,
    kinematics: ForwardKinematics,
    quantity: Quantity,
    surroundings: CollisionModel | None,
) -> ReachableGoals:
    """Make what a config has made in part.

    Raises:
        UserError: If that is something else.
    """
    made = region(spec, kinematics, quantity, surroundings=surroundings) if callable(region) else None
    if not isinstance(made, ReachableGoals):
        raise UserError("env.task.region: a physai.tasks.ReachableGoals is needed (_partial_: true)")
    return made
