"""What an action in [-1, 1] means to a robot: the same law in a simulation and in a policy file."""

import numpy as np
import torch
from torch import Tensor, nn

from physai.robots.spec import RobotSpec
from physai.signals import Quantity

LEAD = 0.25  # s; a position command is at most this long ahead of where the joint is, at its fastest


class JointCommand(nn.Module):
    """Maps actions to commands; scriptable, and part of the exported policy.

    An action is the share of its fastest speed at which each joint shall move. As a velocity command it is just that.
    As a position command it moves the last command on, by what the joint goes in one control period at that speed:
    a delay of the drive then slows nothing down. The command stays within ``LEAD`` of the joint, so that an arm that
    cannot follow does not run after it later, and within the position limits.

    Where the robot says so (``action: offset``), an action is how far from home each joint shall be instead, as a share
    of its ``command_limit``: what legs do is around a stance, and a policy that remembers nothing can tell where it is.

    Args:
        spec: The robot.
        control_dt: Control period, s.
    """

    def __init__(self, spec: RobotSpec, control_dt: float) -> None:
        super().__init__()
        self.moves_on = spec.command is Quantity.JOINT_POSITION and not spec.offset
        self.offset = spec.offset
        self.scale: Tensor
        self.lead: Tensor
        self.lower: Tensor
        self.upper: Tensor
        limit, (lower, upper) = spec.command_limit, spec.position_limit.T
        self._arrays = limit * (control_dt if self.moves_on else 1.0), limit * LEAD, lower, upper
        for name, value in zip(("scale", "lead", "lower", "upper"), self._arrays, strict=True):
            self.register_buffer(name, torch.from_numpy(value).float())
        self.home: Tensor
        self._home = spec.home
        self.register_buffer("home", torch.from_numpy(spec.home).float())

    def forward(self, action: Tensor, joint_position: Tensor, last_command: Tensor) -> Tensor:
        """Map actions, where joints are, rad, and their last commands, [N, n] each, to commands [N, n].

        Velocity commands ask neither where joints are nor what came before.
        """
        wanted = action * self.scale
        if self.moves_on:
            near = torch.clamp(last_command + wanted, joint_position - self.lead, joint_position + self.lead)
            wanted = torch.clamp(near, self.lower, self.upper)
        elif self.offset:
            wanted = torch.clamp(self.home + wanted, self.lower, self.upper)
        return wanted

    def of_arrays(self, action: np.ndarray, joint_position: np.ndarray, last_command: np.ndarray) -> np.ndarray:
        """The same in arrays of double precision, of any actions: those beyond [-1, 1] count as -1 or 1."""
        scale, lead, lower, upper = self._arrays
        wanted = np.maximum(np.minimum(action, 1.0), -1.0) * scale
        if self.moves_on:
            near = np.clip(last_command + wanted, joint_position - lead, joint_position + lead)
            wanted = np.clip(near, lower, upper)
        elif self.offset:
            wanted = np.clip(self._home + wanted, lower, upper)
        return wanted

    @torch.jit.unused
    def action(self, command: Tensor, last_command: Tensor) -> Tensor:
        """Return the action that a command [N, n] comes from, where nothing held it back."""
        before = last_command if self.moves_on else self.home if self.offset else torch.zeros_like(command)
        return (command - before) / self.scale
