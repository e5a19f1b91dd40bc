"""Algorithms from configs, as training puts them together."""

from hydra.utils import instantiate

from physai.algorithms import Networks
from physai.transforms.normalization import Normalizer


def assemble(node, actor, critic, frames_per_batch, normalizer=None, mirror=None):
    networks = Networks(actor, critic, normalizer or Normalizer(8, 10.0), lambda: mirror)
    return instantiate(node, _partial_=True, _convert_="all")(networks=networks, frames_per_batch=frames_per_batch)
