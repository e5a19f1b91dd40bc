"""What a ``_target_`` names: found by its dotted name, checked against its signature, and made."""

import importlib
import inspect
import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError

from physai.config import nearest, not_installed
from physai.errors import UserError

_LONGEST = 200  # characters of a name
_SHOWN = 80


def is_dotted(name: object) -> bool:
    """Whether it may be the name of something in a module."""
    if not isinstance(name, str) or len(name) > _LONGEST:
        return False
    parts = name.split(".")
    return len(parts) > 1 and all(part.isidentifier() for part in parts)


def find(name: str) -> Any:
    """Import a module and return what is in it.

    Args:
        name: Of the module, a dot, and what is in it, such as ``torch.optim.Adam``.

    Raises:
        ValueError: If there is no such thing, nothing can be made with it, or its module cannot be imported.
        UserError: What the module itself has to say.
    """
    if not is_dotted(name):
        raise ValueError(f"{shown(name)} is no name such as torch.optim.Adam")
    module, _, attribute = name.rpartition(".")
    while module:
        try:
            found = importlib.import_module(module)
        except (UserError, KeyboardInterrupt):
            raise
        except ModuleNotFoundError as error:
            if not f"{module}.".startswith(f"{error.name}."):  # it is there, and needs what is not
                raise ValueError(f"{name} needs {not_installed(error.name or module)}") from error
            outer, _, inner = module.rpartition(".")
            module, attribute = outer, f"{inner}.{attribute}"
            continue
        except BaseException as error:  # whatever a module does while it is imported, sys.exit() too
            reason = " ".join(str(error).split())[:_SHOWN]
            raise ValueError(f"{module} cannot be imported: {type(error).__name__}: {reason}") from error
        return _in(found, module, attribute)
    raise ValueError(f"there is no '{name}'")


def _in(found: Any, module: str, attribute: str) -> Any:
    for part in attribute.split("."):
        outer = found
        try:
            found = getattr(outer, part)
        except UserError:
            raise
        except Exception as error:  # a module may decide by itself what it has
            raise ValueError(f"{module} has no '{attribute}'{nearest(attribute, dir(outer))}") from error
    if not callable(found):
        raise ValueError(f"{module}.{attribute} is of type {type(found).__name__}, which makes nothing")
    return found


def make(where: str, node: dict[str, Any], *arguments: Any, needs: Sequence[str] = (), **parts: Any) -> Any:
    """Make what a config names.

    Args:
        where: Its key, for errors.
        node: What to make, with its arguments.
        *arguments: Positional ones that do not come from the config.
        needs: Attributes without which it is not what is wanted there.
        **parts: Keyword arguments that do not come from the config.

    Raises:
        UserError: If it cannot be made, or is something else than what is wanted there.
    """
    try:
        maker = instantiate(node, _partial_=True, _convert_="all")  # with parts among its arguments, Hydra makes dicts
        made = maker(*arguments, **parts)
    except Exception as error:  # whatever a part says to its arguments
        cause = (error.__cause__ or error) if isinstance(error, InstantiationException) else error
        if isinstance(cause, UserError):
            raise cause from cause.__cause__
        reason = " ".join(str(cause).split())
        plain = isinstance(cause, TypeError | ValueError | AttributeError | ImportError)
        raise UserError(f"{where}: {reason if reason and plain else f'{type(cause).__name__}: {reason}'}") from error
    for name in needs:
        if not hasattr(made, name):
            raise UserError(f"{where}._target_: {node['_target_']} is not what is wanted here: it has no '{name}'")
    return made


def shown(value: object) -> str:
    """What came, in the line of an error."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _check_target(node: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Check the keys and simple values of a ``_target_`` node against the signature of what it names."""
    name = node.get("_target_")
    if not isinstance(name, str):
        raise ValueError(f"{path}: a _target_ is needed, such as torch.optim.Adam")
    try:
        target = find(name)
    except ValueError as error:
        raise ValueError(f"{path}._target_: {error}") from error
    if not isinstance(node.get("_partial_", False), bool):
        raise ValueError(f"{path}._partial_: input should be a valid boolean, got {shown(node['_partial_'])}")
    hints, is_open = _parameters(target)
    node = dict(node)
    for key, value in list(node.items()):
        if key in ("_target_", "_partial_"):
            continue
        if key not in hints and not is_open:
            raise ValueError(
                f": unknown key '{path.lstrip('.')}{'.' if path else ''}{key}' of {name}{nearest(str(key), hints)}"
            )
        if isinstance(value, dict) and "_target_" in value:
            node[key] = _check_target(value, f"{path}.{key}")
        elif isinstance(value, list) and any(isinstance(one, dict) and "_target_" in one for one in value):
            node[key] = [
                _check_target(one, f"{path}.{key}.{index}") if isinstance(one, dict) else one
                for index, one in enumerate(value)
            ]
        else:
            node[key] = _check_value(hints.get(key, Any), value, f"{path}.{key}")
    return node


def _parameters(target: Any) -> tuple[dict[str, Any], bool]:
    """Names and types of the keyword arguments, those that ``**kwargs`` hands on to base classes included."""
    functions = (
        [vars(base)["__init__"] for base in target.__mro__ if "__init__" in vars(base)]
        if inspect.isclass(target)
        else [target]
    )
    hints: dict[str, Any] = {}
    for function in functions:
        try:
            parameters = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):  # what is written in C may not say
            return hints, True
        try:
            types = typing.get_type_hints(function, include_extras=True)
        except Exception:  # names that are only there for type checkers
            types = {}
        for parameter in parameters:
            if parameter.name != "self" and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                hints.setdefault(parameter.name, types.get(parameter.name, Any))
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return hints, False
    return hints, not inspect.isclass(target)


def _check_value(hint: Any, value: Any, path: str) -> Any:
    """Return the value as its type wants it, so that 1e3 is a count where a count is wanted."""
    try:
        adapter = TypeAdapter(_of_any_length(hint), config=ConfigDict(arbitrary_types_allowed=True))
    except Exception:  # a type that pydantic knows nothing about
        return value
    try:
        checked = adapter.validate_python(value)
    except ValidationError as error:
        message = error.errors()[0]["msg"]
        raise ValueError(f"{path}: {message[0].lower()}{message[1:]}, got {shown(value)}") from error
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
