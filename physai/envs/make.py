"""The one place where an environment and its transforms are put together."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from physai.compose import compose
from physai.config import Config, PositiveFloat, validate
from physai.envs.robot_env import RobotEnv
from physai.envs.simulation import EnvConfig, Simulation
from physai.physics import RandomizationConfig
from physai.seeding import derive
from physai.transforms import (
    DomainRandomization,
    GrowingRandomization,
    ImuModel,
    Memory,
    Normalizer,
    Observation,
    ObservationNormalization,
    Ranges,
    SensorModel,
)
from physai.transforms.stochastic import StochasticTransform


class NormalizationConfig(Config):
    """How observations are normalized."""

    eps: PositiveFloat
    clip: PositiveFloat


class TransformedRobotEnv(TransformedEnv):
    """A RobotEnv with its transforms: seeded as one, and with a state that restores it bit for bit."""

    @property
    def simulation(self) -> Simulation:
        """The robots."""
        return self.base_env.simulation

    @property
    def normalizer(self) -> Normalizer:
        """What normalizes observations."""
        return self.normalization.normalizer

    @property
    def normalization(self) -> ObservationNormalization:
        """The transform that holds it."""
        return next(t for t in self.transform if isinstance(t, ObservationNormalization))

    @property
    def ranges(self) -> Ranges | None:
        """From where to where robots are drawn now, where a curriculum lets that grow."""
        return next((t.ranges for t in self.transform if isinstance(t, GrowingRandomization)), None)

    @property
    def learned(self) -> dict[str, nn.Module]:
        """What a learner renews between two batches."""
        ranges = self.ranges
        return {"normalizer": self.normalizer} | ({} if ranges is None else {"ranges": ranges})

    def adopt(self, learned: Any) -> None:
        """Use, of what a learner renews, somebody else's."""
        self.normalization.normalizer = learned["normalizer"]
        for transform in self.transform:
            if isinstance(transform, GrowingRandomization):
                transform.ranges = learned["ranges"]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        inner = tensordict
        for transform in reversed(self.transform):
            if transform.in_keys_inv:
                inner = transform._inv_call(inner.copy())
        after = self.base_env._step(inner)
        for transform in self.transform:
            after = transform._step(tensordict, after)
        return after

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step all robots, and reset those that are done.

        The same as TorchRL's, which also serves nested, stateful and partly stepping envs, at half its cost; a test
        holds the two against each other.
        """
        after = self._step(tensordict)
        tensordict.set("next", after)
        done = after.get("done")
        if not done.any():
            return tensordict, after.exclude("reward")
        fresh = self._reset(TensorDict({"_reset": done}, self.batch_size))
        # Sensors answer anew in every row; those that go on keep what they have seen.
        for transform in self.transform:
            for key in transform.out_keys:
                fresh.set(key, torch.where(done, fresh.get(key), after.get(key)))
        return tensordict, fresh

    def fake_tensordict(self) -> TensorDictBase:
        """Return what a step of a rollout holds, all zeros.

        The same as TorchRL's, which imports pandas for it: a third of a second of each process that collects.
        """

        def zeros(*specs: Composite) -> TensorDict:
            leaves = {key: leaf.zero() for spec in specs for key, leaf in spec.items(True, True)}
            return TensorDict(leaves, self.batch_size)

        seen, ends = self.observation_spec, self.full_done_spec
        step = zeros(self.state_spec, self.full_action_spec, seen, ends)
        step["next"] = zeros(seen, self.full_reward_spec, ends)
        made: TensorDictBase = self.transform.transform_fake_tensordict(step.to(self.device))
        return made

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seed goals and starts, and each transform with a seed of its own."""
        seed = 0 if seed is None else seed
        self.simulation.seed(derive(seed, "task"))
        for transform in self.transform:
            if isinstance(transform, StochasticTransform):
                transform.seed(derive(seed, type(transform).__name__))
        return seed if static_seed else seed + 1

    def state(self) -> dict[str, dict[str, Tensor]]:
        """Return the state of robots, episodes, transforms and random numbers."""
        return {
            "simulation": self.simulation.snapshot(),
            "transforms": {k: v.clone() for k, v in self.transform.state_dict().items()},
        }

    def set_state(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Restore what ``state`` returned, in an env made from the same config."""
        self.simulation.restore(state["simulation"])
        self.transform.load_state_dict(state["transforms"])


def make_env(
    env: EnvConfig,
    randomization: RandomizationConfig,
    normalization: NormalizationConfig,
    num_envs: int,
    seed: int,
    memory_size: int = 0,
    pinned: float | None = None,
) -> TransformedRobotEnv:
    """Put N robots, their randomization, sensors, observation and its normalization together.

    Args:
        env: Robot and task.
        randomization: What differs from robot to robot and from episode to episode.
        normalization: How observations are normalized.
        num_envs: N.
        seed: Seeds every source of randomness in the env.
        memory_size: How many numbers the policy remembers from step to step.
        pinned: With a curriculum, the share of episodes on a boundary of its ranges, which begin narrow; None: without.
    """
    base = RobotEnv(env, num_envs)
    layout = base.simulation.layout
    transforms: list[Transform] = []
    if pinned is not None:
        transforms.append(GrowingRandomization(Ranges(randomization, layout), pinned, layout, num_envs, 0))
    elif randomization.draws:
        transforms.append(DomainRandomization(randomization, layout, num_envs, 0))
    if randomization.affects("encoder_offset", "position_noise", "velocity_noise"):
        transforms.append(SensorModel(layout, 0))
    if base.simulation.spec.floating is not None and randomization.affects("gyro_noise", "gravity_noise"):
        transforms.append(ImuModel(layout, 0))
    transforms.append(Observation(base.simulation.task.module))
    made = TransformedRobotEnv(base, Compose(*transforms))
    size = made.observation_spec["observation"].shape[-1]
    made.append_transform(ObservationNormalization(Normalizer(size, normalization.clip)))
    if memory_size:
        made.append_transform(Memory(memory_size, num_envs))
    made.set_seed(seed)
    return made


def make(
    name: str = "reacher", num_envs: int = 64, seed: int = 0, overrides: Sequence[str] = ()
) -> TransformedRobotEnv:
    """Compose a config and make its env, for notebooks; also ``physai.make_env``.

    Args:
        name: A file of ``conf/env``.
        num_envs: N.
        seed: Seeds every source of randomness in the env.
        overrides: Hydra overrides such as ``randomization=strong`` or ``env.task.max_steps=100``.

    Raises:
        UserError: If an override is wrong; the message names the nearest right one.
    """
    node = compose("train", [f"env={name}", *overrides])
    return make_env(
        validate(EnvConfig, node.env),
        validate(RandomizationConfig, node.randomization),
        validate(NormalizationConfig, node.normalization),
        num_envs,
        seed,
    )
