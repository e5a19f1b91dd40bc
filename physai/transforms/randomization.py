"""Domain randomization: every episode of every robot draws its own physics, actuators and sensors.

After Tobin et al., "Domain Randomization for Transferring Deep Neural Networks from Simulation to the Real World",
2017, and Peng et al., "Sim-to-Real Transfer of Robotic Control with Dynamics Randomization", 2018.
"""

import math
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from physai.config import Config, NonNegativeFloat, PositiveFloat
from physai.physics import ParameterLayout
from physai.transforms.stochastic import StochasticTransform

Operation = Literal["scale", "add", "set"]


class Uniform(Config):
    """Uniform between ``low`` and ``high``."""

    distribution: Literal["uniform"]
    low: float
    high: float
    operation: Operation

    @model_validator(mode="after")
    def _ordered(self) -> "Uniform":
        if self.low > self.high:
            raise ValueError(f": low {self.low} is above high {self.high}")
        return self

    def sample(self, draw: Tensor) -> Tensor:
        """Turn uniform numbers in [0, 1) into draws."""
        return self.low + (self.high - self.low) * draw


class LogUniform(Config):
    """The logarithm is uniform between those of ``low`` and ``high``."""

    distribution: Literal["log_uniform"]
    low: PositiveFloat
    high: PositiveFloat
    operation: Operation

    @model_validator(mode="after")
    def _ordered(self) -> "LogUniform":
        if self.low > self.high:
            raise ValueError(f": low {self.low} is above high {self.high}")
        return self

    def sample(self, draw: Tensor) -> Tensor:
        """Turn uniform numbers in [0, 1) into draws."""
        return torch.exp(math.log(self.low) + math.log(self.high / self.low) * draw)


class Normal(Config):
    """Normal with ``mean`` and ``std``."""

    distribution: Literal["normal"]
    mean: float
    std: NonNegativeFloat
    operation: Operation

    def sample(self, draw: Tensor) -> Tensor:
        """Turn uniform numbers in [0, 1) into draws by inversion, cut at 5 standard deviations."""
        return self.mean + self.std * torch.special.ndtri(draw).clamp(-5.0, 5.0)


Draw = Annotated[Uniform | LogUniform | Normal, Field(discriminator="distribution")]


class RandomizationConfig(Config):
    """One file of ``conf/randomization``: what is drawn for each parameter, or null to leave it as it is."""

    name: str
    link_mass: Draw | None
    payload: Draw | None
    joint_damping: Draw | None
    joint_friction: Draw | None
    effort_limit: Draw | None
    velocity_gain: Draw | None
    actuator_delay: Draw | None
    encoder_offset: Draw | None
    position_noise: Draw | None
    velocity_noise: Draw | None

    @property
    def draws(self) -> dict[str, Draw]:
        """The parameters that are drawn."""
        return {name: draw for name, draw in self if name != "name" and draw is not None}

    def affects(self, *names: str) -> bool:
        """Whether any of these parameters is drawn."""
        return any(name in self.draws for name in names)

    @property
    def max_delay(self) -> int:
        """Longest actuator delay that can be drawn, in control steps."""
        draw = self.actuator_delay
        if draw is None:
            return 0
        return max(0, math.floor((draw.mean + 5 * draw.std if isinstance(draw, Normal) else draw.high) + 0.5))


_LOWEST = {"link_mass": 1e-3, "velocity_gain": 1e-3, "encoder_offset": -math.inf}  # and zero for the others


class DomainRandomization(StochasticTransform):
    """Draws ``physics_parameters`` [N, P] for the rows that are reset; the env applies them, and they stay readable.

    Every column of a parameter draws for itself: each joint has a friction of its own. Values that must not be
    negative are cut at zero (masses and gains just above), delays are rounded to whole control steps.

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
        self._draws = [(layout.columns[name], draw, _LOWEST.get(name, 0.0)) for name, draw in config.draws.items()]

    def sample(self, rows: int) -> Tensor:
        """Draw parameters for so many robots, [rows, P]."""
        draws = torch.rand(rows, len(self.layout.nominal), generator=self.generator)
        parameters = self.layout.nominal.repeat(rows, 1)
        for columns, draw, lowest in self._draws:
            value = draw.sample(draws[:, columns])
            if draw.operation == "scale":
                value *= parameters[:, columns]
            elif draw.operation == "add":
                value += parameters[:, columns]
            parameters[:, columns] = value.clamp_(min=lowest)
        delay = parameters[:, self.layout.columns["actuator_delay"]]
        delay.round_()
        return parameters

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

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset
