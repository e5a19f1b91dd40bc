import os
import signal
import sys
import time
from itertools import pairwise

import pytest
import torch

from physai.errors import UserError
from tests.collectors.parts import assert_equal
from tests.docs.blocks import ROOT
from tests.forge import Forked
from tests.waiting import wait_for


@pytest.mark.slow
def test_batches_are_robots_by_steps_and_no_two_robots_are_alike(collect):
    source, *_ = collect("multi_sync", total=300)
    batches = [batch.clone() for batch in source]
    assert [batch.shape for batch in batches] == [(8, 16)] * 3  # rounded up to whole batches
    assert len(batches[0]["goal"][:, 0].unique(dim=0)) == 8
    assert len(batches[0]["latent_action"][:, 0].unique(dim=0)) == 8
    for before, after in pairwise(batches):  # an episode goes on where the last batch ended
        goes_on = ~before["next", "done"][:, -1, 0]
        assert goes_on.any()
        assert torch.equal(before["next", "observation"][:, -1][goes_on], after["observation"][:, 0][goes_on])


@pytest.mark.slow
def test_all_processes_see_the_learner_s_weights_and_normalization_from_the_next_batch_on(collect):
    source, actor, normalization = collect("multi_sync")
    batches = iter(source)
    for _ in range(4):
        batch = next(batches)
        assert torch.equal(batch["normalized_observation"], normalization.normalizer(batch["observation"]))
        expected = actor.get_dist(batch).log_prob(batch["latent_action"])
        torch.testing.assert_close(batch["action_log_prob"], expected, rtol=0, atol=1e-5)
        normalization.update(batch["observation"])
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.1)


def test_the_learner_s_process_stays_as_it_was(collect):
    before = torch.get_num_threads(), torch.multiprocessing.get_start_method(allow_none=True)
    collect("multi_sync")
    assert (torch.get_num_threads(), torch.multiprocessing.get_start_method(allow_none=True)) == before


def test_a_worker_that_is_gone_when_it_is_asked_for_its_state_is_an_error_of_one_line(collect):
    source, *_ = collect("multi_sync")
    next(iter(source))
    os.kill(source.procs[0].pid, signal.SIGKILL)
    source.procs[0].join()
    with pytest.raises(UserError, match="a process that collects has ended"):
        source.state()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_frames(collect):
    (first, *_), (again, *_), (other, *_) = (collect("multi_sync", seed=seed) for seed in (1, 1, 2))
    for ours, theirs, _ in zip(first, again, range(2), strict=False):
        assert_equal(ours, theirs)
    assert not torch.isclose(next(iter(other))["goal"], ours["goal"]).any()


@pytest.mark.slow
def test_state_continues_bit_for_bit_in_new_processes(collect):
    source, _, normalization = collect("multi_sync", seed=3)
    batches = iter(source)
    for _ in range(2):
        normalization.update(next(batches)["observation"])
    state, statistics = source.state(), normalization.state_dict()
    expected = next(batches).clone()
    other, _, fresh = collect("multi_sync", seed=99)
    fresh.load_state_dict(statistics)
    other.set_state(state)
    assert_equal(expected, next(iter(other)))


@pytest.mark.slow
def test_a_killed_worker_ends_collection_with_an_error_and_takes_the_others_along(collect):
    source, *_ = collect("multi_sync")
    batches = iter(source)
    next(batches)
    os.kill(source.procs[1].pid, signal.SIGKILL)
    started = time.monotonic()
    with pytest.raises(UserError, match="exit code -9"):
        list(batches)
    source.shutdown()
    assert time.monotonic() - started < 20


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="a signal at the death of the parent is Linux's")
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
def test_workers_die_with_a_learner_that_is_killed(kind):
    learner = Forked("tests.collectors.learner", [kind], ROOT, os.environ)
    workers = []
    while len(workers) != 2:
        workers = [int(word) for word in learner.stdout.readline().split() if word.isdigit()]
    assert all(is_alive(worker) for worker in workers)
    learner.kill()
    learner.communicate()
    wait_for(lambda: not any(is_alive(worker) for worker in workers), 10, "workers to die")
