"""The yardstick of updates does the same work, and the measurement shows every figure."""

import pytest
import torch
from rich.console import Console

from physai.bench import update
from physai.bench.timing import reacher
from physai.training.agent import Agent


@pytest.mark.slow
def test_ppo_by_hand_learns_what_algo_ppo_learns():
    # One minibatch: an order of samples cannot make a difference.
    config = reacher(0, "collector.num_envs=32", "collector.frames_per_batch=512", "algo.minibatch_size=512")
    agent, twin = Agent.build(config), Agent.build(config)
    batch = next(iter(agent.collector))
    agent.statistics.update(batch["observation"])
    before = [value.clone() for value in agent.actor.parameters()]
    frames = update.plain_ppo(twin, batch.clone(), config.algo)()
    agent.algorithm.update(batch)
    assert frames == 512 * config.algo["epochs"]
    for ours, by_hand, untrained in zip(agent.actor.parameters(), twin.actor.parameters(), before, strict=True):
        assert (ours - untrained).abs().max() > 1e-4
        torch.testing.assert_close(ours, by_hand, rtol=0, atol=2e-4)
    agent.close()
    twin.close()


@pytest.mark.slow
def test_both_sides_are_timed_and_shown(monkeypatch):
    monkeypatch.setattr(update, "MINIBATCHES", (256,))
    monkeypatch.setattr(update, "ROUNDS", 1)
    default, speeds = update.measure_update(seed=0)
    assert set(speeds) == {256, default}
    console = Console(width=120, record=True)
    console.print(update.update_table(default, speeds))
    for part in ("by hand", "algo=ppo", "ratio", f"{default} (default)"):
        assert part in console.export_text(clear=False)
