"""N robots at a task: the core that the TorchRL and the Gymnasium shells share."""

import math
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator
from torch import Tensor

from physai.config import Config, Count, PositiveFloat
from physai.errors import UserError
from physai.physics import ParameterLayout, Physics
from physai.physics.viewer import Viewer
from physai.robots import ForwardKinematics, RobotConfig, RobotSpec, TipPosition
from physai.targets import Target, find, make

_STATE = ("goal", "episode_length", "episode_return", "physics_parameters")  # beside what the physics holds


_TASK = ("check", "goal_size", "max_steps", "observation", "sample_goal", "sample_start", "success", "reward")
_PHYSICS = ("reset", "step", "joint_state", "close")


def _says_whether_simulated(node: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(getattr(find(node["_target_"]), "simulated", None), bool):
        raise ValueError(f"._target_: {node['_target_']} is no physics: it does not say whether it is 'simulated'")
    return node


class EnvConfig(Config):
    """One file of ``conf/env``: a robot, a task, and how they run.

    ``physics`` names a :class:`physai.physics.Physics`, and what its constructor takes beside robot, number, control
    period and substeps.
    """

    name: str
    robot: RobotConfig
    task: Target
    physics: Annotated[Target, AfterValidator(_says_whether_simulated)]
    control_dt: PositiveFloat
    substeps: Count
    max_velocity: PositiveFloat

    @property
    def simulated(self) -> bool:
        """Whether there can be many of its robots, which are put anywhere and given other dynamics."""
        return bool(find(self.physics["_target_"]).simulated)


class _Rows:
    """An array of one row a robot, which is made when it is asked for if it was given as lists.

    Lists come from ``step_one``, which has no time for six small arrays that nobody may look at.
    """

    def __init__(self, dtype: type) -> None:
        self._dtype = dtype

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_{name}"

    def __get__(self, simulation: "Simulation", owner: type) -> np.ndarray:
        return np.asarray(getattr(simulation, self._name), self._dtype)

    def __set__(self, simulation: "Simulation", value: Any) -> None:
        setattr(simulation, self._name, value)


class Simulation:
    """Robots, physics and task, batched; rows are robots and episodes run independently in each.

    Arrays are NumPy's, for these are small: a call of torch costs more than what it computes. An array is never written
    to again once it has been handed out: it may live on in a collected batch.

    Args:
        config: The environment.
        num_envs: Number of robots, N.
        seed: Seeds goals and start poses.

    Attributes:
        observation: The task's module that makes what a policy sees, and knows the distance to the goal.
        joint_position, joint_velocity: True joint state, rad and rad/s, [N, n].
        end_effector: True position of the end effector in the plane, m, [N, 2].
        goal: [N, 2], m.
        distance: To the goal, m, [N, 1].
        episode_length: Control steps since the last reset, [N, 1].
        episode_return: Sum of rewards since the last reset, [N, 1].
        physics_parameters: Those in force, [N, P] (see :class:`physai.physics.ParameterLayout`).
    """

    joint_position, joint_velocity, end_effector, distance, episode_return = (_Rows(np.float32) for _ in range(5))
    episode_length = _Rows(np.int64)

    def __init__(self, config: EnvConfig, num_envs: int, seed: int) -> None:
        self.config = config
        self.num_envs = num_envs
        self.spec = RobotSpec.from_config(config.robot)
        self.kinematics = ForwardKinematics(self.spec)
        self._tip = TipPosition(self.kinematics)
        self._continuous = self.spec.continuous.nonzero()[0].tolist()
        self.layout = ParameterLayout(self.spec)
        self.task = make("env.task", config.task, needs=_TASK)
        self.task.check(self.spec, self.kinematics)
        if config.max_velocity > self.spec.velocity_limit.min():
            raise UserError(
                f"env.max_velocity: {config.max_velocity} rad/s is beyond the limit of '{self.spec.name}', "
                f"{self.spec.velocity_limit.min():g} rad/s"
            )
        self.observation = self.task.observation(self.spec, self.kinematics)
        sizes = num_envs, config.control_dt, config.substeps
        self.physics: Physics = make("env.physics", config.physics, self.spec, *sizes, needs=_PHYSICS)
        self.generator = torch.Generator()
        self.seed(seed)
        joints = len(self.spec.joints)
        self.joint_position, self.joint_velocity, self.goal, self.end_effector, self.distance = (
            np.zeros((num_envs, size), np.float32) for size in (joints, joints, self.task.goal_size, 2, 1)
        )
        self._episode_length: Any = np.zeros((num_envs, 1), np.int64)
        self._episode_return: Any = np.zeros((num_envs, 1), np.float32)
        self.physics_parameters = self.layout.nominal.repeat(num_envs, 1).numpy()

    def seed(self, seed: int) -> None:
        """Restart the random numbers of goals and start poses."""
        self.generator.manual_seed(seed)

    def reset(self, rows: np.ndarray | None = None, parameters: np.ndarray | None = None) -> None:
        """Start new episodes in the rows of a mask [N] (all by default), with new parameters [N, P] if given."""
        self._begin(np.arange(self.num_envs) if rows is None else rows.nonzero()[0], parameters)
        self._read(*self.physics.joint_state())

    def _begin(self, index: np.ndarray, parameters: np.ndarray | None = None) -> None:
        start = self.task.sample_start(len(index), self.spec, self.generator)
        self.goal = _replaced(self.goal, index, self.task.sample_goal(len(index), self.generator))
        self.episode_length = _replaced(self.episode_length, index, 0)
        self.episode_return = _replaced(self.episode_return, index, 0.0)
        dynamics = None
        if parameters is not None:
            new = parameters[index]
            self.physics_parameters = _replaced(self.physics_parameters, index, new)
            dynamics = self.layout.dynamics(new)
        self.physics.reset(index, start, np.zeros_like(start), dynamics)

    def step(self, action: np.ndarray, restart: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Apply actions [N, n] in [-1, 1] for one control period.

        Args:
            action: The actions.
            restart: Rows [N] that start a new episode instead; there nothing is earned, and nothing ends.

        Returns:
            reward, terminated, truncated, each [N, 1]. Reaching the goal terminates; running out of time truncates,
            and a step that does both only terminates.
        """
        command = np.maximum(np.minimum(action, 1.0), -1.0) * np.float64(self.config.max_velocity)
        joint_state = self.physics.step(command)
        length = self.episode_length + 1
        if restart is not None and restart.any():
            index = restart.nonzero()[0]
            self._begin(index)
            joint_state, length[index] = self.physics.joint_state(), 0
        else:
            index = None
        self._read(*joint_state)
        terminated = self.task.success(self.distance)
        reward = self.task.reward(self.distance, terminated).astype(np.float32)
        if index is not None:
            terminated[index], reward[index] = False, 0.0
        self.episode_length = length
        self.episode_return = self.episode_return + reward
        truncated = (self.episode_length >= self.task.max_steps) & ~terminated
        return reward, terminated, truncated

    def step_one(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the only robot: ``step`` and ``observe`` in plain numbers, of double precision.

        Of one robot, NumPy's calls cost more than what they compute, too.

        Args:
            action: [n] in [-1, 1].

        Returns:
            Observation [2n + 4], reward, terminated, truncated, and ``is_success`` and ``distance`` (m).
        """
        fastest = self.config.max_velocity
        command = [min(max(share, -1.0), 1.0) * fastest for share in action.tolist()]
        position, velocity = self.physics.step_one(command)
        (goal,) = self.goal.tolist()
        tip = self._tip.of_one(position)
        distance = math.dist(tip, goal)
        terminated = self.task.success(distance)
        reward = self.task.reward(distance, terminated)
        length = int(self._episode_length[0][0]) + 1
        episode_return = float(self._episode_return[0][0]) + reward
        self._joint_position, self._joint_velocity, self._end_effector = [position], [velocity], [tip]
        self._distance, self._episode_length, self._episode_return = [[distance]], [[length]], [[episode_return]]
        observation = np.array(self.task.observe(self._continuous, position, velocity, tip, goal), np.float32)
        truncated = length >= self.task.max_steps and not terminated
        return observation, reward, terminated, truncated, {"is_success": terminated, "distance": distance}

    def observe(self) -> np.ndarray:
        """Return what a policy sees of the true state, [N, 2n + 4]: the same as the module ``observation`` makes."""
        columns = self.joint_position.T.astype(float), self.joint_velocity.T, self.end_effector.T, self.goal.T
        return np.ascontiguousarray(np.array(self.task.observe(self._continuous, *columns)).T, np.float32)

    def _read(self, joint_position: np.ndarray, joint_velocity: np.ndarray) -> None:
        self.joint_position = joint_position.astype(np.float32)
        self.joint_velocity = joint_velocity.astype(np.float32)
        self.end_effector = np.ascontiguousarray(self._tip.of_many(joint_position).T, np.float32)
        error = self.end_effector - self.goal
        self.distance = np.hypot(error[:, :1], error[:, 1:])

    def state(self) -> dict[str, Tensor]:
        """Return everything that ``set_state`` of an equal simulation needs to go on bit for bit."""
        arrays = {f"physics.{key}": value for key, value in self.physics.state().items()}
        arrays |= {key: getattr(self, key) for key in _STATE}
        return {
            **{key: torch.from_numpy(value) for key, value in arrays.items()},
            "generator": self.generator.get_state(),
        }

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restore what ``state`` returned."""
        prefix = "physics."
        self.physics.set_state({k.removeprefix(prefix): v.numpy() for k, v in state.items() if k.startswith(prefix)})
        for key in _STATE:
            setattr(self, key, state[key].numpy())
        self.generator.set_state(state["generator"])
        self._read(*self.physics.joint_state())

    def viewer(self, window: bool = False) -> Viewer:
        """Make a viewer for these robots; it has a world of its own."""
        home = torch.from_numpy(self.spec.home).float()
        height = float(self.kinematics(home[None])[0, 2])
        return Viewer(self.spec, height, self.kinematics.reach, self.task.tolerance, window)

    def close(self) -> None:
        """Free the physics engine."""
        self.physics.close()


def _replaced(array: np.ndarray, rows: np.ndarray, values: np.ndarray | float) -> np.ndarray:
    changed = array.copy()
    changed[rows] = values
    return changed
