"""What collects in a process of its own, and what acts there."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from physai.collectors.single import RobotCollector
from physai.envs.make import TransformedRobotEnv

MakeEnv = Callable[[int], TransformedRobotEnv]
"""Builds the env of a worker from its number, in the worker's process."""


def acting(policy: TensorDictModuleBase, env: TransformedRobotEnv) -> nn.ModuleDict:
    """Return what decides how robots act, and which robots: a policy, and what a learner renews in an env.

    Each worker has a copy, which follows the learner's between two batches and never in the middle of one.
    """
    return nn.ModuleDict({"policy": policy, **env.learned})


def each(
    batches: Iterator[TensorDictBase], errors: Callable[[], AbstractContextManager[None]]
) -> Iterator[TensorDictBase]:
    """Collect batches in a context that says what errors mean; whoever takes them is outside of it."""
    while True:
        with errors():
            batch = next(batches, None)
        if batch is None:
            return
        yield batch


class WorkerCollector(RobotCollector):
    """What collects in a worker."""

    def rollout(self) -> TensorDictBase:
        """Collect one batch."""
        batch = super().rollout()
        # TorchRL counts frames by this key; what it says of trajectories nobody asks.
        return batch.set(("collector", "traj_ids"), torch.zeros(batch.shape, dtype=torch.int64))

    def renew(self, weights: dict[str, Tensor]) -> None:
        """Act from now on as those do whose ``state_dict`` (:func:`acting`) this is."""
        acting(self.policy, self.env).load_state_dict(weights)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the env and of this process' random numbers."""
        return self.state() | {"random": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        """Restore what ``state_dict`` returned; ``strict`` is TorchRL's."""
        self.set_state(state_dict)
        torch.set_rng_state(state_dict["random"])
