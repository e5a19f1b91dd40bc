"""A simulated robot that a policy drives towards a goal which may move, for as long as somebody looks."""

import math

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.envs.make import TransformedRobotEnv
from physai.errors import UserError
from physai.signals import Quantity
from physai.training.evaluation import SETTLED

_PAUSE = 0.5  # s, between having settled at a goal and the next one


class DrivenRobot:
    """One robot, without episodes: it goes from goal to goal and starts anew only after a collision or a fall.

    Args:
        actor: Writes ``action``.
        env: One simulated robot; it is closed with this object.

    Attributes:
        simulation: Of the env.
        goals: How many goals there have been; a goal counts from when it rests.
        reached: How many of them were a success, as the task judges it.
        settled: At how many of them the robot stayed.
        crashed: How often it touched itself or what stands around, or fell.

    Raises:
        UserError: If the robot is not a simulated one.
    """

    def __init__(self, actor: TensorDictModuleBase, env: TransformedRobotEnv) -> None:
        self.simulation = env.simulation
        if not self.simulation.config.simulated:
            env.close()
            raise UserError(f"physics: the robot of '{self.simulation.config.name}' is not simulated")
        self._actor, self._env = actor, env
        task, dt = self.simulation.task, self.simulation.config.control_dt
        self._most_steps = task.goal_steps or task.max_steps
        task.goal_steps = 0  # goals come from whoever looks, and stay until they ask for another one
        self._settled_steps, self._pause_steps = math.ceil(SETTLED / dt - 1e-9), math.ceil(_PAUSE / dt)
        self.goals = self.reached = self.settled = self.crashed = 0
        self._steps, self._counts, self._was_reached, self._was_settled = 0, True, False, False
        self._tensordict = env.reset()
        self._begin_goal()

    @property
    def joint_position(self) -> np.ndarray:
        """Where the joints are, rad, [n]."""
        return self.simulation.state.joint_position[0]

    @property
    def base_pose(self) -> np.ndarray | None:
        """Where a base that floats is: x, y, z, m, and a quaternion x, y, z, w, [7]; None of a fixed one."""
        pose = self.simulation.state.base_pose
        return None if pose is None else pose[0]

    @property
    def goal(self) -> np.ndarray:
        """What it is asked for, [g]."""
        return self.simulation.goal[0]

    @property
    def parameters(self) -> np.ndarray:
        """What the robot is like, [P] (see :class:`physai.physics.ParameterLayout`)."""
        return self.simulation.physics_parameters[0]

    @property
    def finished(self) -> bool:
        """Whether it is time for another goal: it has stayed at this one, or had as long as an episode is."""
        stayed = self.simulation.within[0] >= self._settled_steps + self._pause_steps
        return bool(stayed) or self._steps >= self._most_steps

    def step(self) -> None:
        """Go on by one control step."""
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            after = self._env.step(self._actor(self._tensordict)).get("next")
        self._tensordict, self._steps = after, self._steps + 1
        if self._counts:
            succeeds, stayed = after["success"].item(), self.simulation.within[0] >= self._settled_steps
            self.reached += int(succeeds and not self._was_reached)
            self.settled += int(stayed and not self._was_settled)
            self._was_reached |= bool(succeeds)
            self._was_settled |= bool(stayed)
        if after["terminated"].item() and not after["success"].item():
            self.crashed += 1
            self.restart()

    def restart(self) -> None:
        """Begin anew somewhere, with another goal, if that is a place, and a robot that is as this one."""
        parameters, goal = self.simulation.physics_parameters, self.simulation.goal
        self._tensordict = self._env.reset()
        self.simulation.change(parameters)
        if self.simulation.task.goal.quantity not in (Quantity.POSITION, Quantity.POSE):  # people asked for that one
            self.simulation.aim(goal)
        self._begin_goal()

    def clear(self) -> None:
        """Begin anew, and count from zero."""
        self.goals = self.reached = self.settled = self.crashed = 0
        self.restart()

    def draw_goal(self) -> None:
        """Ask for another goal, as training does."""
        task, generator = self.simulation.task, self.simulation.generator
        self.simulation.aim(task.sample_goal(1, generator))
        self._begin_goal()

    def aim(self, goal: np.ndarray, rests: bool) -> np.ndarray:
        """Ask for a goal [g], or for the nearest in the region of goals.

        Args:
            goal: Finite numbers.
            rests: Whether it stays there; one that is still being moved is followed, and not counted.

        Returns:
            The goal that was taken, [g].
        """
        task = self.simulation.task
        if task.goal.quantity is Quantity.POSE:  # of the two quaternions of a turn, the one that policies are given
            turn = goal[3:] / np.linalg.norm(goal[3:])
            goal = np.concatenate([goal[:3], turn if turn[3] >= 0 else -turn])
        taken = goal if task.region.contains(goal) else task.region.project(goal)
        if taken is None:
            return self.goal
        if task.goal.quantity is Quantity.POSE:
            taken = np.concatenate([taken[:3], goal[3:]])
        self.simulation.aim(taken[np.newaxis])
        self._begin_goal(rests)
        return self.goal

    def set_parameter(self, name: str, value: float) -> None:
        """Give all columns of one of ``physics_parameters`` a value, from now on."""
        parameters = self.simulation.physics_parameters.copy()
        parameters[:, self.simulation.layout.columns[name]] = value
        self.simulation.change(parameters)

    def _begin_goal(self, counts: bool = True) -> None:
        self._counts, self._steps = counts, 0
        self._was_reached = self._was_settled = False
        self.goals += int(counts)

    def close(self) -> None:
        """Free the physics engine; may be called twice."""
        self.simulation.close()
