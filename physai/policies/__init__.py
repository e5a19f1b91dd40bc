"""Actor and critic networks: TensorDict modules around plain ``torch.nn``."""

from physai.policies.networks import Critic, GaussianActor, input_size

__all__ = ["Critic", "GaussianActor", "input_size"]
