"""Goals of which is known that an arm reaches them: where its end effector is in configurations drawn at random."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from physai.collision import CollisionModel
from physai.config import PositiveFloat
from physai.errors import UserError
from physai.robots import EndEffector, ForwardKinematics, RobotSpec
from physai.signals import Quantity, Reachable

_EXAMPLES = 256  # goals in the policy file
_CLEARANCE = 0.01  # m, which the controller's collision guard keeps, too: nearer, a robot would be held back
_TRIES = 64  # configurations drawn at a time at least
_ROUNDING = 1e-4  # m, and more than that: how far apart are what computes with few digits and what does with many
_HARDLY = 1e-3  # a share of configurations that lead there; with less, something is wrong


class ReachableGoals:
    """Goals within a box that the end effector reaches.

    Args:
        spec: The robot.
        kinematics: Its forward kinematics.
        quantity: What a goal is: a position or a pose.
        low: Smallest x, y, z, m.
        high: Largest x, y, z, m.
        share: Of each joint's range, around its middle, that configurations are drawn from.
        surroundings: What the robot must keep 1 cm away from, as from itself.

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
        self._end_effector = EndEffector(kinematics)
        turns = [1.0] * (4 if quantity is Quantity.POSE else 0)
        _, examples = self._draw(_EXAMPLES, torch.Generator().manual_seed(0))
        self.region = Reachable((*low, *[-each for each in turns]), (*high, *turns), tuple(examples.ravel().tolist()))

    def sample(self, rows: int, generator: torch.Generator) -> np.ndarray:
        """Draw goals [rows, g]."""
        return self._draw(rows, generator)[1]

    def known(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return configurations [count, n], rad, far from touching anything, and goals they lead to, [count, g]."""
        configurations, goals = self._draw(2 * count, torch.Generator().manual_seed(1))
        if self._surroundings is None:
            return configurations[:count], goals[:count]
        clearance = self._surroundings.distance(configurations).min(axis=1)
        clear = np.sort(np.argsort(-clearance, kind="stable")[:count])
        return configurations[clear], goals[clear]

    def _draw(self, rows: int, generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw configurations [rows, n] until there are enough that lead there; return their goals [rows, g], too."""
        found: list[tuple[np.ndarray, np.ndarray]] = []
        drawn = 0
        while (left := rows - sum(len(goals) for _, goals in found)) > 0:
            if drawn > rows / _HARDLY + 100 * _TRIES:
                raise UserError(
                    f"env.task.region: of {drawn:,} configurations of the robot only {rows - left:,} lead, without "
                    f"touching anything, into the box from {self._low.tolist()} to {self._high.tolist()}"
                )
            tries = max(_TRIES, 16 * left)
            draw = torch.rand(tries, len(self._lower), generator=generator, dtype=torch.float64).numpy()
            configurations = self._lower + (self._upper - self._lower) * draw
            drawn += tries
            configurations = configurations[self._near(configurations)]
            if not len(configurations):  # which SciPy did not take as rotations before 1.15
                continue
            goals = self._goals(configurations)
            allowed = self._allowed(configurations, goals)
            found.append((configurations[allowed], goals[allowed]))
        configurations, goals = (np.concatenate(arrays)[:rows] for arrays in zip(*found, strict=True))
        return configurations, goals

    def _near(self, configurations: np.ndarray) -> np.ndarray:
        """Whether the end effector is in the box or next to it, [N]: of most, nothing else needs to be known."""
        tip = self._end_effector(configurations)
        near: np.ndarray = np.all((tip >= self._low - _ROUNDING) & (tip <= self._high + _ROUNDING), axis=1)
        return near

    def _allowed(self, configurations: np.ndarray, goals: np.ndarray) -> np.ndarray:
        allowed: np.ndarray = np.all((goals[:, :3] >= self._low) & (goals[:, :3] <= self._high), axis=1)
        if self._surroundings is not None:
            inside = allowed.nonzero()[0]
            allowed[inside] = (self._surroundings.distance(configurations[inside]) > _CLEARANCE).all(axis=1)
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
