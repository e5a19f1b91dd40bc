"""Checking configuration: values live in ``conf/``, types and ranges in models that inherit Config."""

import difflib
import importlib.metadata
import re
from collections.abc import Iterable
from typing import Annotated, Any, TypeVar

import numpy as np
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from physai.errors import UserError


class Config(BaseModel):
    """Base of all config models: no unknown keys, no silent conversions, no changes, and no defaults."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _whole(value: Any) -> Any:
    """Let people write 1e6 for a count."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _listed(value: Any) -> Any:
    """Let people write one number that is the same for all."""
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else value


Seed = Annotated[int, Field(ge=0, lt=2**32)]
Count = Annotated[int, BeforeValidator(_whole), Field(gt=0)]
PackageName = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*$", max_length=100)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
EachPositive = Annotated[list[PositiveFloat], BeforeValidator(_listed)]
EachNonNegative = Annotated[list[NonNegativeFloat], BeforeValidator(_listed)]


class PageConfig(Config):
    """Where a page for browsers is served: on an address of this computer, and a port; 0 takes a free one."""

    host: str
    port: Annotated[int, Field(ge=0, le=65535)]


C = TypeVar("C", bound=Config)


def validate(model: type[C], node: DictConfig, where: str = "") -> C:
    """Turn a composed config into its typed model; of a part of one, ``where`` is its key with a dot, for errors.

    Raises:
        UserError: One line that names the first bad key, what was expected, and what came.
    """
    try:
        data = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise UserError(f"{error.full_key}=... is required") from error
    except OmegaConfBaseException as error:
        raise UserError(" ".join(str(error).split())) from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = where + ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = [name for name in keys(node, where) if name != key and not name.startswith(f"{key}.")]
            raise UserError(f"unknown key '{key}'{nearest(key, known)}") from error
        if first["type"] == "missing":
            raise UserError(f"{key} is missing") from error
        if first["type"] == "value_error" and isinstance(first["ctx"]["error"], UserError | ValueError):
            raise UserError(f"{key}{first['ctx']['error']}") from error
        message = first["msg"][0].lower() + first["msg"][1:]
        raise UserError(f"{key}: {message}, got {first['input']!r}") from error


def of_each(values: list[float], joints: int, where: str) -> np.ndarray:
    """Return a value for each joint, [n], from as many, or from one that is the same for all.

    Raises:
        UserError: If they are of another number; it says ``where``.
    """
    if len(values) not in (1, joints):
        raise UserError(f"{where} has {len(values)} values for {joints} joints")
    return np.broadcast_to(np.array(values, dtype=np.float64), joints).copy()


def nearest(name: str, options: Iterable[str]) -> str:
    """End of an error message: the option that the user most likely meant, or the options if they are few."""
    options = sorted(set(options))
    by_last = {option.rpartition(".")[2]: option for option in options}
    close = difflib.get_close_matches(name, options, n=1, cutoff=0.7)
    if not close:
        close = [by_last[last] for last in difflib.get_close_matches(name.rpartition(".")[2], by_last, n=1)]
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; there are: {', '.join(options)}" if 0 < len(options) <= 16 else ""


def not_installed(module: str) -> str:
    """End of an error message: the module that is missing, and what installs it."""
    for requirement in importlib.metadata.requires("physai") or []:
        name, _, extra = requirement.partition("extra == ")
        if extra and re.split(r"[^\w.-]", name)[0].lower().replace("-", "_") == module.partition(".")[0].lower():
            return f"'{module}', which is not installed: pip install 'physai[{extra.strip(' )')[1:-1]}]'"
    return f"'{module}', which is not installed"


def keys(node: DictConfig, prefix: str = "") -> list[str]:
    """Return every key of a config with its parents, such as ``algo.optimizer.lr``."""
    found = []
    for key in node:
        found.append(f"{prefix}{key}")
        child = None if OmegaConf.is_missing(node, key) else node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none():
            found += keys(child, f"{prefix}{key}.")
    return found
