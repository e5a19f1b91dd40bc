"""Reading the config of a run folder: it may be from elsewhere, so it is data, and nothing that it names is run.

What it names is held against the lists below before anything is imported. What the user has chosen, in ``conf/`` or on
the command line, is the user's own, and passes where the run folder has the same at the same key.
"""

import contextlib
import functools
import inspect
import operator
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from physai.compose import compose, parse
from physai.errors import UserError
from physai.targets import find, is_dotted, shown

_MODULE = "torch.nn.modules.module.Module"
_PARTS: dict[str, tuple[str, ...]] = {
    # Public classes of these packages and modules, of which nothing else can be reached by a name; those of libraries
    # only if they inherit from one of these. No constructor among them reads a file or imports what an argument names.
    "physai.algorithms": (),
    "physai.collision": (),
    "physai.physics": (),  # not physai.ros: nobody trains there, and nobody's config may move a robot
    "physai.policies": (),
    "physai.signals": (),
    "physai.tasks": (),
    "physai.training.mlflow": ("torchrl.record.loggers.common.Logger",),
    "physai.training.wandb": ("torchrl.record.loggers.common.Logger",),
    "tensordict.nn": (_MODULE,),
    "torch.nn": (_MODULE,),
    "torch.optim": ("torch.optim.optimizer.Optimizer", "torch.optim.lr_scheduler.LRScheduler"),
    "torchrl.data": (
        "torchrl.data.replay_buffers.samplers.Sampler",
        "torchrl.data.replay_buffers.writers.Writer",
        "torchrl.data.replay_buffers.storages.LazyTensorStorage",  # and of these two, and buffers, no others:
        "torchrl.data.replay_buffers.storages.ListStorage",
        "torchrl.data.replay_buffers.replay_buffers.ReplayBuffer",
    ),
    "torchrl.modules": (_MODULE,),
    "torchrl.objectives": (_MODULE, "torchrl.objectives.utils.TargetNetUpdater"),
    "torchrl.record.loggers": (
        "torchrl.record.loggers.csv.CSVLogger",
        "torchrl.record.loggers.tensorboard.TensorboardLogger",
    ),
}
_NO_PARTS = (
    # They fetch models and data, unpickle them, or start servers.
    "torchrl.data.datasets",
    "torchrl.data.llm",
    "torchrl.data.replay_buffers.ray_buffer",
    "torchrl.data.replay_buffers.replay_buffers.RemoteTensorDictReplayBuffer",
    "torchrl.data.vla",
    "torchrl.modules.inference_server",
    "torchrl.modules.llm",
    "torchrl.modules.models.act",
    "torchrl.modules.models.decision_transformer",
    "torchrl.modules.models.llm",
    "torchrl.modules.vla",
    "torchrl.objectives.llm",
)
_NO_KEYS = (
    # Arguments of such parts that do.
    "checkpointer",
    "ray_init_config",
    "remote_config",
    "runtime_env",
    "service_backend",
    "service_backend_options",
    "transport",
    "transport_options",
)
_URDF_PACKAGES = ("physai", "pybullet_data")
_RAY = {"address": ("local", None), "include_dashboard": (False,)}  # values that do not reach out
_RAY_FREE = ("log_to_driver", "logging_level", "num_cpus")
_OUTSIDE = ("scratch_dir", "tracking_uri")  # where a resumed run would write, beside its folder

_INTERPOLATION = re.compile(r"\$\{(?:[\w.\[\]@/-]+\}|(?:add|ceil_div|cores_of_job|jobs_at_once):)")
_MOST_BYTES = 2**20
_DEEPEST = 40
_MOST_VALUES = 20_000

_Key = tuple[str | int, ...]
_Fault = tuple[_Key, str]  # where it is, and what is wrong there


def read_config(
    run_dir: Path, allow: Sequence[str] = (), given: Sequence[str] = (), resume: bool = False
) -> dict[str, Any]:
    """Read ``.hydra/config.yaml`` of a run folder, and refuse what may run anything.

    Args:
        run_dir: The run folder.
        allow: Packages whose classes and functions the config may name, too.
        given: The user's overrides of ``conf/train.yaml``.
        resume: Whether the run will go on: the config may then name no place outside of the run folder to write to.

    Returns:
        Plain values, without interpolations.

    Raises:
        UserError: If there is no run, its config is damaged, or it names what is not allowed.
    """
    path = run_dir / ".hydra" / "config.yaml"
    if not path.is_file():
        raise UserError(f"{run_dir}: no run there (it has no .hydra/config.yaml)")
    check_links(run_dir)
    node = _read(path)
    if not isinstance(node, dict):
        raise UserError(f"{path}: the run's config is damaged (it has no keys)")
    return checked(node, path, allow, given, resume)


def read_name(run_dir: Path) -> str:
    """Read the name of a run folder's env; the rest of its config is not looked at.

    Raises:
        UserError: If the config is damaged.
    """
    path = run_dir / ".hydra" / "config.yaml"
    try:
        name = _read(path)["env"]["name"]
    except (KeyError, TypeError):
        name = None
    if not isinstance(name, str) or _text_fault("name", name, ()):
        raise UserError(f"{path}: the run's config is damaged (env.name)")
    return name


def read_overrides(run_dir: Path) -> list[str]:
    """Read ``.hydra/overrides.yaml`` of a run folder: overrides for ``compose``, whose result is to be checked.

    Raises:
        UserError: If it is damaged, or changes where Hydra looks for configs.
    """
    path = run_dir / ".hydra" / "overrides.yaml"
    found = _read(path)
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
        raise UserError(f"{path}: the run's overrides are damaged (they are no list of texts)")
    for one in found:
        try:
            (parsed,) = parse([one])
        except UserError as error:
            raise UserError(f"{path}: {shown(one)} is not an override such as key=value") from error
        if "hydra" in f"{parsed.key_or_group} {parsed.package}":
            raise UserError(f"{path}: {shown(one)} is no business of a run folder")
    return found


def checked(
    node: dict[str, Any], path: Path, allow: Sequence[str] = (), given: Sequence[str] = (), resume: bool = False
) -> dict[str, Any]:
    """Return a config from a run folder without its interpolations; see ``read_config``.

    Args:
        node: Keys and plain values.
        path: Where it is from, for errors.
        allow: See ``read_config``.
        given: See ``read_config``.
        resume: See ``read_config``.
    """
    own = tuple(given)
    _refuse(_interpolations(node), node, path, own, resolved=False)
    try:
        config = OmegaConf.create(node)
        _count(config)
        plain = OmegaConf.to_container(config, resolve=True)
    except Exception as error:  # whatever OmegaConf makes of it
        raise UserError(f"{path}: the run's config is damaged ({' '.join(str(error).split())[:80]})") from error
    _refuse(_faults(plain, allow, resume), plain, path, own, resolved=True)
    _refuse(_impostors(plain, allow), plain, path, own, resolved=True)
    return plain


def _count(config: Any) -> None:
    """Refuse a config that grows out of all bounds where interpolations name lists of interpolations.

    Raises:
        ValueError: If it does.
    """
    waiting, count = [config], 0
    while waiting:
        node = waiting.pop()
        count += 1
        if count > _MOST_VALUES:
            raise ValueError(f"more than {_MOST_VALUES:,} values")
        if OmegaConf.is_config(node):
            keys = range(len(node)) if OmegaConf.is_list(node) else list(node)
            waiting.extend(node[key] for key in keys if not OmegaConf.is_missing(node, key))


def check_links(run_dir: Path) -> None:
    """Refuse a run folder with a link that leads out of it, for a command would write through it.

    Raises:
        UserError: The line names the link.
    """
    home = os.path.realpath(run_dir)
    for folder, folders, files in os.walk(run_dir):
        for name in (*folders, *files):
            path = os.path.join(folder, name)
            if os.path.islink(path) and os.path.commonpath([home, os.path.realpath(path)]) != home:
                raise UserError(f"{path} leads out of the run folder, to {os.readlink(path)}: put there what it means")


def _read(path: Path) -> Any:
    """Read a YAML file of plain values."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES:,} bytes")
        text = path.read_text()
        depth = 0
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise ValueError(f"more than {_DEEPEST} levels")
            if isinstance(event, yaml.AliasEvent) or getattr(event, "tag", None) is not None:  # Hydra writes none
                raise ValueError("it has an alias or a tag")
        return OmegaConf.to_container(OmegaConf.load(path))
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file") from error
    except Exception as error:  # whatever YAML makes of a truncated file
        raise UserError(f"{path}: the run's config is damaged ({' '.join(str(error).split())[:80]})") from error


@functools.lru_cache(2)
def _own(given: tuple[str, ...], resolved: bool) -> Any:
    """What the user has chosen: ``conf/`` with the command line's overrides."""
    return OmegaConf.to_container(compose("train", given), resolve=resolved)


def _refuse(faults: Iterator[_Fault], node: Any, path: Path, given: tuple[str, ...], resolved: bool) -> None:
    """Raise the first fault, unless the user has chosen the same value for the same key."""
    for key, reason in faults:
        with contextlib.suppress(KeyError, IndexError, TypeError):  # of a key that the user has not
            theirs, own = _at(node, key), _at(_own(given, resolved), key)
            if type(own) is type(theirs) and own == theirs:
                continue
        raise UserError(f"{path}: {'.'.join(map(str, key))}: {reason}")


def _at(node: Any, key: _Key) -> Any:
    return functools.reduce(operator.getitem, key, node)


def walk(node: Any, key: _Key = ()) -> Iterator[tuple[_Key, Any]]:
    """Every value, containers too, with its keys."""
    yield key, node
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for part, value in items:
        yield from walk(value, (*key, part))


def _interpolations(node: Any) -> Iterator[_Fault]:
    """What would be resolved to more than another value of the config, or a number made of some."""
    for key, value in walk(node):
        if isinstance(value, str) and value.count("${") != len(_INTERPOLATION.findall(value)):
            yield key, f"{shown(value)} asks for more than other values of the config"


def _names(node: Any) -> Iterator[tuple[_Key, Any]]:
    """Names of what will be made: those of activations are imported, too (``physai.policies``)."""
    for key, value in walk(node):
        if key[-1:] == ("_target_",):
            yield key, value
        elif key[-1:] == ("activation",) and isinstance(value, str):
            yield key, value if "." in value else f"torch.nn.{value}"


def _faults(node: Any, allow: Sequence[str], resume: bool) -> Iterator[_Fault]:
    """What can be seen without importing anything."""
    for key, name in _names(node):
        if not _may_be_named(name, allow):
            yield key, _not_allowed(name)
    for key, value in walk(node):
        last = key[-1] if key else ""
        reason = ""
        if not isinstance(last, str | int) or isinstance(last, bool) or not isinstance(value, _PLAIN):
            reason = f"{shown(value)} is no plain value"
        elif isinstance(value, str):
            reason = _text_fault(last, value, allow)
        if isinstance(last, str) and not reason:
            if last in _NO_KEYS or (last[:1] == "_" and last not in _HYDRAS):
                reason = "a run folder may not decide this"
            elif resume and value is not None and (last in _OUTSIDE or _leaves_ray(key, value)):
                group = "collector=ray " if _leaves_ray(key, value) else ""  # without it, there is no such key
                beside = f"resume=... {group}{'.'.join(map(str, key))}=..."
                reason = f"{shown(value)} is outside of the run folder; if you want it, say so: {beside}"
        if reason:
            yield key, reason


_PLAIN = (type(None), bool, int, float, str, list, dict)
_HYDRAS = ("_target_", "_partial_", "_convert_", "_recursive_")


def _text_fault(key: str | int, text: str, allow: Sequence[str]) -> str:
    if "${" in text:  # resolved once, and Hydra would resolve it again
        return f"{shown(text)} asks for more than other values of the config"
    if key in ("name", "exp_name") and (not text.isprintable() or set(text) & set("/\\") or text in ("", ".", "..")):
        return f"{shown(text)} is no name: it becomes part of the names of files"
    if "package://" in text:
        package = text.removeprefix("package://").partition("/")[0]
        if package not in _URDF_PACKAGES and not _is_in(package, allow):  # where it lies is found by importing it
            return _not_allowed(package)
    return ""


def _leaves_ray(key: _Key, value: Any) -> bool:
    if "ray_init" not in key[:-1]:
        return False
    return value not in _RAY[str(key[-1])] if key[-1] in _RAY else key[-1] not in _RAY_FREE


def _not_allowed(name: object) -> str:
    return f"a run folder may not name {shown(name)}; a package of your own you allow with allow=[<package>]"


def _is_in(name: str, packages: Sequence[str]) -> bool:
    return f"{name}.".startswith(tuple(f"{package}." for package in packages))


def _may_be_named(name: object, allow: Sequence[str]) -> bool:
    if not isinstance(name, str) or not is_dotted(name) or any(part.startswith("_") for part in name.split(".")):
        return False
    return _is_in(name, allow) or (_is_in(name, tuple(_PARTS)) and not _is_in(name, _NO_PARTS))


def _impostors(node: Any, allow: Sequence[str]) -> Iterator[_Fault]:
    """Names in allowed packages of what is not theirs, such as a module that they import; this imports the packages."""
    for key, name in _names(node):
        try:
            reason = "" if _is_part(find(name), allow) else _not_allowed(name)
        except ValueError as error:
            reason = str(error)
        if reason:
            yield key, reason


def _is_part(found: Callable[..., Any], allow: Sequence[str]) -> bool:
    home = _home(found)
    if _is_in(home, allow):
        return inspect.isclass(found) or inspect.isfunction(found)
    if not inspect.isclass(found) or _is_in(home, _NO_PARTS):
        return False
    ancestors = [_home(base) for base in found.__mro__]
    if any(_is_in(ancestor, _NO_PARTS) for ancestor in ancestors):
        return False
    families = [bases for package, bases in _PARTS.items() if _is_in(home, (package,))]
    return any(not bases or not set(bases).isdisjoint(ancestors) for bases in families)


def _home(found: Any) -> str:
    return f"{getattr(found, '__module__', '')}.{getattr(found, '__qualname__', '')}"
