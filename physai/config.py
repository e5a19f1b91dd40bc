"""Composing and checking configuration: values live in ``conf/``, types and ranges in models that inherit Config."""

import contextlib
import difflib
import functools
import importlib
import importlib.metadata
import inspect
import os
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigLoadError
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PydanticSchemaGenerationError,
    PydanticUndefinedAnnotation,
    TypeAdapter,
    ValidationError,
)

from physai.errors import UserError


class Config(BaseModel):
    """Base of all config models: no unknown keys, no silent conversions, no changes, and no defaults."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _whole(value: Any) -> Any:
    """Let people write 1e6 for a count."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Seed = Annotated[int, Field(ge=0, lt=2**32)]
Count = Annotated[int, BeforeValidator(_whole), Field(gt=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]

C = TypeVar("C", bound=Config)

_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")  # of a container: microseconds in each period of so many, or "max"


def _ceil_div(number: Any, divisor: Any) -> int:
    """Resolver ``${ceil_div:a,b}``; nonsense gives 1, for the key that holds it gets the blame when it is validated."""
    try:
        return max(1, -(-int(number) // int(divisor)))
    except (TypeError, ValueError, ZeroDivisionError):
        return 1


def cores() -> int:
    """How many cores this process may keep busy: those that it may run on, or its container's share of them."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = _CPU_MAX.read_text().split()
        return max(1, min(allowed, int(quota) // int(period)))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        return allowed


def _cores_of_job(threads: int, processes: int, sync: bool) -> int:
    """Resolver ``${cores_of_job:threads,processes,sync}``: what a run keeps busy; with ``sync``, it takes turns."""
    return max(1, threads, processes) if sync else threads + processes


def _jobs_at_once(threads: int, processes: int, sync: bool) -> int:
    """Resolver ``${jobs_at_once:threads,processes,sync}``: how many runs this computer's cores are enough for."""
    return max(1, cores() // _cores_of_job(threads, processes, sync))


def _add(number: int, other: int) -> int:
    """Resolver ``${add:a,b}``."""
    return number + other


def _search_space(algo: str) -> DictConfig:
    """Resolver ``${search_space:algo}``: what Optuna looks through; nothing for an algorithm without such a file."""
    path = conf_dir() / "hydra" / "search" / f"{algo}.yaml"
    return OmegaConf.load(path) if path.is_file() else OmegaConf.create({})


for _resolver in (_add, _ceil_div, _cores_of_job, _jobs_at_once, _search_space):
    OmegaConf.register_new_resolver(_resolver.__name__.lstrip("_"), _resolver)


# Hydra copies its sources at each of --help's 130 looks into a config group, and with them this register of all
# plugins' configs, which hands out copies anyway: more than half of the time of --help.
ConfigStore.__deepcopy__ = lambda self, _: self  # type: ignore[attr-defined]


def jobs_at_once(config: DictConfig) -> int:
    """How many runs with this config this computer's cores are enough for."""
    keys = {"threads": 1, "collector.processes": 1, "collector.sync": True}  # not all commands have these
    return _jobs_at_once(*(OmegaConf.select(config, key, default=value) for key, value in keys.items()))


def conf_dir() -> Path:
    """Return the folder of the YAML files: inside the installed package, or beside it in a checkout."""
    inside = Path(__file__).parent / "conf"
    return inside if inside.is_dir() else Path(__file__).parent.parent / "conf"


_PLUGINS = {
    "joblib": "joblib",
    "submitit_local": "submitit",
    "submitit_slurm": "submitit",
    "ray": "ray-launcher",
    "optuna": "optuna",
}
"""Launchers and sweepers of Hydra, and the extra that each comes with."""


@functools.cache
def set_plugin_defaults() -> None:
    """Give Hydra's launchers and sweepers, those that are installed, the values of ``conf/hydra/defaults``."""
    Plugins.instance()  # finds them
    store, folder = ConfigStore.instance(), conf_dir() / "hydra" / "defaults"
    for path in folder.glob("*/*.yaml"):
        group = f"hydra/{path.parent.name}"
        with contextlib.suppress(ConfigLoadError):
            plugin = store.load(f"{group}/{path.name}")
            values = {**OmegaConf.to_container(plugin.node), **OmegaConf.to_container(OmegaConf.load(path))}
            store.store(path.stem, values, group, provider=plugin.provider)


@contextlib.contextmanager
def initialized(name: str) -> Iterator[ConfigLoader]:
    """Context in which Hydra finds ``conf/``, for the command ``name``; gives what loads configs there."""
    with initialize_config_dir(str(conf_dir().absolute()), job_name=name, version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def compose(name: str, overrides: Iterable[str] = (), hydra: bool = False) -> DictConfig:
    """Compose ``conf/<name>.yaml`` with Hydra overrides.

    Args:
        name: A file in ``conf/``, without its ending.
        overrides: As on the command line, such as ``env=reacher`` or ``algo.optimizer.lr=1e-3``.
        hydra: Keep the ``hydra`` node.

    Raises:
        UserError: If an override is no override, or names a group, option or key that does not exist.
    """
    overrides = list(overrides)
    set_plugin_defaults()
    with initialized(name):
        try:
            return hydra_compose(name, overrides, return_hydra_config=hydra)
        except MissingConfigException as error:
            wanted = str(error.missing_cfg_file).rpartition("/")[2]
            if wanted in _PLUGINS:
                raise UserError(f"{error.missing_cfg_file}: pip install 'physai[{_PLUGINS[wanted]}]'") from None
            raise UserError(f"{error.missing_cfg_file}: no such config{nearest(wanted, error.options or [])}") from None
        except OverrideParseException as error:
            raise UserError(f"'{error.override}' is not an override such as key=value") from None
        except (HydraException, OmegaConfBaseException) as error:
            if exists := re.search(r"already at '([^']+)'", str(error)):
                raise UserError(f"'{exists[1]}' exists already: change it without the +") from None
            match = re.search(r"Could not (?:override|append to config|delete from config)[^']*'([^'=]+)", str(error))
            if match is None:
                match = re.search(r"Key '([^']+)'", str(error))
            if match is None or not overrides:
                raise UserError(" ".join(str(error).split())) from None
            key = match[1].split("@")[0]
            chosen = [one for one in overrides if (conf_dir() / one.partition("=")[0]).is_dir()]  # env=..., algo=...
            raise UserError(f"unknown key '{key}'{nearest(key, _keys(hydra_compose(name, chosen)))}") from None


def validate(model: type[C], node: DictConfig) -> C:
    """Turn a composed config into its typed model.

    Raises:
        UserError: One line that names the first bad key, what was expected, and what came.
    """
    try:
        data = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise UserError(f"{error.full_key}=... is required") from None
    except OmegaConfBaseException as error:
        raise UserError(" ".join(str(error).split())) from None
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            keys = [name for name in _keys(node) if name != key and not name.startswith(f"{key}.")]
            raise UserError(f"unknown key '{key}'{nearest(key, keys)}") from None
        if first["type"] == "missing":
            raise UserError(f"{key} is missing") from None
        if first["type"] == "value_error" and isinstance(first["ctx"]["error"], UserError | ValueError):
            raise UserError(f"{key}{first['ctx']['error']}") from None
        message = first["msg"][0].lower() + first["msg"][1:]
        raise UserError(f"{key}: {message}, got {first['input']!r}") from None


def nearest(name: str, options: Iterable[str]) -> str:
    """End of an error message: the option that the user most likely meant, or the options if they are few."""
    options = sorted(set(options))
    by_last = {option.rpartition(".")[2]: option for option in options}
    close = difflib.get_close_matches(name, options, n=1, cutoff=0.7)
    if not close:
        close = [by_last[last] for last in difflib.get_close_matches(name.rpartition(".")[2], by_last, n=1)]
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; there are: {', '.join(options)}" if 0 < len(options) <= 12 else ""


def not_installed(module: str) -> str:
    """End of an error message: the module that is missing, and what installs it."""
    for requirement in importlib.metadata.requires("physai") or []:
        name, _, extra = requirement.partition("extra == ")
        if extra and re.split(r"[^\w.-]", name)[0].lower().replace("-", "_") == module.partition(".")[0].lower():
            return f"'{module}', which is not installed: pip install 'physai[{extra.strip(' )')[1:-1]}]'"
    return f"'{module}', which is not installed"


def _keys(node: DictConfig, prefix: str = "") -> list[str]:
    keys = []
    for key in node:
        keys.append(f"{prefix}{key}")
        if not OmegaConf.is_missing(node, key) and isinstance(node._get_node(key), DictConfig):
            child = node._get_node(key)
            if child is not None and not child._is_none():
                keys += _keys(child, f"{prefix}{key}.")
    return keys


def _check_target(node: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Check the keys and simple values of a ``_target_`` node against the signature of what it names."""
    name = node.get("_target_")
    if not isinstance(name, str):
        raise ValueError(f"{path}: a _target_ is needed, such as torch.optim.Adam")
    target = _import(name, path)
    hints, is_open = _parameters(target)
    node = dict(node)
    for key, value in list(node.items()):
        if key in ("_target_", "_partial_"):
            continue
        if key not in hints and not is_open:
            raise ValueError(
                f": unknown key '{path.lstrip('.')}{'.' if path else ''}{key}' of {name}{nearest(key, hints)}"
            )
        if isinstance(value, Mapping) and "_target_" in value:
            node[key] = _check_target(dict(value), f"{path}.{key}")
        else:
            node[key] = _check_value(hints.get(key, Any), value, f"{path}.{key}")
    return node


def _import(name: str, path: str) -> Any:
    module, _, attribute = name.rpartition(".")
    while module:
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if not f"{module}.".startswith(f"{error.name}."):  # it is there, and needs what is not
                raise ValueError(f"{path}._target_: {name} needs {not_installed(error.name or module)}") from None
            outer, _, inner = module.rpartition(".")
            module, attribute = outer, f"{inner}.{attribute}"
            continue
        try:
            for part in attribute.split("."):
                found = getattr(found, part)
        except AttributeError:
            raise ValueError(
                f"{path}._target_: {module} has no '{attribute}'{nearest(attribute, dir(found))}"
            ) from None
        return found
    raise ValueError(f"{path}._target_: there is no '{name}'")


def _parameters(target: Any) -> tuple[dict[str, Any], bool]:
    """Names and types of the keyword arguments, those that ``**kwargs`` hands on to base classes included."""
    functions = (
        [vars(base)["__init__"] for base in target.__mro__ if "__init__" in vars(base)]
        if inspect.isclass(target)
        else [target]
    )
    hints: dict[str, Any] = {}
    for function in functions:
        parameters = inspect.signature(function).parameters.values()
        try:
            types = typing.get_type_hints(function, include_extras=True)
        except (NameError, TypeError):
            types = {}
        for parameter in parameters:
            if parameter.name != "self" and parameter.kind not in (
                parameter.VAR_KEYWORD,
                parameter.VAR_POSITIONAL,
            ):
                hints.setdefault(parameter.name, types.get(parameter.name, Any))
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return hints, False
    return hints, not inspect.isclass(target)


def _check_value(hint: Any, value: Any, path: str) -> Any:
    """Return the value as its type wants it, so that 1e3 is a count where a count is wanted."""
    try:
        adapter = TypeAdapter(_of_any_length(hint), config=ConfigDict(arbitrary_types_allowed=True))
    except (PydanticSchemaGenerationError, PydanticUndefinedAnnotation, TypeError):
        return value
    try:
        checked = adapter.validate_python(value)
    except ValidationError as error:
        message = error.errors()[0]["msg"]
        raise ValueError(f"{path}: {message[0].lower()}{message[1:]}, got {value!r}") from None
    return checked if isinstance(checked, int | float | list) else value


def _of_any_length(hint: Any) -> Any:
    """Read ``tuple[float]`` as libraries mean it who give two bounds that type."""
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is tuple and len(arguments) == 1:
        return tuple[arguments[0], ...]  # type: ignore[valid-type]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.Union[tuple(_of_any_length(argument) for argument in arguments)]  # noqa: UP007
    return hint


Target = Annotated[dict[str, Any], AfterValidator(_check_target)]
"""A node for ``hydra.utils.instantiate``: whatever it names must exist and accept the keys that are given."""
