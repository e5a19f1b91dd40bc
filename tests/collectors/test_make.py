import pytest

from physai.collectors import make_collector
from physai.errors import UserError
from tests.collectors import parts


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames_per_batch": 100}, ["collector.frames_per_batch (100)", "multiple of", "collector.num_envs (16)"]),
        ({"num_envs": 15}, ["collector.num_envs (15)", "multiple of", "collector.processes (2)"]),
        ({"ray_init": parts.RAY, "sync": False}, ["collector.sync must be true", "collector.ray_init"]),
        ({"ray_init": {"adress": "auto"}}, ["'collector.ray_init.adress'", "did you mean 'address'?"]),
    ],
)
def test_what_cannot_be_made_is_an_error_of_one_line(change, words):
    config = parts.config("multi_sync", 16, 160).model_copy(update=change)
    with pytest.raises(UserError) as caught:
        make_collector(config, parts.robots(1, 0), parts.robots, parts.actor(), 1000, 0, 0, parts.CPU)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def random_ones(batches):
    """Which batches hold actions that are no careful policy's."""
    return [bool(batch["action"].abs().max() > 0.5) for batch in batches]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "async", "multi_sync", "multi_async"])
def test_the_first_frames_have_random_actions_and_the_keys_of_all_others(collect, kind):
    batches = [batch.clone() for batch in collect(kind, warmup=200, std=0.01)[0]]
    assert sum(random_ones(batches)) == 2  # whole batches of 128
    assert len({tuple(sorted(map(str, batch.keys(True, True)))) for batch in batches}) == 1
    drawn = next(batch for batch in batches if random_ones([batch])[0])["action"]
    assert abs(drawn.mean()) < 0.15
    assert 0.5 < drawn.std() < 0.65  # of a uniform distribution, 0.58


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "async", "multi_sync", "multi_async"])
def test_random_frames_of_before_a_checkpoint_count_after_it(collect, kind):
    first, *_ = collect(kind, warmup=256, std=0.01)
    batches = iter(first)
    before = [next(batches).clone()]
    state = first.state()
    again, *_ = collect(kind, warmup=256, std=0.01)
    again.set_state(state)
    assert sum(random_ones(before + [batch.clone() for batch in again])) == 2
