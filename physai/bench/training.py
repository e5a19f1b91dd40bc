"""How soon a policy is trained, against Stable-Baselines3."""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from rich.table import Table
from tensordict.nn import TensorDictModule

from physai.bench.timing import median_speeds, reacher, table, timed
from physai.envs.make import TransformedRobotEnv
from physai.seeding import derive
from physai.training.agent import Agent, make_evaluation_env
from physai.training.config import TrainConfig
from physai.training.evaluation import evaluate

TARGET = 0.99
GOALS = 1000
GOALS_SEED = derive(0, "benchmark goals")  # the same for both sides, unseen in training
JUDGE_EVERY = 8192  # frames; one batch of Stable-Baselines3, two of physai

SB3_ENVS = 4
SB3_THREADS = (1, 2)
# The numbers that users know; all but ent_coef are also its defaults.
SB3_PPO: dict[str, Any] = {
    "learning_rate": 3e-4,
    "n_steps": 2048,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.005,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}


@dataclass
class Race:
    """How a learner fared; its clock counts learning alone, not building and not judging."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    success_rate: float = 0.0

    @property
    def frames_per_second(self) -> float:
        """Speed."""
        return self.frames / self.seconds

    @property
    def won(self) -> bool:
        """Whether the target was reached."""
        return self.success_rate >= TARGET


def run_race(name: str, learn: Callable[[], int], judge: Callable[[], float], max_frames: int) -> Race:
    """Learn until a judgement finds the target reached, or until ``max_frames``.

    Args:
        name: The learner's.
        learn: One iteration of collecting and learning; returns its frames.
        judge: Returns the success rate of the policy as it is.
        max_frames: Where to give up.
    """
    race = Race(name)
    while not race.won and race.frames < max_frames:
        due = min(race.frames + JUDGE_EVERY, max_frames)
        while race.frames < due:
            frames, seconds = timed(learn)
            race.frames += frames
            race.seconds += seconds
        race.success_rate = judge()
        print(
            f"{name}: {race.frames:>9,} frames  {race.seconds:6.1f} s  {race.frames_per_second:>6,.0f}/s  "
            f"success {race.success_rate:6.1%}",
            flush=True,
        )
    return race


def measure_training(seed: int, seeds: int, sb3_frames: int) -> tuple[list[Race], Race]:
    """Race on one robot that is not randomized: physai with so many seeds, then Stable-Baselines3."""
    configs = [reacher(one, "randomization=none") for one in range(seed, seed + seeds)]
    judge = make_evaluation_env(configs[0], configs[0].randomization, GOALS, GOALS_SEED)
    try:
        return [_race_physai(config, judge) for config in configs], _race_sb3(seed, judge, sb3_frames)
    finally:
        judge.close()


def _race_physai(config: TrainConfig, judge: TransformedRobotEnv) -> Race:
    agent = Agent.build(config)
    batches = iter(agent.collector)

    def learn() -> int:
        batch = next(batches)
        agent.env.normalization.update(batch.get("observation"))
        agent.algorithm.update(batch)
        return batch.numel()

    def success_rate() -> float:
        judge.normalization.load_state_dict(agent.env.normalization.state_dict())
        return evaluate(agent.actor, judge, GOALS, GOALS_SEED).success_rate

    try:
        return run_race(f"physai, seed {config.seed}", learn, success_rate, config.total_frames)
    finally:
        agent.close()


def _race_sb3(seed: int, judge: TransformedRobotEnv, max_frames: int) -> Race:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env("physai/Reacher-v0", SB3_ENVS)  # a DummyVecEnv; PPO seeds it

    def make_model(**changed: int) -> PPO:
        return PPO("MlpPolicy", envs, seed=seed, device="cpu", **SB3_PPO | changed)

    def learn(model: PPO, threads: int) -> int:
        torch.set_num_threads(threads)
        before = model.num_timesteps
        model.learn(1, reset_num_timesteps=False)  # rounds up to one batch
        return model.num_timesteps - before

    def act(observation: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(model.predict(observation.numpy(), deterministic=True)[0])

    trial = make_model(n_steps=256)
    speeds = median_speeds(*(partial(learn, trial, threads) for threads in SB3_THREADS), rounds=1)
    threads = SB3_THREADS[speeds.index(max(speeds))]
    measured = ", ".join(f"{speed:,.0f}/s with {n}" for n, speed in zip(SB3_THREADS, speeds, strict=True))
    print(f"Stable-Baselines3 by torch threads: {measured}; it gets {threads}", flush=True)

    model = make_model()
    policy = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])

    def success_rate() -> float:
        return evaluate(policy, judge, GOALS, GOALS_SEED).success_rate

    try:
        return run_race("Stable-Baselines3", partial(learn, model, threads), success_rate, max_frames)
    finally:
        envs.close()


def training_table(races: list[Race], sb3: Race) -> Table:
    """Show both sides, and what physai's median is ahead by."""
    title = f"Training until {TARGET:.0%} of {GOALS:,} unseen goals are reached, randomization=none"
    shown = table(title, "", "frames", "frames/s", "time", "success")
    for race in (*races, sb3):
        bound, speed = "" if race.won else "> ", f"{race.frames_per_second:,.0f}"
        time_taken, success = f"{bound}{race.seconds:.1f} s", f"{race.success_rate:.1%}"
        shown.add_row(race.name, f"{bound}{race.frames:,}", speed, time_taken, success)
    faster = statistics.median(race.frames_per_second for race in races) / sb3.frames_per_second
    seconds = statistics.median(race.seconds if race.won else math.inf for race in races)
    sooner = f"{'' if sb3.won else '> '}{sb3.seconds / seconds:.1f}x" if math.isfinite(seconds) else "unknown"
    shown.add_section()
    shown.add_row("physai is ahead by", "", f"{faster:.1f}x", sooner, "", style="bold")
    return shown
