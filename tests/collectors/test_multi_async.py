import os
import signal
import time

import pytest
import torch

from physai.errors import UserError


def goes_on(before, after):
    """Whether a batch begins where another ended: its robots are in the middle of the same episodes."""
    same = (before["next", "observation"][:, -1] == after["observation"][:, 0]).all(dim=-1)
    return bool((same | before["next", "done"][:, -1, 0]).all() and same.any())


def test_batches_are_whole_and_each_goes_on_where_its_robots_were(collect):
    source, *_ = collect("multi_async", total=1000)
    batches = [batch.clone() for batch in source]
    assert [batch.shape for batch in batches] == [(4, 32)] * 8  # 128 frames each, of one process' robots
    last = []
    for batch in batches:
        of_these = [other for other in last if goes_on(other, batch)]
        last = [other for other in last if all(other is not one for one in of_these)] + [batch]
        assert len(of_these) <= 1
        assert len(last) <= 2  # as many as there are processes
    assert len({tuple(goal.tolist()) for batch in last for goal in batch["goal"][:, 0]}) == 8  # no two robots alike


def test_one_set_of_weights_and_statistics_holds_for_a_whole_batch_and_they_are_at_most_two_updates_old(collect):
    source, actor, normalization = collect("multi_async", total=2048)
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
        assert len(fitting) == 1
        assert fitting[0] <= number
        normalization.update(batch["observation"])
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.05)
    assert number == 15
    assert fitting[0] >= number - 4  # what is old was begun long ago, for a learner that takes its time


def test_asking_for_the_state_loses_no_frame_and_stops_nobody(collect):
    source, *_ = collect("multi_async")
    batches = []
    for batch in source:
        batches.append(batch.clone())
        source.state()
    assert len(batches) == 8
    # Each of the two processes has been collecting all the time, without a gap.
    assert sum(any(goes_on(before, after) for before in batches) for after in batches) == 6


def test_state_is_that_of_all_processes_and_a_new_collector_goes_on_from_it(collect):
    source, *_ = collect("multi_async", seed=3)
    batches = iter(source)
    for _ in range(2):
        next(batches)
    state = source.state()
    assert state["frames"] == 256
    other, *_ = collect("multi_async", seed=99)
    other.set_state(state)
    starts = [state[worker]["carrier"]["observation"] for worker in ("worker0", "worker1")]
    rest = [batch.clone() for batch in other]
    assert len(rest) == 6
    assert any(torch.equal(rest[0]["observation"][:, 0], start) for start in starts)


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


def test_a_worker_that_is_gone_when_it_is_asked_for_its_state_is_an_error_of_one_line(collect):
    source, *_ = collect("multi_async", total=10**9)
    next(iter(source))
    os.kill(source.procs[0].pid, signal.SIGKILL)
    source.procs[0].join()
    with pytest.raises(UserError, match="a process that collects has ended"):
        source.state()
