"""The distribution that exploration draws from, in as few operations as learning takes."""

import math
from typing import Any, ClassVar

from torch import Tensor
from torch.distributions import Distribution

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class DiagonalNormal(Distribution):
    """A normal distribution of independent components whose deviations are the same in all rows.

    ``Independent(Normal(mean, std), 1)`` says the same in more operations; a test holds the two against each
    other.

    Args:
        mean: [.., n].
        log_std: Logarithm of the standard deviations, [n].
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(self, mean: Tensor, log_std: Tensor) -> None:
        super().__init__(mean.shape[:-1], mean.shape[-1:], validate_args=False)
        self._mean, self._log_std = mean, log_std

    @property
    def mean(self) -> Tensor:
        """[.., n]."""
        return self._mean

    def log_prob(self, value: Tensor) -> Tensor:
        """Logarithm of the density at values [.., n]: [..]."""
        scaled = (value - self._mean) * (-self._log_std).exp()
        return -0.5 * scaled.square().sum(-1) - self._log_scale(HALF_LOG_TWO_PI)

    def entropy(self) -> Tensor:
        """Differential entropy of each row: [..]."""
        return self._log_scale(HALF_LOG_TWO_PI + 0.5).expand(self.batch_shape)

    def _log_scale(self, of_each: float) -> Tensor:
        return self._log_std.sum() + of_each * self._log_std.shape[-1]
