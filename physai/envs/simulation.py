"""N robots at a task: the core that the TorchRL and the Gymnasium shells share."""

from typing import Any

import torch
from hydra.utils import get_object, instantiate
from torch import Tensor

from physai.config import Config, Count, PositiveFloat, Target
from physai.errors import UserError
from physai.physics import ParameterLayout, Physics
from physai.physics.viewer import Viewer
from physai.robots import ForwardKinematics, RobotConfig, RobotSpec


class EnvConfig(Config):
    """One file of ``conf/env``: a robot, a task, and how they run.

    ``physics`` names a :class:`physai.physics.Physics`, and what its constructor takes beside robot, number, control
    period and substeps.
    """

    name: str
    robot: RobotConfig
    task: Target
    physics: Target
    control_dt: PositiveFloat
    substeps: Count
    max_velocity: PositiveFloat

    @property
    def simulated(self) -> bool:
        """Whether there can be many of its robots, which are put anywhere and given other dynamics."""
        return bool(get_object(self.physics["_target_"]).simulated)


class Simulation:
    """Robots, physics and task, batched; rows are robots and episodes run independently in each.

    Args:
        config: The environment.
        num_envs: Number of robots, N.
        seed: Seeds goals and start poses.

    Attributes:
        observation: The task's module that makes what a policy sees, and knows the distance to the goal.
        joint_position, joint_velocity: True joint state, rad and rad/s, [N, n].
        goal: [N, 2], m.
        distance: To the goal, m, [N, 1].
        episode_length: Control steps since the last reset, [N, 1].
        episode_return: Sum of rewards since the last reset, [N, 1].
        parameters: ``physics_parameters`` in force, [N, P] (see :class:`physai.physics.ParameterLayout`).
    """

    def __init__(self, config: EnvConfig, num_envs: int, seed: int) -> None:
        self.config = config
        self.num_envs = num_envs
        self.spec = RobotSpec.from_config(config.robot)
        self.kinematics = ForwardKinematics(self.spec)
        self.layout = ParameterLayout(self.spec)
        self.task = instantiate(config.task, _convert_="all")
        self.task.check(self.spec, self.kinematics)
        if config.max_velocity > self.spec.velocity_limit.min():
            raise UserError(
                f"env.max_velocity: {config.max_velocity} rad/s is beyond the limit of '{self.spec.name}', "
                f"{self.spec.velocity_limit.min():g} rad/s"
            )
        self.observation = self.task.observation(self.spec, self.kinematics)
        make_physics = instantiate(config.physics, _partial_=True, _convert_="all")
        try:
            self.physics: Physics = make_physics(self.spec, num_envs, config.control_dt, config.substeps)
        except TypeError as error:  # arguments that are missing
            raise UserError(f"env.physics: {error}") from None
        self.generator = torch.Generator()
        self.seed(seed)
        joints = len(self.spec.joints)
        self.joint_position = torch.zeros(num_envs, joints)
        self.joint_velocity = torch.zeros(num_envs, joints)
        self.goal = torch.zeros(num_envs, self.task.goal_size)
        self.distance = torch.zeros(num_envs, 1)
        self.episode_length = torch.zeros(num_envs, 1, dtype=torch.int64)
        self.episode_return = torch.zeros(num_envs, 1)
        self.parameters = self.layout.nominal.repeat(num_envs, 1)

    def seed(self, seed: int) -> None:
        """Restart the random numbers of goals and start poses."""
        self.generator.manual_seed(seed)

    @torch.no_grad()
    def reset(self, rows: Tensor | None = None, parameters: Tensor | None = None) -> None:
        """Start new episodes in the rows of a mask [N] (all by default), with new parameters [N, P] if given."""
        index = torch.arange(self.num_envs) if rows is None else rows.nonzero()[:, 0]
        start = self.task.sample_start(len(index), self.spec, self.generator)
        dynamics = None
        # New tensors, not writes in place: the old ones may live on in a collected batch.
        self.goal = self.goal.index_put((index,), self.task.sample_goal(len(index), self.generator))
        self.episode_length = self.episode_length.index_fill(0, index, 0)
        self.episode_return = self.episode_return.index_fill(0, index, 0.0)
        if parameters is not None:
            new = parameters[index]
            self.parameters = self.parameters.index_put((index,), new)
            dynamics = self.layout.dynamics(new)
        self.physics.reset(index.numpy(), start.numpy(), torch.zeros_like(start).numpy(), dynamics)
        self._read(*self.physics.joint_state())

    @torch.no_grad()
    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Apply actions [N, n] in [-1, 1] for one control period.

        Returns:
            reward, terminated, truncated, each [N, 1]. Reaching the goal terminates; running out of time truncates,
            and a step that does both only terminates.
        """
        command = action.double().clamp(-1.0, 1.0) * self.config.max_velocity
        self._read(*self.physics.step(command.numpy()))
        terminated = self.task.success(self.distance)
        reward = self.task.reward(self.distance, terminated)
        self.episode_length = self.episode_length + 1
        self.episode_return = self.episode_return + reward
        truncated = (self.episode_length >= self.task.max_steps) & ~terminated
        return reward, terminated, truncated

    def _read(self, joint_position: Any, joint_velocity: Any) -> None:
        self.joint_position = torch.from_numpy(joint_position).float()
        self.joint_velocity = torch.from_numpy(joint_velocity).float()
        self.distance = self.observation.distance(self.joint_position, self.goal)

    def state(self) -> dict[str, Tensor]:
        """Return everything that ``set_state`` of an equal simulation needs to go on bit for bit."""
        physics = {f"physics.{key}": torch.from_numpy(value) for key, value in self.physics.state().items()}
        return {
            **physics,
            "goal": self.goal,
            "episode_length": self.episode_length,
            "episode_return": self.episode_return,
            "parameters": self.parameters,
            "generator": self.generator.get_state(),
        }

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restore what ``state`` returned."""
        prefix = "physics."
        self.physics.set_state({k.removeprefix(prefix): v.numpy() for k, v in state.items() if k.startswith(prefix)})
        self.goal, self.parameters = state["goal"], state["parameters"]
        self.episode_length, self.episode_return = state["episode_length"], state["episode_return"]
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
