"""How robots differ: what is drawn for each of their ``physics_parameters``."""

import math
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from physai.config import Config, NonNegativeFloat, PositiveFloat
from physai.errors import UserError
from physai.physics.parameters import ParameterLayout

Operation = Literal["scale", "add", "set"]


class Uniform(Config):
    """Uniform between ``low`` and ``high``: the same for each column of a parameter, or lists of one value each."""

    distribution: Literal["uniform"]
    low: float | Annotated[list[float], Field(min_length=1)]
    high: float | Annotated[list[float], Field(min_length=1)]
    operation: Operation

    @model_validator(mode="after")
    def _ordered(self) -> "Uniform":
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        if low.shape != high.shape:
            raise ValueError(f": low {self.low} and high {self.high} must have as many values")
        if (low > high).any():
            raise ValueError(f": low {self.low} is above high {self.high}")
        return self

    @property
    def columns(self) -> int | None:
        """Of how many columns it speaks; None for any number."""
        return len(self.low) if isinstance(self.low, list) else None

    def sample(self, draw: Tensor) -> Tensor:
        """Turn uniform numbers in [0, 1) into draws."""
        low, high = torch.tensor(self.low, dtype=torch.float64), torch.tensor(self.high, dtype=torch.float64)
        return low.float() + (high - low).float() * draw


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


_LOWEST = {
    "link_mass": 1e-3,
    "velocity_gain": 1e-3,
    "stiffness": 1e-3,
    "contact_time": 1e-3,  # engines may have more
    "center_of_mass": -math.inf,
    "encoder_offset": -math.inf,
}  # and zero for the others


class RandomizationConfig(Config):
    """One file of ``conf/randomization``: what is drawn for each parameter, or null to leave it as it is.

    What a robot does not have, such as an arm on its pedestal a friction with the floor, is not drawn for it.
    """

    name: str
    link_mass: Draw | None
    payload: Draw | None
    joint_damping: Draw | None
    joint_friction: Draw | None
    effort_limit: Draw | None
    armature: Draw | None
    velocity_gain: Draw | None
    stiffness: Draw | None
    servo_damping: Draw | None
    floor_friction: Draw | None
    contact_time: Draw | None
    center_of_mass: Draw | None
    actuator_delay: Draw | None
    encoder_offset: Draw | None
    position_noise: Draw | None
    velocity_noise: Draw | None
    gyro_noise: Draw | None
    gravity_noise: Draw | None
    push: Draw | None

    @classmethod
    def none(cls) -> "RandomizationConfig":
        """Return what leaves everything as it is."""
        return cls.model_validate({**dict.fromkeys(cls.model_fields), "name": "none"})

    @property
    def draws(self) -> dict[str, Draw]:
        """The parameters that are drawn, of robots that have them."""
        return {name: draw for name, draw in self if name != "name" and draw is not None}

    def of(self, layout: ParameterLayout) -> "RandomizationConfig":
        """Return what is drawn of it for a robot in its engine."""
        others = {name: None for name in self.draws if name not in layout.columns or name in layout.ignored}
        return self.model_copy(update=others) if others else self

    def affects(self, *names: str) -> bool:
        """Whether any of these parameters is drawn."""
        return any(name in self.draws for name in names)

    def without_effect(self, layout: ParameterLayout) -> dict[str, str]:
        """Name the parameters whose draw changes nothing, and say why."""
        zero = "it scales what is zero in the robot's description, unless its YAML gives some"
        scaled = {
            name: zero
            for name, draw in self.of(layout).draws.items()
            if draw.operation == "scale" and not layout.nominal[layout.columns[name]].any()
        }
        ignored = [name for name in layout.ignored if name in layout.columns and name in self.draws]
        return scaled | dict.fromkeys(ignored, "this engine cannot change it")

    def check(self, layout: ParameterLayout) -> None:
        """Raise a UserError if a list has not one value for each column of its parameter."""
        for name, draw in self.of(layout).draws.items():
            needed = layout.labels[layout.columns[name]]
            if isinstance(draw, Uniform) and draw.columns not in (None, len(needed)):
                raise UserError(f"randomization.{name}: {draw.columns} values, and there are {', '.join(needed)}")

    def sample(self, rows: int, layout: ParameterLayout, generator: torch.Generator) -> Tensor:
        """Draw ``physics_parameters`` for so many robots, [rows, P], starting from the robot's nominal values.

        Every column of a parameter draws for itself: each joint has a friction of its own. Values that must not be
        negative are cut at zero (masses and gains just above), delays are rounded to whole control steps.
        """
        return self.apply(torch.rand(rows, len(layout.nominal), generator=generator), layout)

    def apply(self, draws: Tensor, layout: ParameterLayout) -> Tensor:
        """Turn uniform numbers in [0, 1], one a column, into ``physics_parameters``, [rows, P]; see ``sample``."""
        parameters = layout.nominal.repeat(len(draws), 1)
        for name, draw in self.of(layout).draws.items():
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
