"""``python -m physai.bench``: physai against what it stands on, and Stable-Baselines3 (see ``--help``)."""

import argparse
from importlib.util import find_spec

from rich.console import Console

from physai import cli
from physai.artifact import onnx
from physai.bench.collection import collection_table, measure_collection
from physai.bench.policy import measure_policy, policy_table
from physai.bench.timing import machine
from physai.bench.training import measure_training, training_table
from physai.errors import UserError


def main() -> None:
    """Measure, then show the figures as tables."""
    options = _options()
    everything = not (options.collect or options.train or options.policy or options.ros)
    with cli.guard():
        if (everything or options.train) and find_spec("stable_baselines3") is None:
            raise UserError("no stable_baselines3 here: pip install 'physai[bench]', or use --collect or --policy")
        if (everything or options.policy) and onnx.missing():
            raise UserError(f"no {onnx.missing()[0]} here: pip install 'physai[onnx]', or use --collect or --train")
        if (everything or options.ros) and find_spec("rclpy") is None:
            raise UserError("no rclpy here: pip install 'physai[ros]', or use --policy, --collect or --train")
        print(machine(), flush=True)
        tables = []
        if everything or options.policy:
            tables.append(policy_table(*measure_policy(options.seed)))
        if everything or options.ros:
            from physai.bench.ros import measure_ros, ros_table  # ROS reads its environment when it is imported

            tables.append(ros_table(measure_ros(options.seed)))
        if everything or options.collect:
            tables.append(collection_table(*measure_collection(options.seed)))
        if everything or options.train:
            tables.append(training_table(*measure_training(options.seed, options.seeds, options.sb3_frames)))
        Console().print(*tables)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m physai.bench",
        description="Measure physai on the two-link arm: how long an exported policy takes for a command, against "
        "TorchRL's actor; how well the ROS 2 node keeps its 50 Hz, beside a bare one; how fast it collects, against a "
        "bare PyBullet loop; and how soon its policy reaches 99 % of unseen goals, against Stable-Baselines3 PPO.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--policy", action="store_true", help="measure the exported policy only")
    part.add_argument("--ros", action="store_true", help="measure the ROS 2 node only")
    part.add_argument("--collect", action="store_true", help="measure collection only")
    part.add_argument("--train", action="store_true", help="measure training only")
    parser.add_argument("--seed", type=int, default=0, help="seed of all sides")
    parser.add_argument("--seeds", type=int, default=1, help="train physai so often, with seeds counting up")
    sb3_frames = "where Stable-Baselines3 gives up; what physai is ahead by is then a lower bound"
    parser.add_argument("--sb3-frames", type=int, default=2_000_000, help=sb3_frames)
    options = parser.parse_args()
    if options.seed < 0 or options.seeds < 1 or options.sb3_frames < 1:
        parser.error("--seed must not be negative, --seeds and --sb3-frames must be positive")
    return options


if __name__ == "__main__":
    main()
