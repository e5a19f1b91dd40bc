"""The training loop, and the callbacks that it calls."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from physai.algorithms import NonFiniteError
from physai.errors import UserError
from physai.training import checkpoint
from physai.training.agent import Agent


@dataclass
class Clock:
    """How far a run is.

    Attributes:
        frames: Steps of all robots together.
        iteration: Batches.
        seconds: What these took; evaluations do not count.
    """

    frames: int = 0
    iteration: int = 0
    seconds: float = 0.0


class Callback:
    """What happens after each batch beside learning; it may change what comes next.

    Attributes:
        name: Its key in checkpoints.
    """

    name: str

    def begin(self, trainer: "Trainer") -> None:
        """Prepare, before the first batch."""

    def after_batch(self, trainer: "Trainer", batch: TensorDictBase, values: dict[str, float]) -> None:
        """Look at a batch [N, T] that was learned from, and at the figures so far; add own figures to them."""

    def state(self) -> Any:
        """Return what ``set_state`` needs to go on bit for bit; plain values and tensors."""
        return None

    def set_state(self, state: Any) -> None:
        """Restore what ``state`` returned, before ``begin``."""

    def close(self) -> None:
        """Free what was opened; called once, also after an error."""


class Trainer:
    """Collects, learns, and calls callbacks in their order, until ``total_frames``.

    Args:
        agent: What learns.
        total_frames: How many frames it learns from.
        run_dir: Where evidence of failures goes.
        callbacks: Called after each batch.

    Attributes:
        clock: How far the run is.
        folder: Its checkpoints.
    """

    def __init__(
        self,
        agent: Agent,
        total_frames: int,
        run_dir: Path,
        folder: checkpoint.CheckpointFolder,
        callbacks: Sequence[Callback],
    ) -> None:
        self.agent = agent
        self.total_frames = total_frames
        self.run_dir = run_dir
        self.folder = folder
        self.callbacks = callbacks
        self.clock = Clock()
        self._untimed = 0.0  # s, since the last batch was learned from

    @property
    def done(self) -> bool:
        """Whether it has learned from all frames."""
        return self.clock.frames >= self.total_frames

    def due(self, every_frames: int, batch: TensorDictBase) -> bool:
        """Whether something that happens every so many frames, and at the end, happens after this batch."""
        before = self.clock.frames - batch.numel()
        return self.done or before // every_frames != self.clock.frames // every_frames

    @contextlib.contextmanager
    def untimed(self) -> Iterator[None]:
        """Context whose time is not the run's."""
        started = time.perf_counter()
        yield
        self._untimed += time.perf_counter() - started

    def fit(self, stop: Sequence[int] = ()) -> None:
        """Train until the end, or until there is something in ``stop``, and save then.

        Raises:
            UserError: If the disk is full or a number is not finite; the last good checkpoint is kept.
        """
        try:
            for callback in self.callbacks:
                callback.begin(self)
            batches = iter(self.agent.collector)
            while not (self.done or stop):
                started = time.perf_counter()
                batch = next(batches)
                collected = time.perf_counter()
                self.clock.frames += batch.numel()
                self.clock.iteration += 1
                values = self._learn(batch)
                updated = time.perf_counter()
                self.clock.seconds += updated - started
                values |= {
                    "time/collect": collected - started,
                    "time/update": updated - collected,
                    "time/frames_per_second": batch.numel() / (updated - started),
                }
                self._untimed = 0.0
                for callback in self.callbacks:
                    callback.after_batch(self, batch, values)
                self.clock.seconds += time.perf_counter() - updated - self._untimed
            if stop:
                self.save()
        except NonFiniteError as error:
            evidence = self.run_dir / "not_finite.pt"
            checkpoint.save(evidence, {"batch": error.batch.to_dict(), "frames": self.clock.frames})
            raise UserError(
                f"iteration {self.clock.iteration}: {error} is not finite; the batch is in {evidence}, "
                f"the last good checkpoint is {self._last_good()}"
            ) from error
        except OSError as error:
            raise UserError(
                f"cannot write to {self.run_dir}: {error.strerror or error}; last good checkpoint: {self._last_good()}"
            ) from error
        finally:
            for callback in self.callbacks:
                with contextlib.suppress(OSError):  # a full disk refuses the last rows, too
                    callback.close()

    def _learn(self, batch: TensorDictBase) -> dict[str, float]:
        for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
            if not torch.isfinite(batch.get(key)).all():
                raise NonFiniteError(f"'{key if isinstance(key, str) else '.'.join(key)}' from the simulation", batch)
        self.agent.statistics.update(batch.get("observation"))
        return self.agent.algorithm.update(batch)

    def save(self) -> None:
        """Write a checkpoint that the run goes on from bit for bit."""
        content = {
            **self.agent.state(),
            "frames": self.clock.frames,
            "clock": asdict(self.clock),
            "callbacks": {callback.name: callback.state() for callback in self.callbacks},
        }
        self.folder.save(self.clock.frames, content)

    def restore(self) -> None:
        """Go on from the last checkpoint.

        Raises:
            UserError: If it is damaged, or from another config.
        """
        content = checkpoint.load(self.folder.find("last"))
        try:
            self.agent.set_state(content)
            self.clock = Clock(**content["clock"])
            for callback in self.callbacks:
                callback.set_state(content["callbacks"][callback.name])
        except (RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
            reason = (str(error) or type(error).__name__).splitlines()[0][:120]
            raise UserError(f"the checkpoint does not fit the run's config: {reason}") from error

    def _last_good(self) -> str:
        return str(self.folder.paths()[-1]) if self.folder.paths() else "none yet"
