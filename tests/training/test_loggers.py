"""Where a run is logged besides its CSV files: each logger for real, and offline."""

import sys

import pytest

from physai.errors import UserError
from physai.training.agent import make_logger
from physai.training.logs import RunLog
from tests.training.small import small_config
from tests.waiting import wait_for


def log(config, run, frames):
    """A part of a run, from its start or where it is resumed, to its end."""
    logger = make_logger(config, run)
    written = RunLog(run, (), lambda: logger)
    written.metrics(frames, 1, {"loss_objective": 0.5 * frames, "evaluation/success_rate": 1.0})
    written.close()
    return logger


@pytest.mark.slow
def test_mlflow_keeps_config_and_metrics_and_a_resumed_run_goes_on_there(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    config = small_config("logger=mlflow", "algo.optimizer.lr=0.002")
    first = log(config, tmp_path, 10)
    second = log(config, tmp_path, 20)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")
    (run,) = client.search_runs([first.id])
    assert first.experiment.info.run_id == second.experiment.info.run_id == run.info.run_id
    assert run.info.status == "FINISHED"
    assert run.data.params["algo.optimizer.lr"] == "0.002"
    history = client.get_metric_history(run.info.run_id, "loss_objective")
    assert [(point.step, point.value) for point in history] == [(10, 5.0), (20, 10.0)]


@pytest.mark.slow
def test_mlflow_takes_a_database_that_runs_share(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    shared = f"sqlite:///{tmp_path}/shared.db"
    config = small_config("logger=mlflow", f"logger.tracking_uri={shared}")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        experiment = log(config, tmp_path / name, 10).id
    runs = mlflow.MlflowClient(shared).search_runs([experiment])
    assert sorted(run.info.run_name for run in runs) == [f"{tmp_path}/a", f"{tmp_path}/b"]


@pytest.mark.slow
def test_wandb_keeps_config_and_metrics_and_a_resumed_run_has_the_same_id(tmp_path):
    pytest.importorskip("wandb")
    config = small_config("logger=wandb", "logger.offline=true")
    ids = [log(config, tmp_path, frames)._wandb_kwargs["id"] for frames in (10, 20)]
    assert ids[0] == ids[1]

    def written():
        parts = [path.read_bytes() for path in (tmp_path / "wandb").glob(f"offline-run-*/run-{ids[0]}.wandb")]
        return [b"algo.optimizer.lr" in part and b"evaluation/success_rate" in part for part in parts]

    # A process of wandb's own writes them.
    wait_for(lambda: written() and all(written()), 30, lambda: f"parts of a run to be complete: {written()}")


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_names_what_installs_it(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, f"physai.training.{name}", raising=False)
    with pytest.raises(UserError, match=rf"needs '{name}', which is not installed: pip install 'physai\[{name}\]'"):
        small_config(f"logger={name}")
