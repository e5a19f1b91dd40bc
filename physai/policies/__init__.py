"""Actor and critic networks: TensorDict modules around plain ``torch.nn``."""

from physai.policies.networks import Critic, GaussianActor, ResidualActor, input_size
from physai.policies.recurrent import GRUActor, HistoryActor
from physai.policies.squashed import DeterministicActor, TanhGaussianActor

__all__ = [
    "Critic",
    "DeterministicActor",
    "GRUActor",
    "GaussianActor",
    "HistoryActor",
    "ResidualActor",
    "TanhGaussianActor",
    "input_size",
]
