"""Each command that a page shows would be accepted."""

import re

import pytest
import yaml

from physai.compose import compose
from physai.config import validate
from physai.deploy import State
from physai.errors import UserError
from physai.training.config import TrainConfig
from tests.docs.blocks import FILES, PAGES, ROOT, Block, blocks, commands, hooks, prose, shown_files
from tests.docs.command_lines import SOURCES, check, exists, parameter_class
from tests.docs.test_cpp import COMPILER

HOOKS = hooks()
EXAMPLES = shown_files("CONTRIBUTING.md") | shown_files("docs/walk.md")
BROUGHT = ("collector", "env", "experiment", "logger", "policy", "randomization")
CONSOLE = {block.text.splitlines()[0]: block for block in blocks("console")}


@pytest.mark.slow
@pytest.mark.parametrize("block", [block for block in blocks("bash") if COMPILER not in block.text], ids=str)
def test_each_command_exists_and_takes_what_it_is_given(block):
    for words in commands(block.text):
        check(words)


def test_each_block_is_of_a_language_that_a_test_looks_at():
    tested = {"python", "bash", "console", "yaml", "mermaid", "text"}
    for block in blocks():
        assert block.language in tested or block.text in EXAMPLES.values(), block


@pytest.mark.parametrize("block", [block for block in blocks("yaml") if block.text not in EXAMPLES.values()], ids=str)
def test_each_parameter_file_is_accepted(block):
    for node, values in yaml.safe_load(block.text).items():
        parameter_class(node)(**values["ros__parameters"])


def test_a_misspelt_key_is_answered_as_shown():
    (command,) = [command for command in CONSOLE if "physai.train" in command]
    with pytest.raises(UserError) as error:
        validate(TrainConfig, compose("train", command.split()[4:]))
    assert CONSOLE[command].text.splitlines()[1:] == [f"error: {error.value}"]


def test_an_export_says_what_is_shown(exported_run):
    (command,) = [command for command in CONSOLE if "physai.export" in command]

    def without_numbers(text: str) -> list[str]:
        text = re.sub(r"\d[\d,.]*(?:e-\d+)?", "#", text.replace(str(exported_run), "outputs/<run>"))
        return text.splitlines()

    shown = without_numbers(CONSOLE[command].text)[1:]
    assert without_numbers((exported_run / "export.txt").read_text())[: len(shown)] == shown


def test_no_console_block_is_left_out():
    assert len(CONSOLE) == 2


def mermaid(page: str) -> str:
    (block,) = [block for block in blocks("mermaid") if block.page == page]
    return block.text


def test_the_diagram_of_states_has_all_states_of_the_controller():
    assert set(re.findall(r"\b[A-Z]{4,}\b", mermaid("docs/deploy.md"))) == {state.name for state in State}


def test_the_diagram_of_nodes_has_only_names_that_exist():
    names = re.findall(r"[~/][\w/]*/?[a-z_]+", " ".join(re.findall(r'"[^"]*"|\(\[.*?\]\)', mermaid("docs/ros2.md"))))
    topics = [name for name in names if "/" in name]
    assert len(topics) > 6
    for name in topics:
        assert exists(name), name


def test_the_drawing_of_the_packages_has_only_packages_and_commands():
    (block,) = blocks("text")
    for word in re.findall(r"\w+", block.text.split("ros:")[0]):
        assert (ROOT / "physai" / word).is_dir() or word == "commands", word


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_topics_services_and_choices_in_the_text_exist(path):
    shown = re.findall(r"`([^`\n]+)`", prose(path))
    for name in shown:
        if re.fullmatch(r"(~|/\w+)?/[a-z_]+", name) and name.removeprefix("/") not in HOOKS["PARAMETERS"]:
            assert exists(name), name
        for group, choice in re.findall(r"\b(\w+)=(\w+)", name):
            if group in BROUGHT:
                file = f"conf/{group}/{choice}.yaml"
                assert file in EXAMPLES or (ROOT / file).is_file(), name


def test_files_of_the_project_in_the_text_exist():
    for path in PAGES:
        for name in re.findall(r"`((?:physai|conf|docs|tests)/[\w/.]+)`", prose(path)):
            assert name in EXAMPLES or (ROOT / name).exists(), f"{path}: {name}"


def test_sources_are_read():
    assert "class Controller" in SOURCES
    assert isinstance(blocks()[0], Block)
