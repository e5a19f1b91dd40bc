"""``python -m physai.play``: watch a policy (see ``--help``)."""

import importlib.util
import itertools
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from omegaconf import DictConfig

from physai import cli
from physai.config import Count, PageConfig, Seed, not_installed, validate
from physai.errors import UserError
from physai.evaluate import PolicyChoice

if TYPE_CHECKING:
    import numpy as np

    from physai.artifact.acting import PolicyFile
    from physai.training.run import TrainedPolicy

_PAUSE = 15  # control steps to look at the arm at its goal
_EACH = 2  # control steps for each frame of a video: 25 Hz show as much as 50, and meshes take 0.2 s a frame


class PlayConfig(PolicyChoice):
    """``conf/play.yaml``."""

    run: str | None
    goals: Count
    seed: Seed
    render: Literal["video", "human", "web"]
    output: str | None
    web: PageConfig

    def chosen(self) -> str:
        """The run or policy file that was asked for; for a page, the newest run if none was.

        Raises:
            UserError: If there is none.
        """
        if self.run is not None:
            return self.run
        if self.render != "web":
            raise UserError("run=... is required")
        if not (found := runs()):
            raise UserError("there is no run in outputs/: run=<run folder or policy file> names one")
        return found[0]

    def read(self, run: str) -> "TrainedPolicy | PolicyFile":
        """Read the policy of a run folder or of a file; raises a UserError if something is missing or damaged."""
        if not Path(run).is_file():
            return self.load(run)
        from physai.artifact.acting import PolicyFile

        if self.env is not None:
            raise UserError("env: a policy file drives the robot that it was trained for")
        return PolicyFile(Path(run), self._randomization(), self.physics, self.allow)


def runs() -> list[str]:
    """Runs in outputs/ that have a policy, newest first."""
    found = sorted(Path("outputs").glob("*/checkpoints/best.pt"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [str(path.parent.parent) for path in found]


def _check(node: DictConfig) -> None:
    config = validate(PlayConfig, node)
    if config.output is not None and Path(config.output).suffix not in (".mp4", ".gif"):
        raise UserError(f"output: '{config.output}' must end in .mp4 or .gif")
    if config.render == "web" and importlib.util.find_spec("viser") is None:
        raise UserError(f"render=web needs {not_installed('viser')}")
    policy = config.read(config.chosen())
    if config.render == "web" and not policy.config.env.simulated:
        raise UserError("render=web: only simulated robots can be played with")


def _play(node: DictConfig, _: Path) -> None:
    config = validate(PlayConfig, node)
    if config.render == "web":
        _show_page(config)
    else:
        _show_goals(config)


def _show_page(config: PlayConfig) -> None:
    """Serve the page until Ctrl-C."""
    from physai.web import live

    def load(run: str, engine: str | None) -> live.DrivenRobot:
        chosen = config if engine is None else config.model_copy(update={"physics": live.engine(engine)})
        policy = chosen.read(run)
        return live.DrivenRobot(*policy.deploy(1, config.seed, randomization=live.sensed(policy.randomization)))

    first = config.chosen()
    choices = live.Choices(list(dict.fromkeys([first, *runs()])), live.engines(), load)
    live.serve_page(choices, load(first, None), config.web.host, config.web.port)


def _show_goals(config: PlayConfig) -> None:
    """Show goal after goal in a window or a video."""
    import torch
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from physai.envs.viewing import make_viewer
    from physai.envs.viewing import show as show_robot

    run = config.chosen()
    actor, env = config.read(run).deploy(1, config.seed)
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
            if env.simulation.task.goal_steps:  # one goal after the other was asked for
                outcome = f"{'fell after' if tensordict['terminated'] else 'followed for'} {seconds:.2f} s"
                means = (env.simulation.error_sum / env.simulation.episode_length)[0]
                for tolerance, mean in zip(env.simulation.task.tolerances, means, strict=True):
                    outcome += f", {tolerance.name} error {mean:.2f} {tolerance.unit}"
            print(f"goal {goal + 1}: {outcome}", flush=True)
            show(_PAUSE)
    print(f"{reached} of {config.goals} goals reached")
    if not human:
        folder = Path(run) if Path(run).is_dir() else Path(run).parent
        output = Path(config.output) if config.output else folder / "play.mp4"
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
