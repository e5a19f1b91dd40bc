"""Composing configuration: the values of ``conf/``, Hydra's overrides, and one line for what is wrong with them."""

import contextlib
import functools
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigLoadError
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from physai.config import keys, nearest
from physai.errors import UserError

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


for _resolver in (_ceil_div, _cores_of_job, _jobs_at_once):
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
}
"""Launchers of Hydra, and the extra that each comes with."""


@functools.cache
def set_plugin_defaults() -> None:
    """Give Hydra's launchers, those that are installed, the values of ``conf/hydra/defaults``."""
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
    state = GlobalHydra.instance()
    running, state.hydra = state.hydra, None  # a job of Hydra's may compose, too
    try:
        with initialize_config_dir(str(conf_dir().absolute()), job_name=name, version_base="1.3"):
            yield state.config_loader()
    finally:
        state.hydra = running


def parse(overrides: Iterable[str]) -> list[Override]:
    """Read overrides.

    Raises:
        UserError: If one is none.
    """
    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except OverrideParseException as error:
        raise UserError(f"'{error.override}' is not an override such as key=value") from error


def _offer_files(overrides: Iterable[str]) -> None:
    """Let Hydra find options that are files elsewhere, such as ``randomization=outputs/<id>/identified.yaml``."""
    for override in parse(overrides):
        group, option = override.get_key_element().lstrip("+"), override.value()
        if not (isinstance(option, str) and option.endswith(".yaml") and (conf_dir() / group).is_dir()):
            continue
        if (conf_dir() / group / option.lstrip("/")).is_file():
            continue
        try:
            node = OmegaConf.load(option)
        except OSError as error:
            raise UserError(f"{group}={option}: {error.strerror}") from error
        except (YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
            raise UserError(f"{group}={option}: {' '.join(str(error).split())}") from error
        if not isinstance(node, DictConfig):
            raise UserError(f"{group}={option}: it holds no keys")
        # The rooms of Hydra's register are called as it will look them up: without the empty name before a first slash.
        parts = [part for part in option.split("/")[:-1] if part]
        ConfigStore.instance().store(option.rpartition("/")[2], node, "/".join([group, *parts]))


def compose(name: str, overrides: Iterable[str] = (), hydra: bool = False) -> DictConfig:
    """Compose ``conf/<name>.yaml`` with Hydra overrides.

    Args:
        name: A file in ``conf/``, without its ending.
        overrides: As on the command line, such as ``env=reacher`` or ``algo.optimizer.lr=1e-3``; the option of a group
            may be a YAML file of one's own, by its path.
        hydra: Keep the ``hydra`` node.

    Raises:
        UserError: If an override is no override, or names a group, option or key that does not exist.
    """
    overrides = list(overrides)
    set_plugin_defaults()
    _offer_files(overrides)
    with initialized(name):
        try:
            return hydra_compose(name, overrides, return_hydra_config=hydra)
        except MissingConfigException as error:
            wanted = str(error.missing_cfg_file).rpartition("/")[2]
            if wanted in _PLUGINS:
                raise UserError(f"{error.missing_cfg_file}: pip install 'physai[{_PLUGINS[wanted]}]'") from error
            hint = nearest(wanted, error.options or [])
            raise UserError(f"{error.missing_cfg_file}: no such config{hint}") from error
        except OverrideParseException as error:
            raise UserError(f"'{error.override}' is not an override such as key=value") from error
        except (HydraException, OmegaConfBaseException) as error:
            if exists := re.search(r"already at '([^']+)'", str(error)):
                raise UserError(f"'{exists[1]}' exists already: change it without the +") from error
            match = re.search(r"Could not (?:override|append to config|delete from config)[^']*'([^'=]+)", str(error))
            if match is None:
                match = re.search(r"Key '([^']+)'", str(error))
            if match is None or not overrides:
                raise UserError(" ".join(str(error).split())) from error
            key = match[1].split("@")[0]
            chosen = [one for one in overrides if (conf_dir() / one.partition("=")[0]).is_dir()]  # env=..., algo=...
            raise UserError(f"unknown key '{key}'{nearest(key, keys(hydra_compose(name, chosen)))}") from error
