"""What a race asks of a learner that is not physai's, and the robots that it gets."""

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from physai.bench.timing import median_speeds
from physai.envs.gym_env import RobotVectorEnv

Array = NDArray[Any]

THREADS = (1, 2)


class Learner(Protocol):
    """An algorithm of a library that learns by itself, some frames at a time.

    Attributes:
        in_keys: What ``act`` is told: ``observation``, and perhaps the task's ``features``.
    """

    in_keys: list[str]

    def learn(self) -> int:
        """Collect and learn; return the frames."""

    def act(self, *seen: Tensor) -> Tensor:
        """Return the actions of the policy's mode [N, n], told what ``in_keys`` name."""

    def close(self) -> None:
        """Free the robots."""


class Settings(Protocol):
    """A learner before it is made."""

    @property
    def horizon(self) -> int:
        """Frames until the learning rate has fallen to its end; 0 leaves it as it is."""

    @property
    def trial(self) -> dict[str, Any]:
        """Arguments for the choice of threads, where a batch takes long."""

    def learner(self, seed: int, threads: int, **changed: Any) -> Learner:
        """Make the learner, with these numbers of torch threads and arguments that differ."""


class RestartingRobots:
    """The robots of a vector env, each of which begins its next episode in the step that ended one.

    Args:
        robots: They belong to this object, and are stepped by it alone.
        features: Whether the task's features follow the observation.
    """

    def __init__(self, robots: RobotVectorEnv, features: bool) -> None:
        self.simulation, self._features = robots.simulation, features
        self._close = robots.close

    def reset(self) -> Array:
        """Start an episode in every row; return what is observed, [N, o]."""
        self.simulation.reset()
        return self.observe()

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Apply actions [N, n].

        Returns:
            What is observed [N, o]; the same before rows began anew; and for each row its reward, and whether its
            episode was terminated and truncated, [N].
        """
        reward, terminated, truncated = (value[:, 0] for value in self.simulation.step(actions))
        last = observation = self.observe()
        if (done := terminated | truncated).any():
            self.simulation.reset(done)
            observation = self.observe()
        return observation, last, reward, terminated, truncated

    def observe(self) -> Array:
        """What is observed now, [N, o]."""
        now = self.simulation
        if not self._features:
            return now.observe()
        sensed = (now.state.joint_position, now.state.joint_velocity, now.goal)
        with torch.no_grad():
            features = now.task.module(*(torch.from_numpy(value).float() for value in sensed))[1].numpy()
        return np.concatenate([now.observe(), features], axis=1)

    def close(self) -> None:
        """Free the simulation."""
        self._close()


def fastest_threads(name: str, settings: Settings) -> int:
    """Measure which number of torch threads learns fastest."""
    trials = [settings.learner(0, threads, **settings.trial) for threads in THREADS]
    speeds = median_speeds(*(trial.learn for trial in trials), rounds=3)
    for trial in trials:
        trial.close()
    threads = THREADS[speeds.index(max(speeds))]
    measured = ", ".join(f"{speed:,.0f}/s with {n}" for n, speed in zip(THREADS, speeds, strict=True))
    print(f"{name}, by torch threads: {measured}; it gets {threads}", flush=True)
    return threads
