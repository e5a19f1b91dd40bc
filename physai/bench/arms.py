"""How soon a Panda reaches points in space, against Stable-Baselines3's PPO and TQC with hindsight replay."""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
from rich.table import Table
from sb3_contrib import TQC
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from physai.bench.sb3 import Learner, Settings
from physai.bench.timing import config_of, table
from physai.bench.training import FAST_ENGINE, GOALS_SEED, Conditions, Race, apart, race_peer, race_physai, run_race
from physai.envs.make import TransformedRobotEnv
from physai.training.agent import make_evaluation_env
from physai.training.config import TrainConfig

TARGET = 0.95
GOALS = 500
OURS = {"physai": (), "physai, MuJoCo": ("physics=mujoco",)}
PANDA_GYM = "panda_gym:PandaReach-v3"


def _with_hindsight(env: str) -> Settings:
    """TQC and HER as RL Baselines3 Zoo has them for PandaReach-v1 (``hyperparams/tqc.yml``); it normalizes, too."""

    def make_envs() -> VecEnv:
        return VecNormalize(make_vec_env(env), gamma=0.95)

    arguments: dict[str, Any] = {
        "learning_rate": 1e-3,
        "buffer_size": 1_000_000,
        "batch_size": 256,
        "gamma": 0.95,
        "ent_coef": "auto",
        "learning_starts": 1000,
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": {"goal_selection_strategy": "future", "n_sampled_goal": 4},
        "policy_kwargs": {"net_arch": [64, 64], "n_critics": 1},
    }
    return Settings(make_envs, arguments, TQC, frames=128)


PEERS = {
    "SB3 PPO": Settings(partial(make_vec_env, "physai/PandaReach-v0", 4), {"learning_rate": 3e-4}),  # its defaults
    "TQC + HER": _with_hindsight("physai/PandaReachGoal-v0"),
    "TQC + HER, panda-gym": _with_hindsight(PANDA_GYM),
}


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return arms_table(measure_arms(options.seed, options.arm_times), len(OURS))


def measure_arms(seed: int, times: float, goals: int = GOALS, overrides: tuple[str, ...] = ()) -> list[Race]:
    """Race on one robot that is not randomized, each side in a process of its own; peers step one robot or four.

    Args:
        seed: Of all.
        times: After how many times physai's time peers give up.
        goals: How many each evaluation has.
        overrides: Of the config of physai, and of the robots that judge.

    Returns:
        The races; those of physai come first.
    """
    ours = [apart(_race_ours, name, seed, Conditions(0.0, goals, overrides)) for name in OURS]
    limit = times * ours[0].seconds
    print(f"peers give up after {limit:.0f} s of learning, {times:g} times as long as physai took", flush=True)
    return ours + [apart(_race_theirs, name, seed, Conditions(limit, goals, overrides)) for name in PEERS]


def _config(seed: int, conditions: Conditions, *overrides: str) -> TrainConfig:
    return config_of("panda_reach", seed, "randomization=none", *overrides, *conditions.overrides)


def _judge(seed: int, conditions: Conditions) -> TransformedRobotEnv:
    config = _config(seed, conditions, *FAST_ENGINE)
    return make_evaluation_env(config, config.randomization, conditions.goals, GOALS_SEED)


def _race_ours(name: str, seed: int, conditions: Conditions) -> Race:
    judge = _judge(seed, conditions)
    try:
        return race_physai(_config(seed, conditions, *OURS[name]), Race(name, TARGET), judge)
    finally:
        judge.close()


def _race_theirs(name: str, seed: int, conditions: Conditions) -> Race:
    learner, race = PEERS[name].learner(seed), Race(name, TARGET)
    if "panda-gym" in name:
        return _race_in_panda_gym(learner, race, conditions)
    judge = _judge(seed, conditions)
    try:
        return race_peer(learner, race, judge, max_seconds=conditions.peer_seconds)
    finally:
        judge.close()


def _race_in_panda_gym(learner: Learner, race: Race, conditions: Conditions) -> Race:
    env, goals = gymnasium.make(PANDA_GYM), conditions.goals // 5  # one after the other, which takes as long
    try:
        judge = partial(_share_reached, env, learner.predict, goals)
        return run_race(race, learner.learn, judge, max_seconds=conditions.peer_seconds)
    finally:
        env.close()
        learner.close()


def _share_reached(env: gymnasium.Env[Any, Any], policy: Callable[[Any], Any], goals: int) -> float:
    """Return the share of goals that a policy reaches in an env whose episodes end there, the same goals each time."""
    reached = 0
    for goal in range(goals):
        observation, _ = env.reset(seed=GOALS_SEED % 2**31 + goal)
        terminated = truncated = False
        while not (terminated or truncated):
            observation, _, terminated, truncated, _ = env.step(policy(observation))
        reached += bool(terminated)
    return reached / goals


def arms_table(races: list[Race], ours: int) -> Table:
    """Show all races, and what each of the first ``ours``, physai's, is ahead of the others by."""
    title = f"A Panda's training until {TARGET:.0%} of unseen goals are reached"
    shown = table(title, "", "frames", "time", "success", *(f"{race.name} ahead" for race in races[:ours]))
    if not all(race.won for race in races):
        shown.caption = "> : stopped at its limit, physai's is total_frames, that of the others --arm-times"
    for place, race in enumerate(races):
        more = "" if race.won else "> "
        ratios = [f"{more}{race.seconds / side.seconds:.1f}x" if side.won else "unknown" for side in races[:ours]]
        shown.add_row(
            race.name,
            f"{more}{race.frames:,}",
            f"{more}{race.seconds:.1f} s",
            f"{race.success_rate:.1%}",
            *(ratios if place >= ours else [""] * ours),
        )
    return shown
