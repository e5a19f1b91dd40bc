import os
import pickle

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from physai.errors import UserError
from physai.training.checkpoint import CheckpointFolder, load, save


def content(value: float) -> dict:
    return {"weights": torch.full((1000,), value), "frames": 3}


def test_what_is_saved_comes_back(tmp_path):
    save(tmp_path / "a.pt", content(1.5))
    loaded = load(tmp_path / "a.pt")
    assert torch.equal(loaded["weights"], torch.full((1000,), 1.5))
    assert loaded["frames"] == 3


def test_only_the_last_few_are_kept_and_the_best_always(tmp_path):
    folder = CheckpointFolder(tmp_path, keep=2)
    save(folder.best, content(0))
    for frames in (0, 1000, 2000, 10000):
        folder.save(frames, content(frames))
    assert [int(path.stem) for path in folder.paths()] == [2000, 10000]
    assert folder.find("best") == folder.best
    assert load(folder.find("last"))["weights"][0] == 10000
    assert load(folder.find("2000"))["weights"][0] == 2000
    with pytest.raises(UserError, match="no checkpoint '7'; there are: best, 2000, 10000"):
        folder.find("7")


def test_a_missing_file_and_another_kind_of_file_are_named(tmp_path):
    with pytest.raises(UserError, match="no such checkpoint"):
        load(tmp_path / "a.pt")
    torch.save({"weights": torch.ones(1)}, tmp_path / "b.pt")
    with pytest.raises(UserError, match="not a checkpoint of this version"):
        load(tmp_path / "b.pt")


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_code_in_a_file_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"format": 1, "x": Bomb()}, "a.pt", pickle_module=pickle)
    with pytest.raises(UserError, match="damaged"):
        load(tmp_path / "a.pt")
    assert not (tmp_path / "exploded").exists()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "a.pt"
    save(path, content(1.0))
    return path


@given(length=st.floats(0, 0.999))
def test_a_file_cut_anywhere_is_called_damaged(good, length):
    data = good.read_bytes()
    cut = good.with_name("cut.pt")
    cut.write_bytes(data[: int(len(data) * length)])
    with pytest.raises(UserError, match="damaged"):
        load(cut)
