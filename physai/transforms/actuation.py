"""Actuator delay: a command reaches the motors some control steps after the policy gave it."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from physai.physics import ParameterLayout


class ActuatorDelay(Transform):
    """Holds back ``action`` by the robot's ``actuator_delay``; until the first command arrives, the robot gets zero.

    Args:
        layout: Tells where the delay stands in ``physics_parameters``.
        num_envs: N.
        joints: n.
        max_delay: Longest delay, in control steps.
    """

    def __init__(self, layout: ParameterLayout, num_envs: int, joints: int, max_delay: int) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self._column = layout.columns["actuator_delay"]
        self.delay: Tensor
        self.commands: Tensor
        self.register_buffer("delay", torch.zeros(num_envs, dtype=torch.int64))
        # commands[k] is what the policy said k steps ago
        self.register_buffer("commands", torch.zeros(max_delay + 1, num_envs, joints))
        self.register_buffer("_robots", torch.arange(num_envs), persistent=False)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.commands = torch.cat([tensordict.get("action")[None], self.commands[:-1]])
        return tensordict.set("action", self.commands[self.delay, self._robots])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        rows = torch.ones_like(self.delay, dtype=torch.bool) if mask is None else mask[:, 0]
        delay = tensordict_reset.get("physics_parameters")[:, self._column][:, 0].long()
        self.delay = torch.where(rows, delay, self.delay)
        self.commands = self.commands.masked_fill(rows[:, None], 0.0)
        return tensordict_reset
