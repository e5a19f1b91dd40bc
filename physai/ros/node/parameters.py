"""A checked dataclass as the parameters of a ROS node."""

import dataclasses
import difflib
import math
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from physai.deploy.parameters import Parameters
from physai.errors import UserError

P = TypeVar("P", bound=Parameters)
_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides.")


def declare(node: Node, kind: type[P], apply: Callable[[P], None]) -> P:
    """Declare the fields of a dataclass as parameters, and return it with the values that the user gave.

    Integers are taken for floats; an unknown name warns with the nearest one. Values that come later are checked
    together, and all are refused if one is wrong.

    Args:
        node: Its parameters are declared here.
        kind: The dataclass; its fields are those of :func:`physai.deploy.parameters.parameter`.
        apply: Takes new values while the node runs; may raise a UserError, and then must change nothing.

    Raises:
        UserError: If values are wrong; the line names all of them.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}
    given = {}
    # Private, but rclpy's own way to hand them out declares them, and fails at an empty list.
    for name, found in node._parameter_overrides.items():
        if name in fields:
            empty = found.type_ is Parameter.Type.NOT_SET and isinstance(fields[name].default, tuple)
            given[name] = () if empty else _plain(found)
        elif not name.startswith(_OF_ROS):
            close = difflib.get_close_matches(name, fields, n=1, cutoff=0.6)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            node.get_logger().warning(f"unknown parameter '{name}'{hint}")
    current = kind(**given)
    for name, field in fields.items():
        value = getattr(current, name)
        declared = list(value) if isinstance(value, tuple) else value
        node.declare_parameter(name, declared, describe(field), ignore_override=True)

    def change(parameters: list[Parameter]) -> SetParametersResult:
        nonlocal current
        values = {parameter.name: _plain(parameter) for parameter in parameters if parameter.name in fields}
        if not values:
            return SetParametersResult(successful=True)
        try:
            changed = dataclasses.replace(current, **values)
            apply(changed)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        current = changed
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(change)
    return current


def describe(field: "dataclasses.Field[Any]") -> ParameterDescriptor:
    """Return what ``ros2 param describe`` shows."""
    unit, low, high = (field.metadata[key] for key in ("unit", "low", "high"))
    descriptor = ParameterDescriptor(
        description=field.metadata["description"] + (f" [{unit}]" if unit else ""),
        additional_constraints=" or ".join(field.metadata["choices"]),
        read_only=field.metadata["fixed"],
        dynamic_typing=True,  # ROS would refuse 1 for 1.0
    )
    if isinstance(field.default, float) and math.isfinite(high):
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif type(field.default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor


def help_text(kind: type[Parameters]) -> str:
    """Return a table of the parameters, for ``--help``."""
    lines = []
    for field in dataclasses.fields(kind):
        unit, low, high, choices = (field.metadata[key] for key in ("unit", "low", "high", "choices"))
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        extent = " or ".join(choices)
        if type(field.default) in (int, float):
            extent = f"{low:g} to {high:g}" if math.isfinite(high) else f"from {low:g}"
        notes = ", ".join(note for note in (unit, extent, "fixed" if field.metadata["fixed"] else "") if note)
        lines.append(
            f"  {field.name:<25} {default!s:<8} {field.metadata['description']}" + (f" ({notes})" if notes else "")
        )
    return "\n".join(lines)


def _plain(parameter: Any) -> Any:
    value = parameter.value
    return value if isinstance(value, str | int | float | None) else list(value)
