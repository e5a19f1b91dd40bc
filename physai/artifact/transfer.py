"""A second opinion: how a policy file drives in an engine that it was not trained in."""

import importlib.util
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from physai.artifact.gate import GateError, drive
from physai.artifact.module import DeployablePolicy
from physai.compose import compose
from physai.config import not_installed
from physai.envs.simulation import EnvConfig, Simulation
from physai.errors import UserError
from physai.training.evaluation import MAX_ROBOTS, Evaluation
from physai.training.run import TrainedPolicy

LOWEST = 0.97  # success rate in the other engine that a policy must have for certain (lower bound of 95 %)
LARGEST_DROP = 0.01  # of the success rate, from the engine of the training to the other
_SPEED, _STEPS = 0.5, 25  # of the largest command, and for how long each joint is moved
_SOON = 8  # control steps, after which it shows what little effort does
_LATE = 2  # control steps; a drive's time constant takes one
_ROTOR = 0.01  # kg·m², of a drive
_SCALES = 0.5 ** np.arange(24)  # of the effort limit


def other_engine(physics: dict[str, Any]) -> dict[str, Any]:
    """Return the engine of ``conf/physics`` that a policy has not been trained in, with the motors of a drive.

    Raises:
        UserError: If it is not installed.
    """
    in_mujoco = physics["_target_"].rpartition(".")[2] == "MuJoCoPhysics"
    chosen = ["physics=pybullet"] if in_mujoco else ["physics=mujoco", "physics.motor=servo"]
    module = "pybullet" if in_mujoco else "mujoco"
    if importlib.util.find_spec(module) is None:
        raise UserError(f"the other engine needs {not_installed(module)}")
    return dict(compose("train", chosen).physics)


@dataclass(frozen=True)
class Opinion:
    """What came of asking another engine.

    Attributes:
        physics: The engine, as ``conf/physics`` names one.
        armature: Of the robots there, kg·m²: a drive has rotors, PyBullet has none.
        evaluation: Of the policy there.
        differences: What an arm does otherwise there, a line each.
        episodes: How many goals there were.
        randomization: Name of how robots differed.
    """

    physics: dict[str, Any]
    armature: float
    evaluation: Evaluation
    differences: list[str]
    episodes: int
    randomization: str

    def summary(self) -> dict[str, Any]:
        """The figures, for the files."""
        return {
            "physics": self.physics,
            "armature": self.armature,
            **self.evaluation.summary(),
            "episodes": self.episodes,
            "randomization": self.randomization,
            "differences": self.differences,
        }

    def require(self, own: Evaluation) -> None:
        """See that the policy is as good there as in its ``own`` engine.

        Raises:
            GateError: If it is not, or arms differ; it says how.
        """
        low, there = self.evaluation.success_ci[0], self.evaluation.success_rate
        said = f"the policy reaches {there:.1%} of {self.episodes:,} goals in the other engine"
        if self.differences:
            raise GateError(f"{'; '.join(self.differences)} in the other engine ({said})")
        if low < LOWEST:
            raise GateError(f"{said}, for certain {low:.1%}; {LOWEST:.0%} are required")
        if own.success_rate - there > LARGEST_DROP:
            raise GateError(f"{said}, and {own.success_rate:.1%} in its own; at most {LARGEST_DROP:.0%} may be lost")


def ask(content: bytes, policy: DeployablePolicy, trained: TrainedPolicy, episodes: int, seed: int) -> Opinion:
    """Let a TorchScript file drive the robots of its run in the other engine.

    Args:
        content: The file.
        policy: What it was made from.
        trained: The policy of the run.
        episodes: How many goals.
        seed: Seeds them.

    Raises:
        UserError: If the engine is not installed, or cannot load the robot.
    """
    config, physics = trained.config.env, other_engine(trained.config.env.physics)
    found = differences(config, physics) if config.robot.floating is None else []  # one that floats turns itself, too
    rotor = _ROTOR if physics.get("motor") == "servo" and config.robot.servo is None else 0.0
    robot = config.robot.model_copy(update={"armature": [rotor]})
    other = config.model_copy(update={"physics": physics, "robot": robot})
    _, env = trained.deploy(min(episodes, MAX_ROBOTS), seed, other)
    with closing(env):
        driven = drive(content, policy, env, episodes, seed)
    return Opinion(physics, rotor, driven, found, episodes, trained.randomization.name)


def differences(config: EnvConfig, other: dict[str, Any]) -> list[str]:
    """Move each joint alone in two engines, and say what an arm in the other one does differently.

    What is looked for: joints that turn the other way or in another order, commands that arrive later, motors with
    less or more effort than the same limit allows. How fast a drive closes in on its command is no difference, nor is
    the inertia of its rotor, which is left out here: a motor that has more to turn seems weaker. So are gravity, under
    which an arm with little effort sinks, and friction, which leaves next to nothing of it.

    Args:
        config: Robot and engine of the training.
        other: The other engine, as ``config.physics`` names one.

    Returns:
        One line a difference.
    """
    floating = config.robot.model_copy(update={"gravity": [0.0, 0.0, 0.0], "armature": [0.0]})
    (own, own_onset, own_weak), (moved, onset, weak) = (
        _respond(config.model_copy(update={"physics": engine, "robot": floating})) for engine in (config.physics, other)
    )
    joints, lines = config.robot.joints, []
    moves = np.abs(moved).argmax(axis=1)
    for told, joint in enumerate(joints):
        if moves[told] != told:
            lines.append(f"a command for {joint} moves {joints[moves[told]]}")
        elif moved[told, told] * own[told, told] < 0:
            lines.append(f"{joint} turns the other way")
    if lines:
        return lines
    late = int(np.median(onset - own_onset))
    if abs(late) >= _LATE:
        lines.append(f"commands arrive {abs(late)} control steps {'later' if late > 0 else 'earlier'}")
    for number, joint in enumerate(joints):
        far = own_weak[:, number] / own_weak[0, number]
        scale = int((far <= 0.5).argmax())  # the largest at which the limit decides all the way
        share = float(weak[scale, number] / own_weak[scale, number])
        if not 0.7 < share < 1.4:
            less = "less" if share < 1 else "more"
            lines.append(
                f"the motor of {joint} has {less} effort: with the same limit it gets {share:.2f} times as far"
            )
    return lines


def _respond(config: EnvConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tell each of n joints to move, alone, and see what they do.

    Rows of the simulation: each joint in turn at each scale of its effort limit.

    Returns:
        How far they moved, rad, at the end, [joint told, joint moving]; control steps until the joint that moves most
        does so, [n]; and how far the told joint gets soon with its effort limit scaled, rad, [scales, n].
    """
    joints = len(config.robot.joints)
    rows = joints * len(_SCALES)
    at_home = config.start.model_copy(update={"spread": [0.0], "carried_over": 0.0})
    simulation = Simulation(config.model_copy(update={"start": at_home}), rows, seed=0)
    with closing(simulation):
        told, every = np.repeat(np.arange(joints), len(_SCALES)), np.arange(rows)
        parameters, columns = simulation.physics_parameters.copy(), simulation.layout.columns
        parameters[:, columns["joint_friction"]] = 0.0
        parameters[every, columns["effort_limit"].start + told] *= np.tile(_SCALES, joints)
        simulation.reset(parameters=parameters)
        action = np.zeros((rows, joints), np.float32)
        action[every, told] = _SPEED
        path = []
        for _ in range(_STEPS):
            simulation.step(action)
            path.append(simulation.state.joint_position - simulation.spec.home)
    path_of = np.stack(path).reshape(_STEPS, joints, len(_SCALES), joints)  # [step, told, scale, moving]
    strong, of_told = path_of[:, :, 0], path_of[:, np.arange(joints), :, np.arange(joints)]  # [told, step, scale]
    most = np.abs(strong[-1]).argmax(axis=1)
    alone = np.abs(strong[:, np.arange(joints), most])  # [step, told]
    step = _SPEED * simulation.spec.command_limit * config.control_dt
    return strong[-1], (alone > 0.2 * step).argmax(axis=0), np.abs(of_told[:, _SOON - 1]).T
