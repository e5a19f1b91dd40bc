"""Whether a command that a page shows would be accepted: its module, its options, its values."""

import re
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import pytest
import tomllib
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from physai.bench.__main__ import _options
from physai.capsules import CapsulesConfig
from physai.compose import compose
from physai.config import validate
from physai.envs.simulation import EnvConfig
from physai.evaluate import EvaluateConfig
from physai.export import ExportConfig
from physai.identify.__main__ import IdentifyConfig
from physai.play import PlayConfig
from physai.plot import PlotConfig
from physai.ros.demo import DemoConfig
from physai.ros.fleet import FleetConfig
from physai.ros.topics.commands import controller_topic
from physai.search.config import SearchConfig
from physai.signals import Quantity
from physai.stress.__main__ import StressConfig
from physai.training.config import TrainConfig
from tests.composed import composed
from tests.docs.blocks import ROOT, hooks

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PACKAGE = ROOT / "physai" / "ros" / "package"
SOURCES = "\n".join(path.read_text() for path in sorted((ROOT / "physai").rglob("*.py")))
COMMANDS = {
    "physai.train": ("train", TrainConfig),
    "physai.search": ("search", SearchConfig),
    "physai.stress": ("stress", StressConfig),
    "physai.identify": ("identify", IdentifyConfig),
    "physai.evaluate": ("evaluate", EvaluateConfig),
    "physai.export": ("export", ExportConfig),
    "physai.play": ("play", PlayConfig),
    "physai.capsules": ("capsules", CapsulesConfig),
    "physai.plot": ("plot", PlotConfig),
    "physai.ros.demo": ("demo", DemoConfig),
    "physai.ros.fleet": ("fleet", FleetConfig),
}
parameter_class: Callable[[str], Any] = hooks()["parameter_class"]  # type: ignore[assignment]


def check(words: Sequence[str]) -> None:
    """Raise an error if there is no such command, or if it would refuse what it is given."""
    match list(words):
        case ["python", "-m", module, *rest] if module in COMMANDS:
            _check_hydra(*COMMANDS[module], rest)
        case ["python", "-m", module, "--ros-args", *rest]:
            _check_node(module.removeprefix("physai.ros."), rest)
        case ["python", "-m", module]:
            parameter_class(module.removeprefix("physai.ros."))
        case ["make", target, *rest]:
            _check_make(target, rest)
        case ["pip" | ".venv/bin/pip", "install", *rest]:
            _check_pip(rest)
        case ["export", assignment]:
            assert assignment.partition("=")[0] in SOURCES + (ROOT / "pyproject.toml").read_text()
        case ["ros2", *rest]:
            _check_ros2(rest)
        case ["ray", name, *rest]:
            from ray.scripts.scripts import cli  # it takes two seconds to import

            cli.commands[name].make_context(name, list(rest))
        case _:
            pytest.fail(f"nobody knows how to check {' '.join(words)}")


def jobs(overrides: Sequence[str]) -> list[list[str]]:
    """Overrides of single runs such that each choice of a sweep, and one end of each interval, is in one of them."""
    choices = []
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if not override.is_sweep_override():
            choices.append([str(override.input_line)])
        elif override.is_discrete_sweep():
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            choices.append([f"{key}={override.value().start}"])  # type: ignore[union-attr]
    return [[values[min(job, len(values) - 1)] for values in choices] for job in range(max(map(len, choices)))]


def _check_hydra(name: str, model: Any, given: Sequence[str]) -> None:
    flags = {word for word in given if word.startswith("-")}
    assert flags <= {"-m", "--help"}, flags
    overrides = [word for word in given if word not in flags and not word.startswith("resume=")]
    for job in jobs(overrides) if overrides else [[]]:
        _check_job(name, model, *job)


@cache  # many pages begin with the same command
def _check_job(name: str, model: Any, *overrides: str) -> None:
    config = compose(name, overrides, hydra=True)
    OmegaConf.to_container(config.hydra.launcher, resolve=False)
    validated = validate(model, OmegaConf.masked_copy(config, [key for key in config if key != "hydra"]))
    if isinstance(getattr(validated, "env", None), dict):
        engine = validated.env["physics"] or composed().physics  # None stands for that of the run
        validate(EnvConfig, DictConfig(validated.env | {"physics": engine}))


def _check_node(node: str, given: Sequence[str]) -> None:
    parameters = {}
    rest = list(given)
    while rest:
        option, value = rest.pop(0), rest.pop(0)
        name, _, meaning = value.partition(":=")
        if option == "-p":
            parameters[name] = yaml.safe_load(meaning)
        elif option == "-r":
            assert name in SOURCES or exists(name), name
            assert meaning.startswith("/")
        else:
            assert option == "--params-file", option
            assert value.endswith(".yaml")
    parameter_class(node)(**parameters)


def _check_make(target: str, given: Sequence[str]) -> None:
    assert re.search(rf"^{target}:.*##", (ROOT / "Makefile").read_text(), re.MULTILINE), target
    values = dict(one.split("=", 1) for one in given)
    assert set(values) <= {"ARGS", "PYTHON"}
    if "ARGS" in values:
        assert target == "bench", f"nobody knows how to check ARGS of make {target}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", ["bench", *values["ARGS"].split()])
            assert _options().parts


def _check_pip(given: Sequence[str]) -> None:
    for word in given:
        if extras := re.fullmatch(r"(?:physai|\.)\[(.*)\]", word):
            assert set(extras[1].split(",")) <= set(PYPROJECT["optional-dependencies"]), word
        elif word.endswith(".whl"):
            assert word == f"physai-{PYPROJECT['version']}-py3-none-any.whl"
        elif not word.startswith("-"):
            needed = {re.split(r"[^\w-]", one)[0] for one in PYPROJECT["dependencies"]}
            assert word in needed | {"constraints.txt"}, word


def _check_ros2(given: Sequence[str]) -> None:
    match list(given):
        case ["launch", "physai", file, *values]:
            arguments = re.findall(r'(?:Argument|switch)\(\s*"(\w+)"', (PACKAGE / "launch" / file).read_text())
            assert {value.partition(":=")[0] for value in values} <= set(arguments)
        case ["run", "physai", node, "--ros-args", *rest]:
            assert (PACKAGE / "lib" / node).is_file()
            _check_node(node, rest)
        case ["topic", "pub", "--once", topic, kind, fields] | ["topic", "pub", "--rate", _, topic, kind, fields]:
            assert exists(topic), topic
            _fill(_message(kind)(), yaml.safe_load(fields))
        case ["service", "call", service, kind, fields]:
            assert exists(service), service
            _fill(_message(kind).Request(), yaml.safe_load(fields))
        case _:
            pytest.fail(f"nobody knows how to check ros2 {' '.join(given)}")


def exists(name: str) -> bool:
    """Whether the code knows a topic or service; those of a node are ``~/name`` there."""
    relative = re.sub(r"^/(arm\d+/)?", "", name)
    node, _, private = relative.partition("/")
    if relative in (controller_topic(Quantity.JOINT_VELOCITY), controller_topic(Quantity.JOINT_POSITION)):
        return True
    return (
        f'"{name}"' in SOURCES
        or f'"{relative}"' in SOURCES
        or (node in hooks()["PARAMETERS"] and f'"~/{private}"' in SOURCES)
    )  # type: ignore[operator]


def _message(kind: str) -> Any:
    package, folder, name = kind.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


def _fill(message: Any, fields: dict[str, Any]) -> None:
    for name, value in fields.items():
        if isinstance(value, dict):
            _fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
