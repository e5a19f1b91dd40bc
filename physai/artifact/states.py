"""What an exported policy is tried on: states that it meets at work, and states that it hopefully never meets."""

import itertools
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from physai.artifact.module import DeployablePolicy
from physai.deploy.metadata import GOAL, LAST_COMMAND, MEMORY, POSITION, VELOCITY
from physai.envs.make import TransformedRobotEnv
from physai.signals import Quantity, Signal

ON_POLICY = 1024
_STEPS = 64
_FAR = 10.0  # times the goals
_FAST = 100.0  # times the velocity limit
_TURNS = 4 * torch.pi  # stands for a position limit that does not exist
_AHEAD = 0.3  # rad; of a last command


class States(dict[str, Tensor]):
    """S values of each input of a policy by name, in its order, float32, [S, ...] each."""

    def __len__(self) -> int:
        """S."""
        return len(next(iter(self.values())))

    def rows(self) -> Iterable["States"]:
        """All states, one by one, [1, ...] each."""
        return (States({key: value[row : row + 1] for key, value in self.items()}) for row in range(len(self)))

    def describe(self, index: int) -> str:
        """One state in words; of a long value, the first numbers."""
        shown = {key: value[index] for key, value in self.items()}
        return ", ".join(f"{key}={v[:8].tolist()}{'...' if len(v) > 8 else ''}" for key, v in shown.items())


@torch.no_grad()
def roll_out(actor: TensorDictModuleBase, env: TransformedRobotEnv) -> TensorDictBase:
    """Let the policy drive, and return ``ON_POLICY`` states that it met, with all keys of the env and the actions."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(_STEPS, actor, break_when_any_done=False).reshape(-1)
    return rollout[torch.linspace(0, len(rollout) - 1, ON_POLICY).long()]


def extreme_states(policy: DeployablePolicy, env: TransformedRobotEnv) -> States:
    """Corners of the joint limits, far goals and huge velocities, each with each; of all else, from end to end."""
    spec, region = env.simulation.spec, env.simulation.task.region
    low, high = torch.from_numpy(spec.position_limit).clamp(-_TURNS, _TURNS).T
    speed = torch.from_numpy(spec.velocity_limit)
    speeds = [-_FAST * speed, -speed, torch.zeros_like(speed), speed, _FAST * speed]
    drawn = torch.from_numpy(region.sample(4, torch.Generator().manual_seed(0)))
    goals = torch.cat([torch.zeros_like(drawn[:1]), drawn, _FAR * drawn])
    if env.simulation.task.goal.quantity is Quantity.POSE:
        goals[:, 3:] = torch.cat([drawn[:1], drawn, drawn])[:, 3:]  # the controller lets rotations pass only
    # Corners of all joints would be too many for long arms: all at one end, and one by one.
    poses = torch.cat([torch.stack([low, torch.zeros_like(low), high]), low.diag(), high.diag()])
    rows = list(itertools.product(poses, speeds, goals))
    sensed = [torch.stack(list(column)).float() for column in zip(*rows, strict=True)]
    known = dict(zip((POSITION, VELOCITY, GOAL), sensed, strict=True))
    # From one side to the other, and from empty to full; the middle among them.
    sweep = torch.linspace(-1, 1, 7).repeat(-(-len(rows) // 7))[: len(rows), None]
    known[LAST_COMMAND] = known[POSITION] + _AHEAD * sweep
    known[MEMORY] = sweep * torch.ones(policy.memory_size)
    for signal in policy.inputs:
        if signal.name not in known:
            known[signal.name] = _swept(signal, sweep)
    return States({key: known[key] for key in policy.in_keys})


def _swept(signal: Signal, sweep: Tensor) -> Tensor:
    """Values of a signal between its ends, or where it has none between -100 and 100, [S, ...]; of unit length."""
    low, high = (torch.from_numpy(end).clamp(-_FAST, _FAST).float() for end in signal.bounds)
    if signal.quantity is Quantity.DIRECTION:
        angles = torch.pi * sweep * torch.arange(1, signal.size + 1)
        return torch.nn.functional.normalize(torch.cos(angles) + 0.1, dim=1)
    return low + (sweep + 1) / 2 * (high - low)
