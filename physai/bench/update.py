"""What learning from a batch costs, against PPO written by hand in plain torch."""

from argparse import Namespace
from collections.abc import Callable
from typing import Any

import torch
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor, nn

from physai.bench.timing import median_speeds, reacher, table
from physai.training.agent import Agent

ROUNDS = 11
FRAMES = 4096  # in a batch, so that every minibatch fits
MINIBATCHES = (256, 512, 1024, 2048, 4096)


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return update_table(*measure_update(options.seed))


def measure_update(seed: int) -> tuple[int, dict[int, list[float]]]:
    """Return the default minibatch; and by minibatch, samples/s by hand and of ``algo=ppo``, epochs counted."""
    default = reacher(seed).algo["minibatch_size"]
    speeds = {}
    for minibatch in sorted({*MINIBATCHES, default}):
        by_hand, ours = speeds[minibatch] = _update_speeds(seed, minibatch)
        print(f"minibatch {minibatch:>5,}: algo=ppo {ours:>9,.0f}/s, by hand {by_hand:>9,.0f}/s", flush=True)
    return default, speeds


def _update_speeds(seed: int, minibatch: int) -> list[float]:
    sizes = f"algo.minibatch_size={minibatch}", f"collector.frames_per_batch={FRAMES}"
    config = reacher(seed, *sizes, "collector=single")  # nobody else is at work
    agent, twin = Agent.build(config), Agent.build(config)
    try:
        batch = next(iter(agent.collector))
        agent.statistics.update(batch.get("observation"))
        by_hand = plain_ppo(twin, batch, config.algo)

        def update() -> int:
            agent.algorithm.update(batch.copy())
            return int(config.algo["epochs"]) * batch.numel()

        return median_speeds(by_hand, update, rounds=ROUNDS)
    finally:
        agent.close()
        twin.close()


def plain_ppo(agent: Agent, batch: TensorDictBase, algo: dict[str, Any]) -> Callable[[], int]:
    """PPO as one writes it for one task: the same networks, numbers and samples, in as little torch as it takes.

    Args:
        agent: Its networks learn.
        batch: Frames [N, T].
        algo: The numbers of ``conf/algo/ppo.yaml``.

    Returns:
        A function that learns from the batch once, and says from how many samples, epochs counted.
    """
    actor, critic = agent.actor, agent.critic
    gamma, lmbda, lr = algo["advantage"]["gamma"], algo["advantage"]["lmbda"], algo["optimizer"]["lr"]
    clip, critic_coeff = algo["loss"]["clip_epsilon"], algo["loss"]["critic_coeff"]
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=lr, eps=1e-5, fused=True)

    def inputs(frames: TensorDictBase, of: Any) -> Tensor:
        return torch.cat([frames.get(key) for key in of.in_keys], -1)

    def advantages(seen: Tensor) -> tuple[Tensor, Tensor]:
        after = batch.get("next")
        reward, done, terminated = (after.get(key)[..., 0] for key in ("reward", "done", "terminated"))
        value, next_value = critic.network(seen)[..., 0], critic.network(inputs(after, critic))[..., 0]
        delta = reward + gamma * next_value * ~terminated - value
        advantage, running = torch.empty_like(delta), torch.zeros(len(delta))
        for step in reversed(range(delta.shape[1])):
            running = delta[:, step] + gamma * lmbda * running * ~done[:, step]
            advantage[:, step] = running
        return advantage, advantage + value

    def update() -> int:
        with torch.no_grad():
            judged = inputs(batch, critic)
            acted = inputs(batch, actor), batch.get("latent_action"), batch.get("action_log_prob")
            columns = [*acted, judged, *advantages(judged)]
        frames = [column.flatten(0, 1) for column in columns]
        for _ in range(algo["epochs"]):
            for rows in torch.randperm(batch.numel()).split(algo["minibatch_size"]):
                seen, latent, old, judged, advantage, target = (column[rows] for column in frames)
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                normal = torch.distributions.Normal(actor.network(seen), actor.log_std.exp(), validate_args=False)
                ratio = (normal.log_prob(latent).sum(-1) - old).exp()
                gain = torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
                error = (critic.network(judged)[..., 0] - target).square().mean()
                optimizer.zero_grad()
                (critic_coeff * error - gain).backward()
                nn.utils.clip_grad_norm_(parameters, algo["max_grad_norm"])
                optimizer.step()
        return int(algo["epochs"]) * batch.numel()

    return update


def update_table(default: int, speeds: dict[int, list[float]]) -> Table:
    """Show what a sample costs; the default minibatch stands out."""
    title = "Update, µs per sample and epoch: advantages, loss, gradient, step; one thread"
    shown = table(title, "minibatch", "by hand, plain torch", "algo=ppo", "ratio")
    for minibatch, (by_hand, ours) in speeds.items():
        style, mark = ("bold", " (default)") if minibatch == default else (None, "")
        figures = f"{1e6 / by_hand:.2f}", f"{1e6 / ours:.2f}", f"{by_hand / ours:.2f}"
        shown.add_row(f"{minibatch:,}{mark}", *figures, style=style)
    return shown
