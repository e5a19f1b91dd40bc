"""The memory of a policy in its env: what it wrote a step before, and zeros where an episode begins."""

import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import check_env_specs

from physai.collectors import make_collector
from physai.config import validate
from physai.envs.make import make_env
from physai.training.config import TrainConfig
from physai.transforms import Memory
from tests.composed import composed

SIZE = 3


class Counting(TensorDictModuleBase):
    """Counts the steps of its episode in its memory."""

    in_keys = ("memory",)
    out_keys = ("action", "new_memory")

    def forward(self, tensordict):
        memory = tensordict.get("memory")
        tensordict.set("action", torch.rand(len(memory), 2) * 2 - 1)
        return tensordict.set("new_memory", memory + 1.0)


@pytest.fixture
def robots(env_config):
    """Make envs whose episodes end now and then, and are over after the test."""
    made = []
    node = composed("randomization=strong", "env.task.tolerance=0.1", "env.task.max_steps=13")
    config = validate(TrainConfig, node)

    def make(num_envs=16, seed=0, memory_size=SIZE):
        parts = config.env, config.randomization, config.normalization
        made.append(make_env(*parts, num_envs, seed, memory_size))
        return made[-1]

    make.config = config
    yield make
    for env in made:
        env.close()


def is_count(memory, length):
    assert torch.equal(memory, length.float().expand(memory.shape))
    return True


def test_it_is_what_the_policy_wrote_and_zero_where_an_episode_begins(robots):
    rollout = robots().rollout(60, Counting(), break_when_any_done=False)
    assert rollout["next", "terminated"].any()
    assert rollout["next", "truncated"].any()
    assert is_count(rollout["memory"], rollout["episode_length"])
    assert is_count(rollout["next", "memory"], rollout["next", "episode_length"])


def test_it_goes_on_from_batch_to_batch_and_from_a_saved_state(robots):
    size = robots.config.collector.model_copy(update={"num_envs": 16, "frames_per_batch": 80})

    def collector():
        env = robots()
        return make_collector(size, env, robots, Counting(), 800, 0, 0, torch.device("cpu"))

    first, batches = collector(), []
    source = iter(first)
    for _ in range(3):
        batches.append(next(source).clone())
    state = first.state()
    batches.append(next(source))
    for batch in batches:
        assert is_count(batch["memory"], batch["episode_length"])
    assert (batches[1]["memory"][:, 0] > 0).any()
    second = collector()
    second.set_state(state)
    assert torch.equal(next(iter(second))["memory"], batches[-1]["memory"])


def test_a_reset_of_some_rows_leaves_the_memory_of_the_others(robots):
    env, policy = robots(), Counting()
    tensordict = env.reset()
    for _ in range(4):
        tensordict = env.step(policy(tensordict))["next"]
    mask = (torch.arange(16) % 3 == 0)[:, None]
    memory = env.reset(tensordict.set("_reset", mask))["memory"]
    assert torch.equal(memory, tensordict["memory"] * ~mask)
    assert (memory[~mask[:, 0]] > 0).all()


def test_specs_hold_with_a_memory(robots):
    env = robots()
    check_env_specs(env)
    assert env.observation_spec["memory"].shape == (16, SIZE)


def test_policies_that_remember_nothing_pay_nothing(robots):
    env = robots(memory_size=0)
    assert not any(isinstance(transform, Memory) for transform in env.transform)
    assert "memory" not in env.reset()
