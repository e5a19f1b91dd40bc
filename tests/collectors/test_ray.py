import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from physai.errors import UserError
from tests.collectors import parts
from tests.collectors.test_ranges import assert_ranges_are_followed
from tests.training.processes import all_gone, command_of, descendants
from tests.training.small import TINY, command

pytest.importorskip("ray")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc"),
]


def learn(batch, policy, normalization):
    normalization.update(batch["observation"])
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.1)


def test_frames_are_those_of_processes_without_ray_and_go_on_bit_for_bit(cluster, collect, monkeypatch):
    """With random frames, and with weights and statistics that change; a worker that is killed is one line."""
    monkeypatch.setitem(parts.KINDS["ray"], "ray_init", parts.RAY | {"address": cluster[0]})
    plain, *learner = collect("multi_sync", warmup=128)
    expected = []
    for _, batch in zip(range(4), plain, strict=False):
        expected.append(batch.clone())
        learn(batch, *learner)
    plain.shutdown()

    source, policy, normalization = collect("ray", warmup=128)
    for ours, theirs in zip(expected[:2], source, strict=False):
        parts.assert_equal(ours.exclude("collector"), theirs)
        learn(theirs, policy, normalization)
    state = source.state()
    source.shutdown()

    again, other, statistics = collect("ray", seed=99)
    again.set_state(state)
    other.load_state_dict(policy.state_dict())
    statistics.load_state_dict(normalization.state_dict())
    batches = iter(again)
    for ours, theirs in zip(expected[2:], batches, strict=False):
        parts.assert_equal(ours.exclude("collector"), theirs)
        learn(theirs, other, statistics)

    workers = working(cluster[1])
    os.kill(min(workers), signal.SIGKILL)
    with pytest.raises(UserError, match=r"a process that collects has ended \("):
        next(batches)
    again.shutdown()
    assert all_gone(workers)


def test_ranges_that_a_learner_moves_reach_robots_of_ray(cluster, monkeypatch):
    monkeypatch.setitem(parts.KINDS["ray"], "ray_init", parts.RAY | {"address": cluster[0]})
    assert_ranges_are_followed("ray", 0)


@pytest.fixture(scope="module")
def cluster():
    """A Ray that is there already; its address and its process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_worker_niceness", "0")
        yield from _cluster()


def _cluster():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    ray = str(Path(sys.executable).with_name("ray"))
    port = address.partition(":")[2]
    options = ["--head", "--block", "--node-ip-address=127.0.0.1", f"--port={port}", "--num-cpus=2"]
    options.append("--include-dashboard=false")
    head = subprocess.Popen(
        [ray, "start", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    for line in head.stdout:
        if "Ray runtime started" in line:
            break
    yield address, head
    started = descendants(head.pid)
    head.terminate()
    head.communicate()
    assert all_gone(started)


def working(head):
    """The processes of a cluster that step robots."""
    return {one for one in descendants(head.pid) if "WorkerCollector" in command_of(one)}


def test_a_cluster_that_is_there_is_joined_and_left_as_it_was(cluster, tmp_path):
    address, head = cluster
    assert all_gone(working(head))  # Ray ends those of the test before a second after it has left
    joining = ["collector=ray", f"collector.ray_init.address={address}", "collector.num_envs=16"]
    process = command("train", *TINY, *joining, "hydra.run.dir=run", cwd=tmp_path)
    workers = set()
    while process.poll() is None:
        workers |= working(head)
        assert not any("raylet" in command_of(one) for one in descendants(process.pid))
        time.sleep(0.1)
    assert process.returncode == 0, process.communicate()[0]
    assert len(workers) == 2
    assert all_gone(workers)
    assert head.poll() is None
