"""N robots at a task: the core that the TorchRL and the Gymnasium shells share."""

from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from physai.config import Config, Count, EachNonNegative, PositiveFloat, of_each
from physai.errors import UserError
from physai.physics import ActuatorDelay, ParameterLayout, Physics, RobotState
from physai.physics.interface import at_home
from physai.physics.rotation import rotate_back
from physai.robots import ForwardKinematics, JointCommand, RobotConfig, RobotSpec
from physai.signals import Quantity, Signal
from physai.targets import Target, find, make
from physai.tasks import Step, Task

_TASK = ("goal", "region", "tolerances", "observation", "module", "max_steps", "success", "terminated", "rewards")
_PHYSICS = ("reset", "step", "robot_state", "close")
PAST_ACTIONS = 4  # that a teacher sees: as many may be on their way, if the actuators are that late
_STATE = (
    *("goal", "last_action", "last_command", "episode_length", "episode_rewards", "physics_parameters"),
    *("within", "success", "started", "past_actions", "error_sum"),
)
_PUSH_EVERY = 4.0  # s, on average


def _says_whether_simulated(node: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(getattr(find(node["_target_"]), "simulated", None), bool):
        raise ValueError(f"._target_: {node['_target_']} is no physics: it does not say whether it is 'simulated'")
    return node


class StartConfig(Config):
    """Where episodes begin.

    ``spread``: uniformly within the home pose plus or minus this, rad, one value a joint, or one for all.
    ``carried_over``: a share of the episodes that begins where the last one ended, as on a robot that gets one goal
    after the other. A robot that is not simulated begins at home, for it cannot be put anywhere at once.
    """

    spread: EachNonNegative
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

    @property
    def ignored(self) -> tuple[str, ...]:
        """What its engine leaves as the robot's description says (:attr:`physai.physics.Physics.ignores`)."""
        return tuple(getattr(find(self.physics["_target_"]), "ignores", ()))


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
        past_actions: What was asked of them in the last ``PAST_ACTIONS`` steps, newest first, [N, 4 n]; zeros before.
        last_command: What the robots were told last, [N, n], rad/s or rad; where they stand when an episode begins.
        episode_length: Control steps since the last reset, [N, 1].
        episode_rewards: Sum of each term of the reward since the last reset, [N, terms].
        physics_parameters: Those in force, [N, P] (see :class:`physai.physics.ParameterLayout`).
        relative_parameters: The same, centred on the nominal robot and scaled, [N, P].
        error_sum: Sum of the errors since the last reset, [N, e].
        within: Control steps that the goal has been held, [N].
        started: Whether there has been an episode since the last seed, [N]; before, none is carried over.
        reward_terms: Names of the terms.
    """

    def __init__(self, config: EnvConfig, num_envs: int, seed: int) -> None:
        self.config = config
        self.num_envs = num_envs
        self.spec = RobotSpec.from_config(config.robot)
        self._spread = of_each(config.start.spread, len(self.spec.joints), "env.start.spread")
        if self.spec.floating is not None and config.start.carried_over:
            raise UserError("env.start.carried_over: a robot whose base floats may have fallen: 0 is needed")
        self._kinematics = ForwardKinematics(self.spec) if self.spec.end_effector else None
        if self._kinematics is None and getattr(find(config.task["_target_"]), "needs_end_effector", False):
            raise UserError(f"robot '{self.spec.name}' has no end effector, which env.task needs")
        self.layout = ParameterLayout(self.spec, config.ignored)
        self.joint_command = JointCommand(self.spec, config.control_dt)
        self.task: Task = make("env.task", config.task, self.spec, self._kinematics, needs=_TASK)
        self._simulated = config.simulated
        sizes = num_envs, config.control_dt, config.substeps
        self.physics: Physics = make("env.physics", config.physics, self.spec, *sizes, needs=_PHYSICS)
        self.generator = torch.Generator()
        self.seed(seed)
        self._sensed = [signal.name for signal in self.sensed]
        self.tolerance = np.array([tolerance.value for tolerance in self.task.tolerances])
        self._delay = ActuatorDelay(num_envs, len(self.spec.joints))
        self.state: RobotState = self.physics.robot_state()
        self.goal: np.ndarray = np.zeros((num_envs, *self.task.goal.shape))
        self.physics_parameters: np.ndarray = self.layout.nominal.repeat(num_envs, 1).numpy()
        self.relative_parameters = self.layout.relative(self.physics_parameters)
        self.last_command = self._standing(self.state)
        self.last_action = np.zeros(self.last_command.shape, np.float32)
        self.past_actions = np.tile(self.last_action, PAST_ACTIONS)
        self.within = np.zeros(num_envs, np.int64)
        self.error = self.task.error(self.state, self.goal)
        self.error_sum = np.zeros_like(self.error)
        self.success = np.zeros((num_envs, 1), bool)
        self.episode_length = np.zeros((num_envs, 1), np.int64)
        first = self._step(self.last_command, self.last_action, self.episode_length)
        self.reward_terms = tuple(self.task.rewards(first, self.success[:, 0]))
        self.episode_rewards = np.zeros((num_envs, len(self.reward_terms)), np.float32)

    @property
    def kinematics(self) -> ForwardKinematics:
        """Where the end effector is; raises a UserError if the robot has none."""
        if self._kinematics is None:
            raise UserError(f"robot '{self.spec.name}' has no end effector")
        return self._kinematics

    @property
    def sensed(self) -> tuple[Signal, ...]:
        """What a policy gets from robot and task, in this order."""
        spec = self.spec
        signals = [spec.joint_position, spec.joint_velocity]
        if spec.floating is not None:
            axes = ("x", "y", "z")
            signals.append(Signal("angular_velocity", Quantity.ANGULAR_VELOCITY, (3,), labels=axes, frame=spec.base))
            signals.append(Signal("gravity", Quantity.DIRECTION, (3,), labels=axes, frame=spec.base))
        signals.append(self.task.goal)
        if "last_action" in self.task.module.senses:
            ends = np.full((2, len(spec.joints)), [[-1.0], [1.0]])
            signals.append(Signal.of_joints("last_action", Quantity.ACTION, spec.joints, *ends))
        if "clock" in self.task.module.senses:
            signals.append(Signal("clock", Quantity.TIME, (1,), (0.0,), (self.task.module.period,)))
        if self.joint_command.moves_on:
            command = spec.joint_command
            last = Signal("last_command", command.quantity, command.shape, command.low, command.high, command.labels)
            signals.append(last)
        return tuple(signals)

    def sense(self) -> dict[str, np.ndarray]:
        """Return the true values of what is sensed, by name, [N, ...]."""
        state = self.state
        told = {
            "joint_position": state.joint_position,
            "joint_velocity": state.joint_velocity,
            "goal": self.goal,
            "last_action": self.last_action,
            "last_command": self.last_command,
            "clock": np.mod(self.episode_length * self.config.control_dt, self.task.module.period),
        }
        if state.base_pose is not None and state.base_twist is not None:
            turn = state.base_pose[:, 3:]
            told["angular_velocity"] = rotate_back(turn, state.base_twist[:, 3:])
            told["gravity"] = rotate_back(turn, np.broadcast_to([0.0, 0.0, -1.0], (len(turn), 3)))
        return {name: told[name] for name in self._sensed}

    def true_base(self) -> dict[str, np.ndarray]:
        """Return what no sensor tells of a base that floats, and a critic may see."""
        pose, twist = self.state.base_pose, self.state.base_twist
        return {} if pose is None or twist is None else {"base_velocity": rotate_back(pose[:, 3:], twist[:, :3])}

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
        self.error_sum = _replaced(self.error_sum, rows, 0.0)
        self.success = _replaced(self.success, rows, False)
        dynamics = delay = None
        if parameters is not None:
            new = parameters[rows]
            self.physics_parameters = _replaced(self.physics_parameters, rows, new)
            self.relative_parameters = self.layout.relative(self.physics_parameters)
            dynamics = self.layout.dynamics(new)
            delay = new[:, self.layout.columns["actuator_delay"]][:, 0]
        self.physics.reset(rows, start, dynamics)
        self.state = self.physics.robot_state()
        standing = self._standing(self.state)[rows]
        self.last_command = _replaced(self.last_command, rows, standing)
        self.last_action = _replaced(self.last_action, rows, 0.0)
        self.past_actions = _replaced(self.past_actions, rows, 0.0)
        self._delay.reset(rows, standing, delay)

    def change(self, parameters: np.ndarray) -> None:
        """Give the robots other parameters [N, P] in the midst of their episodes; commands on their way are lost."""
        rows = np.arange(self.num_envs)
        self.physics_parameters = parameters.astype(self.physics_parameters.dtype)
        self.relative_parameters = self.layout.relative(self.physics_parameters)
        self.physics.reset(rows, self.state, self.layout.dynamics(self.physics_parameters))
        delay = self.physics_parameters[:, self.layout.columns["actuator_delay"]][:, 0]
        self._delay.reset(rows, self.last_command, delay)

    def aim(self, goal: np.ndarray) -> None:
        """Ask for other goals [N, g] in the midst of their episodes."""
        self.goal = goal.astype(self.goal.dtype)
        self.error = self.task.error(self.state, self.goal)
        self.within = np.zeros_like(self.within)

    def _start(self, rows: np.ndarray, ended: RobotState) -> RobotState:
        """Draw where the episodes of some rows begin: within the limits, or where the last ones ended.

        Where the robot would touch something, it begins at home.
        """
        config, spec, count = self.config.start, self.spec, len(rows)
        home = at_home(spec, count)
        position, velocity = home.joint_position, home.joint_velocity
        if not self._simulated:
            return home
        if self._spread.any():  # else a seed gives the same goals to robots one after the other as side by side
            draw = torch.rand(position.shape, generator=self.generator, dtype=torch.float64).numpy()
            position = np.clip(position + (2 * draw - 1) * self._spread, *spec.position_limit.T)
        if config.carried_over:
            carried = torch.rand(count, 1, generator=self.generator).numpy() < config.carried_over
            carried &= self.started[rows, None]
            position = np.where(carried, ended.joint_position[rows], position)
            velocity = np.where(carried, ended.joint_velocity[rows], velocity)
        if (clearance := self.task.clearance(position)) is not None:
            touches = clearance[:, None] <= 0
            position, velocity = np.where(touches, spec.home, position), np.where(touches, 0.0, velocity)
        return replace(home, joint_position=position, joint_velocity=velocity)

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
        self._push()
        length = self.episode_length + 1
        if restart is not None and restart.any():
            self._begin(rows := restart.nonzero()[0], before)
            length[rows] = 0
        else:
            rows = None
        self.error = self.task.error(self.state, self.goal)
        near = (self.error < self.tolerance).all(axis=1)
        self.within = np.where(near, self.within + 1, 0)
        self.error_sum = self.error_sum + self.error
        step = self._step(command, action, length)
        self.last_action = action
        self.past_actions = np.concatenate([action, self.past_actions[:, : -action.shape[1]]], axis=1)
        success = self.task.success(step)
        terminated = self.task.terminated(step, success)
        rewards = np.stack(list(self.task.rewards(step, success).values()), axis=1).astype(np.float32)
        if rows is not None:
            self.within[rows], rewards[rows], self.error_sum[rows] = 0, 0.0, 0.0
            self.last_action[rows] = 0.0
            self.past_actions[rows] = 0.0
            success, terminated = _replaced(success, rows, False), _replaced(terminated, rows, False)  # the task's own
        self.success, terminated = success[:, None], terminated[:, None]
        self.episode_length = length
        self.episode_rewards = self.episode_rewards + rewards
        truncated = (length >= self.task.max_steps) & ~terminated
        if self.task.goal_steps:
            self._renew_goals(length[:, 0], (terminated | truncated)[:, 0])
        return rewards.sum(axis=1, keepdims=True), terminated, truncated

    def _push(self) -> None:
        """Change the velocity of some bases that float at once, as a kick would."""
        state = self.state
        if state.base_twist is None:
            return
        speed = self.physics_parameters[:, self.layout.columns["push"]][:, 0]
        if not speed.any():
            return
        chance, way = torch.rand(2, self.num_envs, generator=self.generator).numpy()
        rows = ((chance < self.config.control_dt / _PUSH_EVERY) & (speed > 0)).nonzero()[0]
        if not len(rows):
            return
        angle = 2 * np.pi * way[rows]
        twist = state.base_twist[rows]
        twist[:, :2] += speed[rows, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.physics.reset(rows, replace(state.of(rows), base_twist=twist))
        moved = self.physics.robot_state()
        # What was felt in this step stays: a kick takes no time.
        self.state = replace(moved, joint_effort=state.joint_effort, contact=state.contact)

    def _renew_goals(self, length: np.ndarray, over: np.ndarray) -> None:
        """Ask for other goals where it is time to; an episode that is over ends with the goal that it was judged by."""
        rows = ((length % self.task.goal_steps == 0) & (length > 0) & ~over).nonzero()[0]
        if len(rows):
            self.goal = _replaced(self.goal, rows, self.task.sample_goal(len(rows), self.generator))
            self.within = _replaced(self.within, rows, 0)

    def _step(self, command: np.ndarray, action: np.ndarray, length: np.ndarray) -> Step:
        held = self.within * self.config.control_dt
        clearance = self.task.clearance(self.state.joint_position)
        return Step(
            self.state,
            command,
            action,
            self.last_action,
            self.goal,
            self.error,
            held,
            clearance,
            length=length[:, 0],
            mean_error=self.error_sum / np.maximum(length, 1),
        )

    def observe(self) -> np.ndarray:
        """Return what a policy sees of the true state, [N, o], float32."""
        return self.task.observe(self.sense())

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
        self.relative_parameters = self.layout.relative(self.physics_parameters)
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
