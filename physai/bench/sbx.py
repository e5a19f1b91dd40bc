"""SBX: the PPO of Stable-Baselines3 on JAX, with the settings that are fastest for Stable-Baselines3."""

from dataclasses import replace
from typing import Any

from flax import linen
from sbx import PPO

from physai.bench import sb3

_NETWORKS: dict[str, Any] = {"net_arch": [64, 64], "activation_fn": linen.relu}


def _on_jax(settings: sb3.Settings) -> sb3.Settings:
    return replace(settings, algorithm=PPO, arguments=settings.arguments | {"policy_kwargs": _NETWORKS})


TUNED = _on_jax(sb3.TUNED)
TUNED_WITH_FEATURES = _on_jax(sb3.TUNED_WITH_FEATURES)
