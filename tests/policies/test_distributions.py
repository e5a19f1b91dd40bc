"""The lean distribution against torch's."""

import torch
from torch.distributions import Independent, Normal

from physai.policies.distributions import DiagonalNormal


def test_density_entropy_and_their_gradients_are_those_of_torch_s_distribution():
    torch.manual_seed(0)
    mean, log_std = torch.randn(7, 5, 3, requires_grad=True), torch.randn(3, requires_grad=True)
    value, weight = torch.randn(7, 5, 3), torch.randn(7, 5)
    results = []
    for distribution in (DiagonalNormal(mean, log_std), Independent(Normal(mean, log_std.exp().expand_as(mean)), 1)):
        density, entropy = distribution.log_prob(value), distribution.entropy()
        gradients = torch.autograd.grad((weight * (density + 0.3 * entropy)).sum(), [mean, log_std])
        results.append((distribution.mean, density, entropy, *gradients))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_it_says_what_it_is():
    assert repr(DiagonalNormal(torch.zeros(2, 3), torch.zeros(3))) == "DiagonalNormal()"
