"""The Python that pages show runs, and does what it shows."""

import time

import pytest

from physai.deploy import load_policy
from tests.docs.blocks import Block, blocks

ROS = "rclpy.init()"  # tests/ros/test_documented_goal.py runs this one
REMEMBERS = "memory_size"  # for a policy that remembers
RUN = [block for block in blocks("python") if ROS not in block.text and block.page != "CONTRIBUTING.md"]


class Clock:
    """Time that passes while somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        self.now += 1e-6
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def run(exported_run, monkeypatch, capsys):
    """Run blocks of a page one after the other where a policy.pt is; return what they print."""
    clock = Clock()
    monkeypatch.chdir(exported_run)
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    monkeypatch.setattr(time, "sleep", clock.sleep)

    def run(page: str) -> str:
        names: dict[str, object] = {}
        for block in (block for block in RUN if block.page == page and REMEMBERS not in block.text):
            exec(compile("\n" * block.line + block.text, block.page, "exec"), names)
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_the_readme_makes_environments_and_reaches_a_goal(run):
    printed = run("README.md")
    assert "torch.Size([64, 100, 8])" in printed
    assert "State.REACHED" in printed


@pytest.mark.slow
def test_environments_of_the_page_on_training_can_be_used_as_shown(run):
    printed = run("docs/train.md")
    assert "link_mass" in printed
    assert printed.splitlines()[-1].endswith(", 3)")  # an image


@pytest.mark.slow
def test_the_page_on_deployment_loads_a_policy_and_reaches_a_goal(run):
    printed = run("docs/deploy.md")
    assert "('joint1', 'joint2') Ring(inner=0.3, outer=0.53) 50.0" in printed
    assert "State.REACHED" in printed


@pytest.mark.slow
def test_a_policy_that_remembers_is_called_as_shown(recurrent_run, monkeypatch):
    (block,) = [block for block in RUN if REMEMBERS in block.text]
    names = {"policy": load_policy(recurrent_run / "policy.pt")}
    exec(block.text, names)
    assert len(names["memory"]) == names["policy"].metadata.memory_size > 0


@pytest.mark.slow
def test_the_page_on_watching_draws_two_arms_from_a_policy_file(run):
    assert "http://127.0.0.1:" in run("docs/live.md")


def test_every_page_with_python_is_run():
    pages = {"README.md", "docs/train.md", "docs/deploy.md", "docs/extending.md", "docs/live.md"}
    assert {block.page for block in RUN} == pages
    assert all(isinstance(block, Block) for block in RUN)
