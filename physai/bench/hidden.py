"""Robots whose parameters nobody is told, and what is recorded of them."""

from dataclasses import dataclass

import numpy as np
import torch

from physai.envs.simulation import EnvConfig
from physai.identify.recording import Recording
from physai.physics import ParameterLayout, Physics, RandomizationConfig, RobotState
from physai.robots import RobotSpec
from physai.targets import make

NOISE = 1e-3, 2e-2  # rad, rad/s
PULL = 1.0  # 1/s, with which motions lead home where they shall stay near it


@dataclass(frozen=True)
class Hidden:
    """A robot that was drawn, and a recording of it.

    Attributes:
        spec: What its makers say of it.
        layout: Of its parameters.
        parameters: What it is like, [P].
        delay: Of its actuators, control steps.
        recording: What was seen of it.
    """

    spec: RobotSpec
    layout: ParameterLayout
    parameters: np.ndarray
    delay: int
    recording: Recording

    def itself(self) -> RandomizationConfig:
        """Return a randomization that draws nothing but this robot, with the noise of its sensors."""
        noise = dict(zip(("position_noise", "velocity_noise"), NOISE, strict=True))
        draws = {
            name: {"distribution": "uniform", "low": value, "high": value, "operation": "set"}
            for name, columns in self.layout.columns.items()
            for value in [
                [noise[name]]
                if name in noise
                else [float(self.delay)]
                if name == "actuator_delay"
                else self.parameters[columns].tolist()
            ]
        }
        others = dict.fromkeys(RandomizationConfig.model_fields)  # what this robot has not
        return RandomizationConfig.model_validate({**others, **draws, "name": "hidden"})


def draw(draws: RandomizationConfig, layout: ParameterLayout, seed: int) -> np.ndarray:
    """Return a robot's parameters, [1, P]."""
    drawn: np.ndarray = draws.sample(1, layout, torch.Generator().manual_seed(seed)).double().numpy()
    return drawn


def record(
    config: EnvConfig,
    draws: RandomizationConfig,
    kept: list[str],
    seconds: float,
    seed: int,
    feels: bool = False,
    near: bool = False,
) -> Hidden:
    """Draw a robot, all as described but for the parameters ``kept`` and its delay; let it jerk and rest in turns.

    Args:
        config: Its env, and the engine that it lives in.
        draws: What its parameters are drawn from.
        kept: Names of those that are.
        seconds: How long it moves.
        seed: Draws all of it.
        feels: Whether it tells efforts.
        near: Whether commands stay within those of policies, and lead back towards home while the robot moves. At the
            speeds of a data sheet links hit their limits, and such motions tell little.
    """
    spec = RobotSpec.from_config(config.robot)
    layout = ParameterLayout(spec)
    random = np.random.default_rng(seed)
    drawn = draw(draws, layout, seed)
    delay = int(drawn[0, layout.columns["actuator_delay"]][0])
    for name, columns in layout.columns.items():
        if name not in kept:
            drawn[:, columns] = layout.nominal.double().numpy()[columns]
    steps = round(seconds / config.control_dt)
    fastest = spec.command_limit if near else spec.velocity_limit
    command = jerks(steps, fastest, random)
    physics: Physics = make("physics", config.physics, spec, 1, config.control_dt, needs=("reset", "step", "close"))
    physics.reset(np.arange(1), RobotState(spec.home[None], np.zeros((1, len(spec.home)))), layout.dynamics(drawn))
    effort = np.full((steps, len(spec.home)), np.nan)
    measured = np.array(NOISE)[:, None, None] * random.standard_normal((2, steps, len(spec.home)))
    measured[0] += drawn[0, layout.columns["encoder_offset"]]
    for step in range(steps):
        state = physics.robot_state()
        measured[:, step] += state.joint_position[0], state.joint_velocity[0]
        if feels and state.joint_effort is not None:
            effort[step] = state.joint_effort[0]
        if near and command[step].any():
            command[step] = np.clip(command[step] - PULL * (measured[0, step] - spec.home), -fastest, fastest)
        physics.step(command[max(step - delay, 0)][None])
    physics.close()
    recording = Recording(config.control_dt, measured[0], measured[1], command, effort)
    return Hidden(spec, layout, drawn[0], delay, recording)


def jerks(steps: int, fastest: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Velocity commands [steps, n] up to ``fastest``, with rests of 0.6 s at 50 Hz between motions."""
    command = np.zeros((steps, len(fastest)))
    step = 30
    while step < steps - 100:
        end = step + int(random.integers(60, 120))
        while step < end:
            after = min(step + int(random.integers(4, 25)), end, steps - 40)
            command[step:after] = random.uniform(-1, 1, len(fastest)) * fastest * random.choice([0.3, 1.0])
            step = max(after, step + 1)
        step += 32
    command[steps - 40 :] = 0.0
    return command


def write_table(recording: Recording, joints: tuple[str, ...], path: str) -> None:
    """Write a recording as a CSV."""
    names = [f"{what}[{joint}]" for what in ("position", "velocity", "command", "effort") for joint in joints]
    time = recording.period * np.arange(len(recording))[:, None]
    rows = np.hstack([time, recording.position, recording.velocity, recording.command, recording.effort])
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *names]), comments="", fmt="%.9g")
