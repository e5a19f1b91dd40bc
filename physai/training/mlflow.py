"""Runs in MLflow."""

import logging
import os
from pathlib import Path

import mlflow  # where it is missing, this module is, and a config that names it is refused
from torchrl.record import loggers

from physai.files import write_atomically

logging.getLogger("mlflow").setLevel(logging.WARNING)  # at INFO it reports every table of a new database


class MLFlowLogger(loggers.MLFlowLogger):
    """TorchRL's logger, which goes on with the same run there when a run is resumed.

    Args:
        exp_name: The experiment there.
        log_dir: The run folder; ``mlflow.txt`` in it keeps the id of the run there.
        tracking_uri: A server or database; None is a database in the run folder.
    """

    def __init__(self, exp_name: str, log_dir: str, tracking_uri: str | None) -> None:
        folder = Path(log_dir).absolute()
        known = folder / "mlflow.txt"
        if known.is_file():
            os.environ["MLFLOW_RUN_ID"] = known.read_text().strip()  # MLflow goes on with this one
        artifacts = None if tracking_uri else (folder / "mlflow").as_uri()
        super().__init__(exp_name, tracking_uri or f"sqlite:///{folder}/mlflow.db", artifact_location=artifacts)
        write_atomically(known, f"{self.experiment.info.run_id}\n".encode())
        mlflow.set_tag("mlflow.runName", log_dir)

    def shutdown(self, timeout: float | None = None) -> None:
        """End the run."""
        mlflow.end_run()
