"""How robots differ: what is drawn for each of their ``physics_parameters``."""

import math
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from physai.config import Config, NonNegativeFloat, PositiveFloat
from physai.physics.parameters import ParameterLayout

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


_LOWEST = {"link_mass": 1e-3, "velocity_gain": 1e-3, "encoder_offset": -math.inf}  # and zero for the others


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

    @classmethod
    def none(cls) -> "RandomizationConfig":
        """Return what leaves everything as it is."""
        return cls.model_validate({**dict.fromkeys(cls.model_fields), "name": "none"})

    @property
    def draws(self) -> dict[str, Draw]:
        """The parameters that are drawn."""
        return {name: draw for name, draw in self if name != "name" and draw is not None}

    def affects(self, *names: str) -> bool:
        """Whether any of these parameters is drawn."""
        return any(name in self.draws for name in names)

    def without_effect(self, layout: ParameterLayout) -> list[str]:
        """Name the parameters whose draw changes nothing: a scale of what is zero in the robot's description."""
        return [
            name
            for name, draw in self.draws.items()
            if draw.operation == "scale" and not layout.nominal[layout.columns[name]].any()
        ]

    def sample(self, rows: int, layout: ParameterLayout, generator: torch.Generator) -> Tensor:
        """Draw ``physics_parameters`` for so many robots, [rows, P], starting from the robot's nominal values.

        Every column of a parameter draws for itself: each joint has a friction of its own. Values that must not be
        negative are cut at zero (masses and gains just above), delays are rounded to whole control steps.
        """
        draws = torch.rand(rows, len(layout.nominal), generator=generator)
        parameters = layout.nominal.repeat(rows, 1)
        for name, draw in self.draws.items():
            columns = layout.columns[name]
            value = draw.sample(draws[:, columns])
            if draw.operation == "scale":
                value *= parameters[:, columns]
            elif draw.operation == "add":
                value += parameters[:, columns]
            parameters[:, columns] = value.clamp_(min=_LOWEST.get(name, 0.0))
        delay = parameters[:, layout.columns["actuator_delay"]]
        delay.round_()
        return parameters
