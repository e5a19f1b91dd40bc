"""The policy as ONNX, for runtimes that are not PyTorch."""

import contextlib
import importlib.util
import io
import logging
import re
import warnings
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from physai.artifact.module import DeployablePolicy
from physai.artifact.states import States
from physai.deploy.archive import METADATA
from physai.errors import UserError

PACKAGES = ("onnx", "onnxscript", "onnxruntime")


def missing() -> list[str]:
    """Packages of the ``onnx`` extra that are not installed."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def convert(policy: DeployablePolicy, states: States) -> bytes:
    """Convert a policy, for any number of rows.

    Args:
        policy: The module.
        states: Examples of its inputs, at least two.

    Returns:
        The content of an ONNX file, without metadata.

    Raises:
        UserError: If a part of it has no ONNX; it says which.
    """
    rows = torch.export.Dim("N")
    with _quiet():
        try:
            program = torch.onnx.export(
                policy,
                tuple(value[:2].clone() for value in states.values()),
                dynamo=True,
                dynamic_shapes=(({0: rows},) * len(policy.in_keys),),
                input_names=list(policy.in_keys),
                output_names=list(policy.out_keys),
                verbose=False,
            )
        except Exception as error:  # its own hierarchy is private
            reason = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", str(error)).split())[:160]  # it likes colours
            raise UserError(f"the policy cannot be exported to ONNX ({reason})") from error
        assert program is not None
        return _without_notes(program.model_proto).SerializeToString()


def _without_notes(model: Any) -> Any:
    """Leave out the exporter's notes: they hold stack traces and paths of the machine that trained."""
    graph = model.graph
    for part in (graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.ClearField("metadata_props")
    return model


def describe(content: bytes, metadata: str) -> bytes:
    """Add metadata to an ONNX file."""
    import onnx

    model = onnx.load_from_string(content)
    onnx.helper.set_model_props(model, {METADATA: metadata})
    return model.SerializeToString()


def read_metadata(content: bytes) -> str | None:
    """The metadata of an ONNX file, if it has any.

    Raises:
        UserError: If it is no ONNX file.
    """
    import onnx

    try:
        model = onnx.load_from_string(content)
    except Exception as error:  # protobuf's errors differ between its implementations
        raise UserError(f"not an ONNX file ({' '.join(str(error).split())[:80]})") from error
    return {entry.key: entry.value for entry in model.metadata_props}.get(METADATA)


class Runtime:
    """The file in ONNX Runtime.

    Raises:
        UserError: If it cannot be run there.
    """

    def __init__(self, content: bytes) -> None:
        import onnxruntime

        try:
            self._session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
        except Exception as error:  # its classes are private
            raise UserError(f"ONNX Runtime refuses the file ({' '.join(str(error).split())[:160]})") from error

    def __call__(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Map a policy's inputs, [N, ...] each, to its outputs, as its module does."""
        names = [node.name for node in self._session.get_inputs()]
        given = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        outputs = tuple(map(torch.from_numpy, self._session.run(None, given)))
        return outputs if len(outputs) > 1 else outputs[0]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter tells its life on standard output, in logs and in warnings."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
