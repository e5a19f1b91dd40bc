"""How soon each algorithm is trained, against Stable-Baselines3's of the same name."""

from argparse import Namespace

from rich.table import Table

from physai.bench import sb3
from physai.bench.timing import reacher, table
from physai.bench.training import GOALS, GOALS_SEED, Race, race_peer, race_physai
from physai.training.agent import make_evaluation_env

ALGORITHMS = ("ppo", "a2c", "sac", "td3", "ddpg")
TARGET = 0.95


def run(options: Namespace) -> Table:
    """Measure, and show it."""
    return algorithms_table(measure_algorithms(options.seed, options.peer_seconds))


def measure_algorithms(seed: int, peer_seconds: float) -> dict[str, tuple[Race, Race]]:
    """Race with default settings on one robot that is not randomized.

    Args:
        seed: Of all.
        peer_seconds: When Stable-Baselines3 gives up.

    Returns:
        By algorithm, physai's race and Stable-Baselines3's.
    """
    races = {}
    for name in ALGORITHMS:
        config = reacher(seed, f"algo={name}", "randomization=none")
        evaluator = make_evaluation_env(config, config.randomization, GOALS, GOALS_SEED)
        try:
            ours = race_physai(config, Race(f"physai {name}", TARGET), evaluator)
            learner = sb3.Learner(sb3.as_it_comes(name), seed)
            races[name] = ours, race_peer(learner, Race(f"SB3 {name}", TARGET), evaluator, max_seconds=peer_seconds)
        finally:
            evaluator.close()
    return races


def algorithms_table(races: dict[str, tuple[Race, Race]]) -> Table:
    """Show frames and seconds of both, and what physai is ahead by."""
    title = f"Training until {TARGET:.0%} of {GOALS:,} unseen goals are reached: physai / SB3, as they come"
    shown = table(title, "algorithm", "frames", "time", "success", "ahead by")
    for name, (ours, theirs) in races.items():
        more = "" if theirs.won else "> "
        shown.add_row(
            name,
            f"{ours.frames:,} / {more}{theirs.frames:,}",
            f"{ours.seconds:.1f} s / {more}{theirs.seconds:.0f} s",
            f"{ours.success_rate:.1%} / {theirs.success_rate:.1%}",
            f"{more}{theirs.seconds / ours.seconds:.0f}x" if ours.won else "unknown",
        )
    return shown
