"""``python -m physai.bench``: physai against what it stands on, and its peers (see ``--help``)."""

import argparse
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from physai import cli
from physai.artifact import onnx
from physai.bench.timing import machine
from physai.cli.tables import show
from physai.errors import UserError

# Each is a module here, with a function ``run``.
PARTS = {
    "policy": "one command of an exported policy, in every form that it has",
    "ros": "period and answers of the ROS 2 node, beside a bare one's",
    "fleet": "eight virtual arms and the page: how regularly they are driven, and how soon one message stops all",
    "gym": "the Gymnasium envs, against one written by hand and Stable-Baselines3's vector env",
    "startup": "how soon commands answer, how soon the first frame is there, and how long a thousand episodes take",
    "collection": "collection by one process and by two, against a bare PyBullet loop; and by each collector",
    "engines": "steps of robots in PyBullet and in MuJoCo, with one thread and with two",
    "update": "learning from a batch, against PPO written by hand",
    "training": "time to 99 percent of unseen goals, against the PPO of Stable-Baselines3, rsl_rl and SBX",
    "algorithms": "time to 95 percent of unseen goals of every algorithm, against Stable-Baselines3's of the same name",
    "walk": "legs: collection against bare MuJoCo, and where the time and the memory of a training go",
    "arms": "time to 95 percent of a Panda's unseen goals, against PPO, and TQC with hindsight replay",
    "identify": "what is found of hidden robots by their recordings, in the same engine and in another, and how soon",
    "identified": "policies trained for a hidden robot as its recording shows it, against those for any, on the robot",
    "evidence": "ways to train for robots that differ, and for one that is known, on robots that nobody has met",
    "growth": "time and memory of training against frames and robots",
}
NEEDS = {  # the extra that a part needs, and its modules
    "policy": ("onnx", onnx.PACKAGES),
    "ros": ("ros", ["rclpy"]),
    "fleet": ("ros,web", ["rclpy", "viser"]),
    "gym": ("bench", ["stable_baselines3"]),
    "training": ("bench,mujoco", ["stable_baselines3", "mujoco"]),
    "algorithms": ("bench", ["stable_baselines3"]),
    "arms": ("bench,mujoco", ["sb3_contrib", "panda_gym", "mujoco"]),
    "collection": ("ray", ["ray"]),
    "engines": ("mujoco", ["mujoco"]),
    "walk": ("bench,mujoco", ["psutil", "mujoco"]),
    "identify": ("mujoco", ["mujoco"]),
    "identified": ("mujoco", ["mujoco"]),
    "evidence": ("mujoco", ["mujoco"]),
    "growth": ("bench", ["psutil"]),
}


def main() -> None:
    """Measure, then show the figures as tables."""
    options = _options()
    with cli.guard():
        for part in options.parts:
            extra, modules = NEEDS.get(part, ("", []))
            if missing := [module for module in modules if find_spec(module) is None]:
                raise UserError(f"--{part}: no {', '.join(missing)} here (pip install 'physai[{extra}]')")
        print(machine(), flush=True)
        tables = []
        for part in options.parts:
            print(f"\n--{part}: {PARTS[part]}", flush=True)
            # Only what is measured is imported: ROS, for one, reads its environment then.
            tables.append(import_module(f"physai.bench.{part}").run(options))
        show(*tables)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m physai.bench",
        description="Measure physai on the two-link arm, a Panda and legs, side by side with what it is compared to: "
        "the parts that are named, or all of them, which takes several hours.",
    )
    for part, meaning in PARTS.items():
        parser.add_argument(f"--{part}", dest="parts", action="append_const", const=part, help=meaning)
    parser.add_argument("--seed", type=int, default=0, help="seed of all sides (0)")
    parser.add_argument("--seeds", type=int, default=5, help="train so often, with seeds counting up (5)")
    peer_seconds = "when a peer gives up a training; what physai is ahead by is then a lower bound (100)"
    parser.add_argument("--peer-seconds", type=float, default=100.0, help=peer_seconds)
    arm_times = "a peer of --arms gives up when it has learned for so many times physai's time (22)"
    parser.add_argument("--arm-times", type=float, default=22.0, help=arm_times)
    figure = Path("outputs/growth.png")
    parser.add_argument("--figure", type=Path, default=figure, help=f"where --growth draws ({figure})")
    evidence = Path("outputs/evidence")
    parser.add_argument(
        "--evidence-folder",
        type=Path,
        default=evidence,
        help=f"of --evidence, which goes on with what lies there ({evidence})",
    )
    options = parser.parse_args()
    options.parts = options.parts or list(PARTS)
    if options.seed < 0 or options.seeds < 1 or min(options.peer_seconds, options.arm_times) <= 0:
        parser.error("--seed must not be negative, --seeds, --peer-seconds and --arm-times must be positive")
    return options


if __name__ == "__main__":
    main()
