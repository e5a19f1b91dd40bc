"""``python -m physai.play``: watch the policy of a run (see ``--help``)."""

import itertools
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from omegaconf import DictConfig

from physai import cli
from physai.config import Count, Seed, validate
from physai.errors import UserError
from physai.evaluate import PolicyChoice

if TYPE_CHECKING:
    import numpy as np

_PAUSE = 15  # control steps to look at the arm at its goal
_EACH = 2  # control steps for each frame of a video: 25 Hz show as much as 50, and meshes take 0.2 s a frame


class PlayConfig(PolicyChoice):
    """``conf/play.yaml``."""

    run: str
    goals: Count
    seed: Seed
    render: Literal["video", "human"]
    output: str | None


def _check(node: DictConfig) -> None:
    config = validate(PlayConfig, node)
    if config.output is not None and Path(config.output).suffix not in (".mp4", ".gif"):
        raise UserError(f"output: '{config.output}' must end in .mp4 or .gif")
    config.load(config.run)


def _play(node: DictConfig, _: Path) -> None:
    import torch
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from physai.envs.viewing import make_viewer
    from physai.envs.viewing import show as show_robot

    config = validate(PlayConfig, node)
    actor, env = config.load(config.run).deploy(1, config.seed)
    human = config.render == "human"
    viewer = make_viewer(env.simulation, window=human)
    dt = env.simulation.config.control_dt
    frames: list[np.ndarray] = []

    steps = itertools.count()

    def show(times: int = 1) -> None:
        for _ in range(times):
            if not human and next(steps) % _EACH:
                continue
            image = show_robot(viewer, env.simulation)
            if image is None:
                time.sleep(dt)
            else:
                frames.append(image)

    reached = 0
    with closing(env), closing(viewer), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for goal in range(config.goals):
            tensordict = env.reset()
            show()
            first = None  # s
            while not tensordict["done"].any():
                tensordict = env.step(actor(tensordict))["next"]
                seconds = tensordict["episode_length"].item() * dt
                first = seconds if first is None and tensordict["success"] else first
                show()
            reached += int(tensordict["success"])
            outcome = "missed" if first is None else f"reached in {first:.2f} s"
            if first is not None and first < seconds:
                outcome += ", held" if tensordict["success"] else ", left again"
            print(f"goal {goal + 1}: {outcome}", flush=True)
            show(_PAUSE)
    print(f"{reached} of {config.goals} goals reached")
    if not human:
        output = Path(config.output) if config.output else Path(config.run) / "play.mp4"
        _write(output, frames, round(1 / (_EACH * dt)))
        print(f"Video: {output}")


def _write(output: Path, frames: "list[np.ndarray]", frames_per_second: int) -> None:
    import imageio.v3 as imageio

    try:
        if output.suffix == ".gif":
            imageio.imwrite(output, frames, duration=1000 / frames_per_second, loop=0)
        else:
            imageio.imwrite(output, frames, fps=frames_per_second, macro_block_size=8)
    except OSError as error:
        raise UserError(f"cannot write {output}: {error.strerror or error}") from error


if __name__ == "__main__":
    cli.main("play", _play, _check)
