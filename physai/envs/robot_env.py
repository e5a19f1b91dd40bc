"""The TorchRL shell: N robots as one natively batched environment."""

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from physai.envs.simulation import EnvConfig, Simulation

_PRIVILEGED = ("physics_parameters", "relative_parameters", "past_actions")
_OBSERVED = (*_PRIVILEGED, "success", "episode_length", "episode_rewards")


class RobotEnv(EnvBase):
    """N robots at a task, ``batch_size=[N]``.

    It speaks of what a robot senses and a task asks (:attr:`Simulation.sensed`) and leaves what a policy sees to the
    transforms. Beside them: ``physics_parameters`` (see :class:`physai.physics.ParameterLayout`; read at reset, when
    given), ``relative_parameters`` (the same for networks), ``past_actions``, ``success``,
    ``episode_length`` and ``episode_rewards`` (one column a term of the reward); and of a base that floats
    ``base_velocity`` (m/s, in its own frame), which no sensor tells. Only the rows of ``_reset`` are reset.

    Args:
        config: The environment.
        num_envs: Number of robots, N.
        seed: Seeds goals and start poses.
    """

    def __init__(self, config: EnvConfig, num_envs: int, seed: int = 0) -> None:
        super().__init__(device=None, batch_size=[num_envs])  # a device would be checked and cast to at every step
        self.simulation = Simulation(config, num_envs, seed)
        joints = len(self.simulation.spec.joints)

        def unbounded(size: int, dtype: torch.dtype = torch.float32) -> Unbounded:
            return Unbounded(shape=(num_envs, size), dtype=dtype)

        self.observation_spec = Composite(
            **{signal.name: Unbounded(shape=(num_envs, *signal.shape)) for signal in self.simulation.sensed},
            **{name: unbounded(value.shape[1]) for name, value in self.simulation.true_base().items()},
            physics_parameters=unbounded(len(self.simulation.layout.nominal)),
            relative_parameters=unbounded(len(self.simulation.layout.nominal)),
            past_actions=unbounded(self.simulation.past_actions.shape[1]),
            success=Binary(1, shape=(num_envs, 1), dtype=torch.bool),
            episode_length=unbounded(1, torch.int64),
            episode_rewards=unbounded(len(self.simulation.reward_terms)),
            shape=[num_envs],
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(num_envs, joints), dtype=torch.float32)
        self.reward_spec = unbounded(1)
        self.done_spec = Composite(
            {key: Binary(1, shape=(num_envs, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")},
            shape=[num_envs],
        )

    def _observe(self) -> dict[str, torch.Tensor]:
        simulation = self.simulation
        sensed, true = simulation.sense(), simulation.true_base()
        return {
            **{name: torch.from_numpy(value.astype(np.float32)) for name, value in (sensed | true).items()},
            **{key: torch.from_numpy(getattr(simulation, key)) for key in _OBSERVED},
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        rows = parameters = None
        if tensordict is not None:
            mask, given = tensordict.get("_reset", None), tensordict.get("physics_parameters", None)
            rows = None if mask is None else mask[:, 0].numpy()
            parameters = None if given is None else given.numpy()
        self.simulation.reset(rows, parameters)
        done = {key: torch.zeros(self.num_robots, 1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        return TensorDict({**self._observe(), **done}, batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        reward, terminated, truncated = self.simulation.step(tensordict.get("action").detach().numpy())
        results = {"reward": reward, "done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        after = {key: torch.from_numpy(value) for key, value in results.items()}
        return TensorDict({**self._observe(), **after}, batch_size=self.batch_size)

    @property
    def num_robots(self) -> int:
        """N."""
        return self.batch_size[0]

    def _set_seed(self, seed: int | None) -> None:
        self.simulation.seed(0 if seed is None else seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the physics engine."""
        super().close(raise_if_closed=raise_if_closed)
        self.simulation.close()
