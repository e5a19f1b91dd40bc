"""What an exported policy is tried on: states that it meets at work, and states that it hopefully never meets."""

import itertools
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.deploy.metadata import INPUTS, MEMORY
from physai.envs.make import TransformedRobotEnv

ON_POLICY = 1024
_STEPS = 64
_FAR = 10.0  # times the goals' outer radius
_FAST = 100.0  # times the velocity limit
_TURNS = 4 * torch.pi  # stands for a position limit that does not exist


class States(tuple[Tensor, ...]):
    """Inputs of a policy, float32: ``joint_position`` [S, n], ``joint_velocity`` [S, n], ``goal`` [S, 2].

    Of a policy that remembers, also ``memory`` [S, H].
    """

    keys = (*INPUTS, MEMORY)

    def __new__(cls, *columns: Tensor) -> "States":
        """Put the inputs together, in this order."""
        return super().__new__(cls, columns)

    @property
    def joint_position(self) -> Tensor:
        """[S, n], rad."""
        return self[0]

    @property
    def joint_velocity(self) -> Tensor:
        """[S, n], rad/s."""
        return self[1]

    @property
    def goal(self) -> Tensor:
        """[S, 2], m."""
        return self[2]

    @property
    def memory_size(self) -> int:
        """H, or 0."""
        return sum(value.shape[1] for value in self[len(INPUTS) :])

    @property
    def sensed(self) -> "States":
        """The same without memory."""
        return States(*self[: len(INPUTS)])

    def named(self) -> dict[str, Tensor]:
        """The inputs by name."""
        return dict(zip(self.keys, self, strict=False))

    def row(self, index: int) -> "States":
        """One state, [1, ...] each."""
        return States(*(value[index : index + 1] for value in self))

    def rows(self) -> Iterable["States"]:
        """All states, one by one."""
        return map(self.row, range(len(self.goal)))

    def describe(self, index: int) -> str:
        """One state in words; of a memory, the first numbers."""
        return ", ".join(
            f"{key}={value[index, :8].tolist()}{'...' if key == MEMORY else ''}" for key, value in self.named().items()
        )


@torch.no_grad()
def roll_out(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> TensorDictBase:
    """Let the policy drive, and return ``ON_POLICY`` states that it met, with all keys of the env and the actions."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(_STEPS, actor, break_when_any_done=False).reshape(-1)
    return rollout[torch.linspace(0, len(rollout) - 1, ON_POLICY).long()]


def extreme_states(env: TransformedRobotEnv, memory_size: int = 0) -> States:
    """Corners of the joint limits, far goals and huge velocities, each with each; memories from empty to full."""
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
    sensed = [torch.stack(list(column)).float() for column in zip(*rows, strict=True)]
    if not memory_size:
        return States(*sensed)
    fullness = torch.linspace(-1, 1, 7).repeat(-(-len(rows) // 7))[: len(rows), None]  # [S, 1], empty ones among them
    return States(*sensed, fullness * torch.ones(memory_size))
