"""The README's Python examples do what they show."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.slow
def test_the_environments_of_the_readme_can_be_used_as_shown(capsys):
    (block,) = [block for block in BLOCKS if "make_env" in block]
    exec(block, {})
    assert "torch.Size([64, 100, 8])" in capsys.readouterr().out


@pytest.mark.slow
def test_the_controller_of_the_readme_reaches_its_goal(exported_run, monkeypatch, capsys):
    (block,) = [block for block in BLOCKS if "load_policy" in block]
    monkeypatch.chdir(exported_run)
    exec(block, {})
    printed = capsys.readouterr().out
    assert "('joint1', 'joint2') (0.3, 0.53) 50.0" in printed
    assert "State.REACHED" in printed
