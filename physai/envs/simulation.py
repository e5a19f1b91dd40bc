"""N robots at a task: the core that the TorchRL and the Gymnasium shells share."""

from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from physai.config import Config, Count, NonNegativeFloat, PositiveFloat
from physai.errors import UserError
from physai.physics import ActuatorDelay, ParameterLayout, Physics, RobotState
from physai.robots import ForwardKinematics, JointCommand, RobotConfig, RobotSpec
from physai.signals import Quantity, Signal
from physai.targets import Target, find, make
from physai.tasks import Step, Task

_TASK = ("goal", "region", "tolerances", "observation", "module", "max_steps", "success", "terminated", "rewards")
_PHYSICS = ("reset", "step", "robot_state", "close")
_STATE = (
    *("goal", "last_action", "last_command", "episode_length", "episode_rewards", "physics_parameters"),
    *("within", "success", "started"),
)


def _says_whether_simulated(node: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(getattr(find(node["_target_"]), "simulated", None), bool):
        raise ValueError(f"._target_: {node['_target_']} is no physics: it does not say whether it is 'simulated'")
    return node


class StartConfig(Config):
    """Where episodes begin.

    ``spread``: uniformly within the home pose plus or minus this, rad, one value a joint. ``carried_over``: a share of
    the episodes that begins where the last one ended, as on a robot that gets one goal after the other. A robot that is
    not simulated begins at home, for it cannot be put anywhere at once.
    """

    spread: list[NonNegativeFloat]
    carried_over: Annotated[float, Field(ge=0, le=1)]


class EnvConfig(Config):
    """One file of ``conf/env``: a robot, a task, and how they run.

    ``physics`` names a :class:`physai.physics.Physics`, and what its constructor takes beside robot, number, control
    period and substeps; ``task`` a :class:`physai.tasks.Task`, and what its constructor takes beside robot and
    kinematics.
    """

    name: str
    robot: RobotConfig
    task: Target
    physics: Annotated[Target, AfterValidator(_says_whether_simulated)]
    control_dt: PositiveFloat
    substeps: Count
    start: StartConfig

    @property
    def simulated(self) -> bool:
        """Whether there can be many of its robots, which are put anywhere and given other dynamics."""
        return bool(find(self.physics["_target_"]).simulated)


class Simulation:
    """Robots, physics and task, batched; rows are robots and episodes run independently in each.

    Arrays are NumPy's, for these are small: a call of torch costs more than what it computes. An array is never written
    to again once it has been handed out: it may live on in a collected batch.

    Args:
        config: The environment.
        num_envs: Number of robots, N.
        seed: Seeds goals and start poses.

    Attributes:
        state: What the robots truly do.
        goal: [N, g].
        error: How far they are from it, one column a tolerance, [N, e].
        tolerance: Within which they count as there, [e]; the task's, unless somebody asks for more.
        success: Whether the last step was one, [N, 1].
        last_action: What was asked of them last, [N, n], in [-1, 1]; zeros when an episode begins.
        last_command: What the robots were told last, [N, n], rad/s or rad; where they stand when an episode begins.
        episode_length: Control steps since the last reset, [N, 1].
        episode_rewards: Sum of each term of the reward since the last reset, [N, terms].
        physics_parameters: Those in force, [N, P] (see :class:`physai.physics.ParameterLayout`).
        within: Control steps that the goal has been held, [N].
        started: Whether there has been an episode since the last seed, [N]; before, none is carried over.
        reward_terms: Names of the terms.
    """

    def __init__(self, config: EnvConfig, num_envs: int, seed: int) -> None:
        self.config = config
        self.num_envs = num_envs
        self.spec = RobotSpec.from_config(config.robot)
        if len(config.start.spread) != len(self.spec.joints):
            raise UserError(
                f"env.start.spread has {len(config.start.spread)} values for {len(self.spec.joints)} joints"
            )
        self.kinematics = ForwardKinematics(self.spec)
        self.layout = ParameterLayout(self.spec)
        self.joint_command = JointCommand(self.spec, config.control_dt)
        self.task: Task = make("env.task", config.task, self.spec, self.kinematics, needs=_TASK)
        self._simulated = config.simulated
        sizes = num_envs, config.control_dt, config.substeps
        self.physics: Physics = make("env.physics", config.physics, self.spec, *sizes, needs=_PHYSICS)
        self.generator = torch.Generator()
        self.seed(seed)
        self.tolerance = np.array([tolerance.value for tolerance in self.task.tolerances])
        self._delay = ActuatorDelay(num_envs, len(self.spec.joints))
        self.state: RobotState = self.physics.robot_state()
        self.goal: np.ndarray = np.zeros((num_envs, *self.task.goal.shape))
        self.physics_parameters: np.ndarray = self.layout.nominal.repeat(num_envs, 1).numpy()
        self.last_command = self._standing(self.state)
        self.last_action = np.zeros(self.last_command.shape, np.float32)
        self.within = np.zeros(num_envs, np.int64)
        self.error = self.task.error(self.state, self.goal)
        self.success = np.zeros((num_envs, 1), bool)
        self.reward_terms = tuple(
            self.task.rewards(self._step(self.last_command, self.last_action), self.success[:, 0])
        )
        self.episode_length = np.zeros((num_envs, 1), np.int64)
        self.episode_rewards = np.zeros((num_envs, len(self.reward_terms)), np.float32)

    @property
    def sensed(self) -> tuple[Signal, ...]:
        """What a policy gets from robot and task, in this order."""
        signals = (self.spec.joint_position, self.spec.joint_velocity, self.task.goal)
        if self.spec.command is not Quantity.JOINT_POSITION:
            return signals
        command = self.spec.joint_command
        last = Signal("last_command", command.quantity, command.shape, command.low, command.high, command.labels)
        return (*signals, last)

    def seed(self, seed: int) -> None:
        """Restart the random numbers of goals and start poses; what follows does not depend on what was before."""
        self.generator.manual_seed(seed)
        self.started = np.zeros(self.num_envs, bool)

    def reset(self, rows: np.ndarray | None = None, parameters: np.ndarray | None = None) -> None:
        """Start new episodes in the rows of a mask [N] (all by default), with new parameters [N, P] if given."""
        self._begin(np.arange(self.num_envs) if rows is None else rows.nonzero()[0], self.state, parameters)
        self.error = self.task.error(self.state, self.goal)

    def _begin(self, rows: np.ndarray, ended: RobotState, parameters: np.ndarray | None = None) -> None:
        start = self._start(rows, ended)
        self.started = _replaced(self.started, rows, True)
        self.goal = _replaced(self.goal, rows, self.task.sample_goal(len(rows), self.generator))
        self.episode_length = _replaced(self.episode_length, rows, 0)
        self.episode_rewards = _replaced(self.episode_rewards, rows, 0.0)
        self.within = _replaced(self.within, rows, 0)
        self.success = _replaced(self.success, rows, False)
        dynamics = delay = None
        if parameters is not None:
            new = parameters[rows]
            self.physics_parameters = _replaced(self.physics_parameters, rows, new)
            dynamics = self.layout.dynamics(new)
            delay = new[:, self.layout.columns["actuator_delay"]][:, 0]
        self.physics.reset(rows, start, dynamics)
        self.state = self.physics.robot_state()
        standing = self._standing(self.state)[rows]
        self.last_command = _replaced(self.last_command, rows, standing)
        self.last_action = _replaced(self.last_action, rows, 0.0)
        self._delay.reset(rows, standing, delay)

    def _start(self, rows: np.ndarray, ended: RobotState) -> RobotState:
        """Draw where the episodes of some rows begin: within the limits, or where the last ones ended.

        Where the robot would touch something, it begins at home.
        """
        config, spec, count = self.config.start, self.spec, len(rows)
        position = np.tile(spec.home, (count, 1))
        velocity = np.zeros_like(position)
        if not self._simulated:
            return RobotState(position, velocity)
        if any(config.spread):  # else a seed gives the same goals to robots one after the other as side by side
            draw = torch.rand(position.shape, generator=self.generator, dtype=torch.float64).numpy()
            position = np.clip(position + (2 * draw - 1) * np.array(config.spread), *spec.position_limit.T)
        if config.carried_over:
            carried = torch.rand(count, 1, generator=self.generator).numpy() < config.carried_over
            carried &= self.started[rows, None]
            position = np.where(carried, ended.joint_position[rows], position)
            velocity = np.where(carried, ended.joint_velocity[rows], velocity)
        if (clearance := self.task.clearance(position)) is not None:
            touches = clearance[:, None] <= 0
            position, velocity = np.where(touches, spec.home, position), np.where(touches, 0.0, velocity)
        return RobotState(position, velocity)

    def _standing(self, state: RobotState) -> np.ndarray:
        """The command that keeps robots where they are."""
        takes_positions = self.spec.command is Quantity.JOINT_POSITION
        return state.joint_position if takes_positions else np.zeros_like(state.joint_position)

    def step(self, action: np.ndarray, restart: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Apply actions [N, n] in [-1, 1] for one control period.

        Args:
            action: The actions.
            restart: Rows [N] that start a new episode instead; there nothing is earned, and nothing ends.

        Returns:
            reward, terminated, truncated, each [N, 1]. Running out of time truncates, and a step that also terminates
            only terminates.
        """
        command = self.joint_command.of_arrays(action, self.state.joint_position, self.last_command)
        action = np.maximum(np.minimum(action, 1.0), -1.0)
        self.last_command, before = command, self.state
        self.state = self.physics.step(self._delay(command))
        length = self.episode_length + 1
        if restart is not None and restart.any():
            self._begin(rows := restart.nonzero()[0], before)
            length[rows] = 0
        else:
            rows = None
        self.error = self.task.error(self.state, self.goal)
        near = (self.error < self.tolerance).all(axis=1)
        self.within = np.where(near, self.within + 1, 0)
        step = self._step(command, action)
        self.last_action = action
        success = self.task.success(step)
        terminated = self.task.terminated(step, success)
        rewards = np.stack(list(self.task.rewards(step, success).values()), axis=1).astype(np.float32)
        if rows is not None:
            self.within[rows], rewards[rows] = 0, 0.0
            self.last_action[rows] = 0.0
            success, terminated = _replaced(success, rows, False), _replaced(terminated, rows, False)  # the task's own
        self.success, terminated = success[:, None], terminated[:, None]
        self.episode_length = length
        self.episode_rewards = self.episode_rewards + rewards
        truncated = (length >= self.task.max_steps) & ~terminated
        return rewards.sum(axis=1, keepdims=True), terminated, truncated

    def _step(self, command: np.ndarray, action: np.ndarray) -> Step:
        held = self.within * self.config.control_dt
        clearance = self.task.clearance(self.state.joint_position)
        return Step(self.state, command, action, self.last_action, self.goal, self.error, held, clearance)

    def observe(self) -> np.ndarray:
        """Return what a policy sees of the true state, [N, o], float32."""
        return self.task.observe(self.state, self.goal)

    def snapshot(self) -> dict[str, Tensor]:
        """Return everything that ``restore`` of an equal simulation needs to go on bit for bit."""
        arrays = {f"physics.{key}": value for key, value in self.physics.state().items()}
        arrays |= {f"delay.{key}": value for key, value in self._delay.state().items()}
        arrays |= {key: getattr(self, key) for key in _STATE}
        return {
            **{key: torch.from_numpy(value) for key, value in arrays.items()},
            "generator": self.generator.get_state(),
        }

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Go on from a ``snapshot``."""
        self.physics.set_state(_within(snapshot, "physics."))
        self._delay.set_state(_within(snapshot, "delay."))
        for key in _STATE:
            setattr(self, key, snapshot[key].numpy())
        self.generator.set_state(snapshot["generator"])
        self.state = self.physics.robot_state()
        self.error = self.task.error(self.state, self.goal)

    def close(self) -> None:
        """Free the physics engine."""
        self.physics.close()


def _within(snapshot: dict[str, Tensor], prefix: str) -> dict[str, np.ndarray]:
    return {key.removeprefix(prefix): value.numpy() for key, value in snapshot.items() if key.startswith(prefix)}


def _replaced(array: np.ndarray, rows: np.ndarray, values: np.ndarray | float) -> np.ndarray:
    changed = array.copy()
    changed[rows] = values
    return changed
