"""The measurement of single commands runs, and shows every form of a policy."""

import shutil

import pytest
from rich.console import Console

from physai.bench import policy


@pytest.mark.slow
def test_every_form_is_timed_and_shown(monkeypatch, exported_run, recurrent_run):
    exported = {"mlp": exported_run, "gru": recurrent_run}  # how it makes them: tests/bench/test_ros.py
    monkeypatch.setattr(
        policy, "make_run", lambda run, *_: shutil.copytree(exported[run.name], run, dirs_exist_ok=True)
    )
    monkeypatch.setattr(policy, "ROUNDS", 2)
    monkeypatch.setattr(policy, "CALLS", 20)
    times, load = policy.measure_policy(seed=0)
    assert len(times) == 9
    assert all(len(seconds) == 40 and (seconds > 0).all() for seconds in times.values())
    assert 0 < load < 5
    console = Console(width=120, record=True)
    console.print(policy.policy_table(times, load))
    shown = console.export_text()
    for part in ("stock actor", "policy.pt", "ONNX Runtime", "policy=gru: policy.pt", "µs", "1.00"):
        assert part in shown
