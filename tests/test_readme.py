"""The README's Python examples do what they show."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest

from physai.ros.command_watchdog import WatchdogConfig
from physai.ros.inference_node import InferenceConfig
from physai.ros.record import RecordConfig
from physai.ros.virtual_robot import VirtualRobotConfig

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


def test_each_row_of_the_tables_of_faults_has_a_test_that_names_it_and_no_test_names_another():
    tables = re.findall(r"\| what happens \|[^\n]*\n\|[-|]+\|\n((?:\|.*\|\n)+)", README)
    rows = [row.split(" | ")[0].removeprefix("| ") for table in tables for row in table.splitlines()]
    assert len(rows) == len(set(rows)) > 30
    named = set()
    for path in Path(__file__).parent.rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.fault":
                named.add(ast.literal_eval(node.args[0]))
    assert named == set(rows)


def parameter_tables() -> dict[str, list[list[str]]]:
    """Rows of the README's tables of ROS parameters, by node."""
    tables = re.findall(r"\| (\w+) \| default \| unit \| \|\n\|[-|]+\|\n((?:\|.*\|\n)+)", README)
    return {
        node: [[cell.strip() for cell in row.strip("|").split("|")] for row in rows.splitlines()]
        for node, rows in tables
    }


@pytest.mark.parametrize(
    ("node", "kind"),
    [
        ("record", RecordConfig),
        ("inference_node", InferenceConfig),
        ("virtual_robot", VirtualRobotConfig),
        ("command_watchdog", WatchdogConfig),
    ],
)
def test_the_readme_names_every_parameter_of_a_node_with_its_default_and_unit(node, kind):
    shown = {row[0]: row[1:] for row in parameter_tables()[node]}
    expected = {}
    for field in dataclasses.fields(kind):
        default = field.default
        text = f"{default:g}" if isinstance(default, float) else str(default)
        text = "as above" if field.name == "topics" else text
        text = "" if default in ("", ()) else text.lower() if isinstance(default, bool) else text
        star = " *" if field.metadata["fixed"] else ""
        expected[f"`{field.name}`{star}"] = [text, field.metadata["unit"], field.metadata["description"]]
    assert shown == expected
