import csv

import torch
from tensordict import TensorDict

from physai.training.logs import CsvLog, RunLog


class Scalars:
    """A logger in TorchRL's sense that keeps what it is given."""

    def __init__(self):
        self.rows = []

    def log_metrics(self, metrics, step=None):
        self.rows += [(step, name, value) for name, value in metrics.items()]

    def close(self):
        pass


def rows(path):
    with open(path) as file:
        return list(csv.DictReader(file))


def batch():
    """Two robots, three steps; robot 1 reaches its goal at step 0, robot 0 runs out of time at step 2."""
    done = torch.tensor([[False, False, True], [True, False, False]])[..., None]
    terminated = torch.tensor([[False, False, False], [True, False, False]])[..., None]
    returns = torch.tensor([[-1.0, -2.0, -3.0], [9.0, -1.0, -2.0]])[..., None]
    length = torch.tensor([[198, 199, 200], [40, 1, 2]])[..., None]
    rewards = torch.cat([returns - 1.0, torch.ones_like(returns)], dim=-1)
    after = {"done": done, "success": terminated, "episode_rewards": rewards, "episode_length": length}
    return TensorDict({"next": TensorDict(after, [2, 3])}, [2, 3])


def test_an_episode_is_written_with_the_frame_at_which_it_ended(tmp_path):
    log = RunLog(tmp_path, ("distance", "bonus"), Scalars)
    means = log.episodes(batch(), first_frame=100)
    log.close()
    assert means == {
        "episode/return": 3.0,
        "episode/length": 120.0,
        "episode/success_rate": 0.5,
        "reward/distance": 2.0,
        "reward/bonus": 1.0,
    }
    assert rows(tmp_path / "episodes.csv") == [
        {"frame": "102", "return": "9.0", "length": "40", "success": "1"},
        {"frame": "106", "return": "-3.0", "length": "200", "success": "0"},
    ]


def test_a_resumed_log_forgets_what_came_after_its_checkpoint(tmp_path):
    log = RunLog(tmp_path, ("distance", "bonus"), Scalars)
    log.metrics(10, 1, {"loss": 0.5})
    state = log.state()
    log.metrics(20, 2, {"loss": 0.4})
    log.episodes(batch(), first_frame=20)
    log.close()
    again = RunLog(tmp_path, ("distance", "bonus"), Scalars, state)
    again.metrics(20, 2, {"loss": 0.3})
    again.close()
    assert [(row["frames"], row["loss"]) for row in rows(tmp_path / "metrics.csv")] == [
        ("10", "0.5"),
        ("20", "0.3"),
    ]
    assert rows(tmp_path / "episodes.csv") == []


def test_every_value_reaches_the_logger_at_its_frame(tmp_path):
    scalars = Scalars()
    log = RunLog(tmp_path, ("distance", "bonus"), lambda: scalars)
    log.metrics(10, 1, {"loss": 0.5, "evaluation/success_rate": 1.0})
    log.close()
    assert scalars.rows == [(10, "loss", 0.5), (10, "evaluation/success_rate", 1.0)]


def test_a_logger_is_made_once_and_not_before_it_is_needed(tmp_path):
    made = []
    log = RunLog(tmp_path, ("distance", "bonus"), lambda: made.append(Scalars()) or made[-1])
    log.episodes(batch(), first_frame=0)
    log.state()
    assert not made
    log.open()
    log.metrics(10, 1, {"loss": 0.5})
    log.metrics(20, 2, {"loss": 0.4})
    log.close()
    assert [len(one.rows) for one in made] == [2]


def test_missing_columns_stay_empty(tmp_path):
    log = CsvLog(tmp_path / "a.csv", ["a", "b"])
    log.write(b=1)
    log.close()
    assert (tmp_path / "a.csv").read_text().splitlines() == ["a,b", ",1"]
