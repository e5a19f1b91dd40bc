"""Runs on Weights & Biases."""

import uuid
from pathlib import Path

import wandb  # where it is missing, this module is, and a config that names it is refused
from torchrl.record import loggers

from physai.files import write_atomically


class WandbLogger(loggers.WandbLogger):
    """TorchRL's logger, which goes on with the same run there when a run is resumed.

    Args:
        exp_name: The run's group there.
        log_dir: The run folder; ``wandb.txt`` in it keeps the id of the run there.
        project: The project.
        offline: Keep everything in the run folder, until ``wandb sync``.
    """

    def __init__(self, exp_name: str, log_dir: str, project: str, offline: bool) -> None:
        known = Path(log_dir) / "wandb.txt"
        if not known.is_file():
            write_atomically(known, f"{uuid.uuid4().hex[:12]}\n".encode())
        settings = wandb.Settings(console="off")  # a run's output stays its own
        super().__init__(
            log_dir, offline, log_dir, known.read_text().strip(), project, group=exp_name, settings=settings
        )
