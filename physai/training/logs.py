"""What a run writes down while it trains: two CSV files and whatever TorchRL logger the config names."""

import csv
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from tensordict import TensorDictBase

from physai.errors import UserError


class CsvLog:
    """A CSV file that can go back to an earlier length, for a resumed run.

    Args:
        path: The file; it is created with its header, or cut to ``length`` bytes and continued.
        columns: Names of the columns.
        length: From ``position``.
    """

    def __init__(self, path: Path, columns: Sequence[str], length: int = 0) -> None:
        self.columns = columns
        if length:
            if not path.is_file() or path.stat().st_size < length:
                raise UserError(f"{path}: rows are missing that its run had written")
            os.truncate(path, length)
        self._file: IO[str] = open(path, "a" if length else "w", newline="")  # noqa: SIM115
        self._writer = csv.DictWriter(self._file, columns, restval="")
        if not length:
            self._writer.writeheader()

    def write(self, **row: Any) -> None:
        """Add a row; missing columns stay empty."""
        self._writer.writerow(row)

    def flush(self) -> None:
        """Make the rows visible to readers."""
        self._file.flush()

    def position(self) -> int:
        """Bring all rows to the disk and return the file's length."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


EPISODE_COLUMNS = ("frame", "return", "length", "success")
EVALUATION_COLUMNS = (
    "evaluation/success_rate",
    "evaluation/settled_rate",
    "evaluation/crashed_rate",
    "evaluation/steps_to_goal",
    "evaluation/final_distance",
    "evaluation/return",
    *(f"evaluation/{what}_{figure}" for what in ("action_change", "acceleration") for figure in ("mean", "p99")),
)
TIME_COLUMNS = ("time/seconds", "time/collect", "time/update", "time/frames_per_second")


class RunLog:
    """``metrics.csv``, ``episodes.csv`` and the logger of a run.

    Args:
        run_dir: The run folder.
        reward_terms: Names of the terms of the reward.
        make_logger: Returns a TorchRL logger; called by ``open``, or for the first metrics.
        state: From ``state``, to continue a run.
    """

    def __init__(
        self,
        run_dir: Path,
        reward_terms: Sequence[str],
        make_logger: Callable[[], Any],
        state: dict[str, Any] | None = None,
    ) -> None:
        state = state or {"metrics": 0, "columns": [], "episodes": 0}
        self._run_dir = run_dir
        self._rewards = [f"reward/{term}" for term in reward_terms]
        self._make_logger = make_logger
        self._logger: Any = None
        self._metrics: CsvLog | None = None
        if state["metrics"]:
            self._metrics = CsvLog(run_dir / "metrics.csv", state["columns"], state["metrics"])
        self._episodes = CsvLog(run_dir / "episodes.csv", EPISODE_COLUMNS, state["episodes"])

    def episodes(self, batch: TensorDictBase, first_frame: int) -> dict[str, float]:
        """Write down the episodes that end in a batch [N, T]; return their means, none if none ends."""
        robots = batch.shape[0]
        after = batch.get("next")
        time, robot, _ = after.get("done").transpose(0, 1).nonzero(as_tuple=True)
        if not len(time):
            return {}
        frames = first_frame + (time + 1) * robots
        rewards = after.get("episode_rewards")[robot, time]
        returns = rewards.sum(dim=1)
        lengths = after.get("episode_length")[robot, time, 0]
        success = after.get("success")[robot, time, 0]
        for row in zip(frames.tolist(), returns.tolist(), lengths.tolist(), success.int().tolist(), strict=True):
            self._episodes.write(**dict(zip(EPISODE_COLUMNS, row, strict=True)))
        return {
            "episode/return": float(returns.mean()),
            "episode/length": float(lengths.double().mean()),
            "episode/success_rate": float(success.double().mean()),
            **dict(zip(self._rewards, rewards.double().mean(dim=0).tolist(), strict=True)),
        }

    def open(self) -> None:
        """Make the logger, unless it is there."""
        if self._logger is None:
            self._logger = self._make_logger()

    def metrics(self, frames: int, iteration: int, values: dict[str, float]) -> None:
        """Write down an iteration."""
        if self._metrics is None:
            episode = ("episode/return", "episode/length", "episode/success_rate", *self._rewards)
            rest = [key for key in values if key not in (*episode, *EVALUATION_COLUMNS, *TIME_COLUMNS)]
            columns = ["frames", "iteration", *episode, *rest, *EVALUATION_COLUMNS, *TIME_COLUMNS]
            self._metrics = CsvLog(self._run_dir / "metrics.csv", columns)
        self._metrics.write(frames=frames, iteration=iteration, **values)
        self._metrics.flush()
        self._episodes.flush()
        self.open()
        self._logger.log_metrics(values, step=frames)

    def state(self) -> dict[str, Any]:
        """Bring everything to the disk and return what continues the files from here."""
        metrics = self._metrics
        return {
            "metrics": 0 if metrics is None else metrics.position(),
            "columns": [] if metrics is None else list(metrics.columns),
            "episodes": self._episodes.position(),
        }

    def close(self) -> None:
        """Close the files."""
        self._episodes.close()
        if self._metrics is not None:
            self._metrics.close()
        if self._logger is not None:
            self._logger.close()
