from multiprocessing import active_children

import pytest

from physai.transforms import RunningStatistics
from tests.collectors import parts


@pytest.fixture(autouse=True)
def one_mode(monkeypatch):
    """Whether Ray asks for tokens: a process remembers that from its first cluster on, and refuses those of others."""
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")


@pytest.fixture
def collect():
    """Make a collector that ends with the test; return it, its policy and the learner's statistics."""
    made = []

    def build(kind, seed=0, total=1024, warmup=0, std=1.0):
        policy, env = parts.actor(std), parts.robots(8 if kind == "single" else 1, seed)
        made.append((parts.source(kind, policy, env, total, seed, warmup), env))
        return made[-1][0], policy, RunningStatistics(env.normalizer, 0.01)

    yield build
    for collector, env in made:
        collector.shutdown()
        env.close()
    assert not active_children()
