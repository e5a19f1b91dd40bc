"""What can be stressed: the parameters of the randomization, of the task, of the robot and of its engine."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from physai.config import Config, nearest
from physai.envs.simulation import EnvConfig
from physai.errors import UserError
from physai.physics import ParameterLayout, RandomizationConfig
from physai.physics.randomization import Draw, Normal, Uniform
from physai.robots import RobotSpec

_WHOLE = ("actuator_delay",)


def _ordered(ends: list[float]) -> list[float]:
    if not 0 <= ends[0] < ends[1]:
        raise ValueError(f": the first of {ends} must be below the second, and none below zero")
    return ends


class AxisConfig(Config):
    """How an axis acts, and from where to where it goes."""

    operation: Literal["scale", "add", "set"]
    range: Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


@dataclass(frozen=True)
class Axis:
    """One parameter that is given values.

    Attributes:
        name: Of the parameter.
        operation: ``scale`` multiplies what the robot's description says, ``add`` is added to it, ``set`` replaces it.
        low: Lowest value.
        high: Highest value.
    """

    name: str
    operation: Literal["scale", "add", "set"]
    low: float
    high: float

    @classmethod
    def make(cls, name: str, axes: dict[str, AxisConfig], config: EnvConfig) -> "Axis":
        """Return the axis of a name for an env.

        Raises:
            UserError: If there is none, or the env has nothing of the kind.
        """
        if name not in axes:
            raise UserError(f"there is no axis '{name}'{nearest(name, axes)}")
        axis = cls(name, axes[name].operation, *axes[name].range)
        robot = RobotSpec.from_config(config.robot)
        if axis.randomizes and name not in ParameterLayout(robot).columns:
            raise UserError(f"the axis '{name}' is not one of robot '{robot.name}', which has no such parameter")
        if name in config.ignored:
            engine = config.physics["_target_"].rpartition(".")[2]
            raise UserError(f"the axis '{name}' needs another engine: {engine} cannot change it")
        if name == "motor_time_constant" and config.physics.get("motor") != "servo":
            raise UserError(f"the axis '{name}' needs physics=mujoco physics.motor=servo")
        if axis.whole and not (float(axis.low).is_integer() and float(axis.high).is_integer()):
            raise UserError(f"axes.{name}.range: whole control steps are needed, not {[axis.low, axis.high]}")
        if axis.operation == "scale" and axis.low == 0:
            raise UserError(f"axes.{name}.range: a scale must be above zero")
        if not axis.low <= axis.nominal(config) <= axis.high:
            raise UserError(f"axes.{name}.range: {axis.nominal(config):g}, the robot as described, must be within")
        return axis

    @property
    def whole(self) -> bool:
        """Whether its values are whole numbers."""
        return self.name in _WHOLE

    @property
    def randomizes(self) -> bool:
        """Whether it is one of the parameters that randomization draws."""
        return self.name in RandomizationConfig.model_fields

    def nominal(self, config: EnvConfig) -> float:
        """The value of a robot as it is described."""
        if self.name == "motor_time_constant":
            return float(config.physics.get("motor_time_constant", self.low))
        return 1.0 if self.operation == "scale" else 0.0

    def values(self, count: int) -> np.ndarray:
        """So many values from end to end, evenly; scales by their logarithm, whole numbers each once."""
        spread = np.geomspace if self.operation == "scale" else np.linspace
        values = spread(self.low, self.high, count)
        return np.unique(values.round()) if self.whole else values

    def between(self, one: float, other: float) -> float:
        """The middle of two values, in the same sense."""
        if self.operation == "scale":
            return float(np.sqrt(one * other))
        return float(np.floor((one + other) / 2)) if self.whole else (one + other) / 2

    def trained(self, randomization: RandomizationConfig, config: EnvConfig) -> tuple[float, float]:
        """From where to where its values were in training; a normal distribution counts up to two deviations."""
        draw: Draw | None = getattr(randomization, self.name, None)
        nominal = self.nominal(config)
        if draw is None:
            return nominal, nominal
        if isinstance(draw, Normal):
            return max(draw.mean - 2 * draw.std, nominal), draw.mean + 2 * draw.std
        return float(np.min(draw.low)), float(np.max(draw.high))

    def draw(self, value: float) -> Uniform:
        """What makes randomization give every robot this value."""
        return Uniform(distribution="uniform", low=float(value), high=float(value), operation=self.operation)

    def change(self, config: EnvConfig, value: float) -> EnvConfig:
        """The env with this value, as far as its config says it."""
        if self.name == "speed":
            limit = [value * each for each in config.robot.command_limit]
            return config.model_copy(update={"robot": config.robot.model_copy(update={"command_limit": limit})})
        if self.name == "motor_time_constant":
            return config.model_copy(update={"physics": config.physics | {"motor_time_constant": float(value)}})
        return config
