"""Domain randomization: every episode of every robot draws its own physics, actuators and sensors.

After Tobin et al., "Domain Randomization for Transferring Deep Neural Networks from Simulation to the Real World",
2017, and Peng et al., "Sim-to-Real Transfer of Robotic Control with Dynamics Randomization", 2018.
"""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from physai.physics import ParameterLayout, RandomizationConfig
from physai.transforms.stochastic import StochasticTransform


class DomainRandomization(StochasticTransform):
    """Draws ``physics_parameters`` [N, P] for the rows that are reset; the env applies them, and they stay readable.

    Args:
        config: What to draw.
        layout: Columns of ``physics_parameters`` and the robot's nominal values, which operations start from.
        num_envs: N.
        seed: Seeds the draws.
    """

    def __init__(self, config: RandomizationConfig, layout: ParameterLayout, num_envs: int, seed: int) -> None:
        super().__init__(seed)
        self.config = config
        self.layout = layout
        self.num_envs = num_envs

    def sample(self, rows: int) -> Tensor:
        """Draw parameters for so many robots, [rows, P]."""
        return self.config.sample(rows, self.layout, self.generator)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=[self.num_envs])
        mask = tensordict.get("_reset", None)
        rows = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask[:, 0]
        parameters = torch.zeros(self.num_envs, len(self.layout.nominal))
        parameters[rows] = self.sample(int(rows.sum()))
        return tensordict.set("physics_parameters", parameters)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict
