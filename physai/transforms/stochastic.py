"""A transform with random numbers of its own, which are part of its state."""

import torch
from torch import Tensor
from torchrl.envs.transforms import Transform


class StochasticTransform(Transform):
    """A transform with a generator of its own: ``TransformedEnv.set_seed`` reaches the base env only.

    The generator's state travels in ``state_dict``.

    Args:
        seed: Seeds the generator.
    """

    def __init__(self, seed: int, **keys: list[str]) -> None:
        super().__init__(**keys)
        self.generator = torch.Generator()
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restart the random numbers."""
        self.generator.manual_seed(seed)

    def get_extra_state(self) -> Tensor:
        """Return the generator's state, for ``state_dict``."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator's state, from ``load_state_dict``."""
        self.generator.set_state(state)
