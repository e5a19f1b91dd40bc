"""The pages as a whole: short, complete, and a site without warnings."""

import ast
import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import FILES, PAGES, ROOT, hooks, prose

HOOKS = hooks()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 1500


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_lines_outside_of_tables_are_of_one_width(path):
    for number, line in enumerate(path.read_text().splitlines(), 1):
        assert len(line) <= 120 or line.lstrip().startswith("|"), number


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_links_of_pages_outside_of_the_site_lead_somewhere(name):
    links = [link for link in re.findall(r"\]\(([^)]+)\)", prose(ROOT / name)) if "://" not in link]
    assert links
    for link in links:
        assert (ROOT / link.partition("#")[0]).exists(), link


def test_each_row_of_the_tables_of_faults_has_a_test_that_names_it_and_no_test_names_another():
    text = (ROOT / "docs" / "faults.md").read_text()
    tables = re.findall(r"\| what happens \|[^\n]*\n\|[-|]+\|\n((?:\|.*\|\n)+)", text)
    rows = [row.split(" | ")[0].removeprefix("| ") for table in tables for row in table.splitlines()]
    assert len(rows) == len(set(rows)) > 30
    named = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.fault":
                named.add(ast.literal_eval(node.args[0]))
    assert named == set(rows)


@pytest.mark.parametrize("name", HOOKS["PARAMETERS"])
def test_each_parameter_is_in_the_table_that_a_page_asks_for(name):
    asked = [path for path in PAGES if f"<!-- parameters: {name} -->" in path.read_text()]
    assert len(asked) == 1
    others = {"inference_node": ("controller",), "excite": ("inference_node", "controller")}.get(name, ())
    tables = [HOOKS["parameters"](each).splitlines() for each in (name, *others)]
    for field in dataclasses.fields(HOOKS["parameter_class"](name)):
        found = [[line for line in table if line.startswith(f"| `{field.name}`")] for table in tables]
        (row,) = next(rows for rows in found if rows)
        assert field.metadata["description"].replace("<", "&lt;") in row
        assert field.metadata["unit"] in row
        assert ("\\*" in row) == field.metadata["fixed"]


def test_a_page_that_asks_for_a_table_that_there_is_not_is_named():
    with pytest.raises(ValueError, match="<!-- parameter: record -->: there are only parameters, configuration"):
        HOOKS["on_page_markdown"]("<!-- parameter: record -->")


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_has_what_is_made_from_the_code(tmp_path):
    result = build(tmp_path)
    assert result.returncode == 0, result.stdout
    pages = {name: (tmp_path / name / "index.html").read_text() for name in ("deploy", "extending")}
    pages |= {name: (tmp_path / "reference" / name / "index.html").read_text() for name in ("configuration", "python")}
    assert "resume_timeout" in pages["deploy"]
    assert "long_arm" in pages["extending"]
    for path in (ROOT / "conf").rglob("*.yaml"):
        assert path.relative_to(ROOT / "conf").as_posix() in pages["configuration"]
    assert "physai.tasks.Reach" in pages["python"]
    assert ":class:" not in pages["python"]


def build(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
