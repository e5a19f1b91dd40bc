import itertools
import os
import signal
import threading
import time

import pytest
import torch

from physai.errors import UserError
from tests.collectors import parts

KINDS = pytest.mark.parametrize("kind", ["async", "multi_async"])


def goes_on(before, after):
    """Whether a batch begins where another ended: its robots are in the middle of the same episodes."""
    same = (before["next", "observation"][:, -1] == after["observation"][:, 0]).all(dim=-1)
    return bool((same | before["next", "done"][:, -1, 0]).all() and same.any())


def learn(source, actor, normalization, batches=None):
    """Take batches as a learner does who changes the policy in a way that shows what it has learnt from."""
    taken = []
    for batch in itertools.islice(source, batches):
        taken.append(batch.clone())
        normalization.update(batch["observation"])
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.01 * batch["action"].mean())
    return taken


@pytest.mark.slow
def test_batches_are_whole_and_processes_take_turns(collect):
    source, *_ = collect("multi_async", total=1000)
    batches = [batch.clone() for batch in source]
    assert [batch.shape for batch in batches] == [(4, 32)] * 8  # 128 frames each, of one process' robots
    assert all(goes_on(before, after) for before, after in zip(batches, batches[2:], strict=False))
    goals = {tuple(goal.tolist()) for batch in batches[:2] for goal in batch["goal"][:, 0]}
    assert len(goals) == 8  # no two robots alike


@pytest.mark.slow
def test_the_same_seed_gives_the_same_batches_whoever_is_faster(collect):
    runs = []
    for late in (0, 1):
        source, actor, normalization = collect("multi_async", seed=5)
        slow = source.procs[late].pid
        os.kill(slow, signal.SIGSTOP)
        threading.Timer(0.3, os.kill, (slow, signal.SIGCONT)).start()
        runs.append(learn(source, actor, normalization))
    assert len(runs[0]) == 8
    for one, other in zip(*runs, strict=True):
        parts.assert_equal(one, other)


@pytest.mark.slow
@KINDS
def test_one_set_of_weights_and_statistics_holds_for_a_whole_batch_and_misses_an_update_per_process(collect, kind):
    source, actor, normalization = collect(kind, total=2048)
    past = []
    for number, batch in enumerate(source):
        past.append((actor.state_dict(), normalization.normalizer.state_dict()))
        past[-1] = tuple({name: value.clone() for name, value in state.items()} for state in past[-1])
        now, fitting = past[-1], []
        for version, (weights, statistics) in enumerate(past):
            actor.load_state_dict(weights)
            normalization.normalizer.load_state_dict(statistics)
            seen = torch.equal(batch["normalized_observation"], normalization.normalizer(batch["observation"]))
            expected = actor.get_dist(batch).log_prob(batch["latent_action"])
            if seen and torch.allclose(batch["action_log_prob"], expected, rtol=0, atol=1e-5):
                fitting.append(version)
        actor.load_state_dict(now[0])
        normalization.normalizer.load_state_dict(now[1])
        assert fitting == [max(0, number - parts.KINDS[kind]["processes"])]
        normalization.update(batch["observation"])
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.05)
    assert number == 15


@pytest.mark.slow
def test_asking_for_the_state_loses_no_frame(collect):
    source, *_ = collect("multi_async")
    batches = []
    for batch in source:
        batches.append(batch.clone())
        source.state()
    assert len(batches) == 8
    assert all(goes_on(before, after) for before, after in zip(batches, batches[2:], strict=False))


@pytest.mark.slow
@KINDS
def test_a_loop_that_is_left_goes_on_in_the_next_as_if_it_had_not_been(collect, kind):
    expected = learn(*collect(kind, seed=4))
    source, actor, normalization = collect(kind, seed=4)
    batches = learn(source, actor, normalization, batches=3) + learn(source, actor, normalization)
    assert len(batches) == 8
    for one, same in zip(expected, batches, strict=True):
        parts.assert_equal(one, same)


@pytest.mark.slow
@KINDS
def test_state_continues_bit_for_bit_in_new_processes(collect, kind):
    expected = learn(*collect(kind, seed=3))
    source, actor, normalization = collect(kind, seed=3)
    learn(source, actor, normalization, batches=3)
    state, weights, statistics = source.state(), actor.state_dict(), normalization.state_dict()
    assert state["frames"] == 3 * 128
    other, actor, normalization = collect(kind, seed=99)
    actor.load_state_dict(weights)
    normalization.load_state_dict(statistics)
    other.set_state(state)
    rest = learn(other, actor, normalization)
    assert len(rest) == 5
    for one, same in zip(expected[3:], rest, strict=True):
        parts.assert_equal(one, same)


@pytest.mark.slow
def test_a_killed_worker_ends_collection_with_an_error_and_takes_the_others_along(collect):
    source, *_ = collect("multi_async", total=10**9)
    batches = iter(source)
    next(batches)
    os.kill(source.procs[1].pid, signal.SIGKILL)
    started = time.monotonic()
    with pytest.raises(UserError, match="exit code -9"):
        list(batches)
    source.shutdown()
    assert time.monotonic() - started < 20


@pytest.mark.slow
def test_a_worker_that_is_gone_when_it_is_asked_for_its_state_is_an_error_of_one_line(collect):
    source, *_ = collect("multi_async", total=10**9)
    next(iter(source))
    os.kill(source.procs[0].pid, signal.SIGKILL)
    source.procs[0].join()
    with pytest.raises(UserError, match="a process that collects has ended"):
        source.state()
