"""What an exported policy is tried on: states that it meets at work, and states that it hopefully never meets."""

import itertools
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.envs.make import TransformedRobotEnv

ON_POLICY = 1024
_STEPS = 64
_FAR = 10.0  # times the goals' outer radius
_FAST = 100.0  # times the velocity limit
_TURNS = 4 * torch.pi  # stands for a position limit that does not exist


class States(NamedTuple):
    """Sensor readings, float32: ``joint_position`` [S, n], ``joint_velocity`` [S, n], ``goal`` [S, 2]."""

    joint_position: Tensor
    joint_velocity: Tensor
    goal: Tensor

    def row(self, index: int) -> "States":
        """One state, [1, ...] each."""
        return States(*(value[index : index + 1] for value in self))

    def describe(self, index: int) -> str:
        """One state in words."""
        return ", ".join(f"{key}={value[index].tolist()}" for key, value in zip(self._fields, self, strict=True))


@torch.no_grad()
def roll_out(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> TensorDictBase:
    """Let the policy drive, and return ``ON_POLICY`` states that it met, with all keys of the env and the actions."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(_STEPS, actor, break_when_any_done=False).reshape(-1)
    return rollout[torch.linspace(0, len(rollout) - 1, ON_POLICY).long()]


def extreme_states(env: TransformedRobotEnv) -> States:
    """Corners of the joint limits, far goals and huge velocities, each with each."""
    spec, (_, outer) = env.simulation.spec, env.simulation.task.goal_region
    limits = torch.from_numpy(spec.position_limit).clamp(-_TURNS, _TURNS)
    ends = torch.stack([limits[:, 0], torch.zeros(len(limits)), limits[:, 1]])  # [3, n]
    speed = torch.from_numpy(spec.velocity_limit)
    speeds = torch.stack([-_FAST * speed, -speed, torch.zeros_like(speed), speed, _FAST * speed])
    angles = torch.arange(4) * (torch.pi / 2) + 0.3
    ring = torch.stack([torch.cos(angles), torch.sin(angles)], dim=1) * outer
    goals = torch.cat([torch.zeros(1, 2), ring, _FAR * ring])
    # Corners of all joints would be too many for long arms: all at one end, and one by one.
    poses = [ends[0], ends[1], ends[2]]
    for joint, end in itertools.product(range(len(limits)), (0, 2)):
        pose = ends[1].clone()
        pose[joint] = ends[end, joint]
        poses.append(pose)
    rows = list(itertools.product(poses, speeds, goals))
    return States(*(torch.stack(list(column)).float() for column in zip(*rows, strict=True)))
