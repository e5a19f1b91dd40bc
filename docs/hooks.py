"""MkDocs hooks: tables that are made from the code, where a page has a comment that asks for one.

``<!-- parameters: inference_node -->`` becomes the table of a node's parameters, and ``<!-- configuration -->`` all
files of ``conf/``. They are made anew at each build, so they cannot differ from the code.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

import yaml

from physai.compose import conf_dir
from physai.deploy.parameters import Parameters

PARAMETERS = {
    "controller": "physai.deploy.parameters.ControllerConfig",
    "inference_node": "physai.ros.inference_node.InferenceConfig",
    "command_watchdog": "physai.ros.command_watchdog.WatchdogConfig",
    "virtual_robot": "physai.ros.virtual_robot.VirtualRobotConfig",
    "excite": "physai.ros.excite.ExciteConfig",
    "record": "physai.ros.record.RecordConfig",
    "foxglove": "physai.ros.foxglove.FoxgloveConfig",
    "dashboard": "physai.ros.dashboard.DashboardConfig",
}
"""The dataclass that a table is made from, by the name that a page uses."""

_ASKED = re.compile(r"^<!-- (\w+)(?:: (\w+))? -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the tables into a page.

    Raises:
        ValueError: If a page asks for what there is not.
    """

    def made(asked: re.Match[str]) -> str:
        if asked[1] not in _TABLES:
            raise ValueError(f"{asked[0]}: there are only {', '.join(_TABLES)}")
        return _TABLES[asked[1]](*([asked[2]] if asked[2] else []))

    return _ASKED.sub(made, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Take the roles of Sphinx out of docstrings: ``:func:`x` `` becomes ``x``."""
    return re.sub(r":(?:attr|class|func|meth|mod):<code>~?", "<code>", html)


def parameter_class(name: str) -> type[Parameters]:
    """The dataclass of a controller or node."""
    module, _, kind = PARAMETERS[name].rpartition(".")
    found: type[Parameters] = getattr(import_module(module), kind)
    return found


def parameters(name: str) -> str:
    """A table of parameters: name, default, unit, what is allowed, and meaning.

    Args:
        name: One of ``PARAMETERS``. What it has from the controller or the inference node is left out, unless it has
            another default: these have tables of their own.
    """
    kind = parameter_class(name)
    bases = [base for base in map(parameter_class, ("controller", "inference_node")) if base in kind.__mro__[1:]]
    inherited = {(field.name, field.default) for base in bases for field in dataclasses.fields(base)}
    lines = ["| parameter | default | unit | allowed | meaning |", "|---|---|---|---|---|"]
    for field in dataclasses.fields(kind):
        if (field.name, field.default) in inherited:
            continue
        star = " \\*" if field.metadata["fixed"] else ""
        cells = [f"`{field.name}`{star}", _default(field.default), field.metadata["unit"], _allowed(field)]
        lines.append(f"| {' | '.join([*cells, field.metadata['description'].replace('<', '&lt;')])} |")
    return "\n".join(lines)


def configuration() -> str:
    """Every file of ``conf/``: a section for each group, with what its files say about themselves."""
    groups: dict[str, list[Any]] = {}
    for path in sorted(conf_dir().rglob("*.yaml")):
        groups.setdefault(path.parent.relative_to(conf_dir()).as_posix(), []).append(path)
    commands = groups.pop(".")
    parts = ["## Commands", *(_file(path) for path in commands)]
    for group, paths in groups.items():
        parts += [f"## {group}", *(_file(path) for path in paths)]
    return "\n\n".join(parts)


def _default(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "<br>".join(f"`{item}`" for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _allowed(field: "dataclasses.Field[Any]") -> str:
    low, high, choices = (field.metadata[key] for key in ("low", "high", "choices"))
    if choices:
        return " or ".join(f"`{choice}`" for choice in choices)
    if type(field.default) not in (int, float):
        return ""
    return f"{_number(low)} to {_number(high)}" if math.isfinite(high) else f"from {_number(low)}"


def _number(value: float) -> str:
    return f"{int(value):,}" if float(value).is_integer() else f"{value:g}"


def _file(path: Any) -> str:
    text = path.read_text()
    yaml.safe_load(text)  # a page never shows a file that nothing can read
    comment = re.search(r"^# (?!@)(.*)$", text.split("\n\n")[0], re.MULTILINE)
    title = f"{path.relative_to(conf_dir())}" + (f": {comment[1]}" if comment else "")
    indented = "\n".join(f"    {line}" if line else "" for line in text.rstrip().splitlines())
    title = title.replace('"', "'")
    return f'??? note "{title}"\n\n    ```yaml\n{indented}\n    ```'


_TABLES: dict[str, Callable[..., str]] = {"parameters": parameters, "configuration": configuration}
