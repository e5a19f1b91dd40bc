"""Domain randomization: every episode of every robot draws its own physics, actuators and sensors.

After Tobin et al., "Domain Randomization for Transferring Deep Neural Networks from Simulation to the Real World",
2017, and Peng et al., "Sim-to-Real Transfer of Robotic Control with Dynamics Randomization", 2018.
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from physai.physics import ParameterLayout, RandomizationConfig
from physai.transforms.ranges import Ranges
from physai.transforms.stochastic import StochasticTransform


class DomainRandomization(StochasticTransform):
    """Draws ``physics_parameters`` [N, P] for the rows that are reset; the env applies them, and they stay readable.

    Args:
        config: What to draw.
        layout: Columns of ``physics_parameters`` and the robot's nominal values, which operations start from.
        num_envs: N.
        seed: Seeds the draws.

    Raises:
        UserError: If the config is for a robot with other joints or links.
    """

    def __init__(
        self, config: RandomizationConfig, layout: ParameterLayout, num_envs: int, seed: int, **keys: list[str]
    ) -> None:
        super().__init__(seed, **keys)
        config.check(layout)
        self.config = config
        self.layout = layout
        self.num_envs = num_envs

    def sample(self, rows: int) -> Tensor:
        """Draw parameters for so many robots, [rows, P]."""
        return self.config.sample(rows, self.layout, self.generator)

    def _draw(self, rows: Tensor) -> Tensor:
        """Draw parameters for the rows of a mask [N]."""
        return self.sample(int(rows.sum()))

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=[self.num_envs])
        mask = tensordict.get("_reset", None)
        rows = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask[:, 0]
        parameters = torch.zeros(self.num_envs, len(self.layout.nominal))
        parameters[rows] = self._draw(rows)
        return tensordict.set("physics_parameters", parameters)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict


class GrowingRandomization(DomainRandomization):
    """Draws from the :class:`Ranges` of now, and puts some robots on a boundary of them.

    Each row says as ``boundary`` [N, 1] on which one its episode stands (see :meth:`Ranges.pin`).

    Args:
        ranges: Theirs is the config; a learner moves them between two batches.
        pinned: The share of episodes that stand on a boundary.
        layout: See :class:`DomainRandomization`.
        num_envs: N.
        seed: Seeds the draws.
    """

    def __init__(self, ranges: Ranges, pinned: float, layout: ParameterLayout, num_envs: int, seed: int) -> None:
        super().__init__(ranges.config, layout, num_envs, seed, out_keys=["boundary"])
        self.ranges = ranges
        self.pinned = pinned
        self.boundary: Tensor
        self.register_buffer("boundary", torch.zeros(num_envs, 1, dtype=torch.int64))

    def _draw(self, rows: Tensor) -> Tensor:
        draws = torch.rand(int(rows.sum()), len(self.layout.nominal), generator=self.generator)
        boundary = self.boundary.clone()  # what was handed out lives on in a batch
        boundary[rows, 0] = self.ranges.pin(draws, self.pinned, self.generator)
        self.boundary = boundary
        return self.ranges.present.apply(draws, self.layout)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("boundary", self.boundary)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the key that the transform writes."""
        observation_spec["boundary"] = Unbounded(shape=self.boundary.shape, dtype=torch.int64)
        return observation_spec
