"""Loading a policy file with torch and numpy alone, and asking it for commands."""

import hashlib
import io
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from physai.deploy import archive
from physai.deploy.metadata import ERROR, GOAL, POSITION, Metadata
from physai.deploy.reading import PolicyError

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModule

Vector = Sequence[float] | np.ndarray

# Golden pairs are equal to the last bit where the processor is the one that recorded them; others round differently.
GOLDEN_TOLERANCE = 1e-4  # in the unit of each signal


class Driver(Protocol):
    """What a controller asks for commands: a :class:`Policy`, or who else answers as one."""

    metadata: Metadata
    sha256: str

    def __call__(self, *inputs: Vector) -> Any:
        """See :class:`Policy`."""

    def error(self, joint_position: Vector, goal: Vector) -> np.ndarray:
        """See :class:`Policy`."""


class Policy:
    """From what one robot senses to its command; of :func:`load_policy`. Not for several threads at once.

    A policy that remembers keeps nothing itself: it takes a memory, and gives the memory for the next call.

    Attributes:
        metadata: What the file says about itself.
        sha256: Hash of the file.
        golden_error: Largest difference to the recorded answers on this machine; 0.0 if all bits agree.
        module: The TorchScript module, for batches: float32 tensors [N, ...] of its inputs to those of its outputs.
    """

    def __init__(self, module: torch.jit.ScriptModule, metadata: Metadata, sha256: str) -> None:
        self.module = module
        self.metadata = metadata
        self.sha256 = sha256
        self.golden_error = 0.0
        # Each array shares its memory with the tensor beside it: filling it is cheaper than making tensors.
        self._arrays = [np.zeros((1, *signal.shape), np.float32) for signal in metadata.inputs]
        self._tensors = [torch.from_numpy(array) for array in self._arrays]
        names = [signal.name for signal in metadata.inputs]
        self._position, self._goal = names.index(POSITION), names.index(GOAL)
        self._remembers = metadata.memory_size > 0

    def __call__(self, *inputs: Vector) -> Any:
        """Map the inputs that ``metadata.inputs`` declares, in that order, to the command [n], float32.

        A policy that remembers also takes a memory [H], zeros where an episode begins, and gives the new one, [H].

        Raises:
            ValueError: If one of them has another length, or is missing.
        """
        if len(inputs) != len(self._arrays):
            raise ValueError(f"{len(self._arrays)} inputs are needed, not {len(inputs)}")
        for array, values in zip(self._arrays, inputs, strict=True):
            _fill(array, values)
        answer = self.module(*self._tensors)
        return tuple(one[0].numpy() for one in answer) if self._remembers else answer[0].numpy()

    def error(self, joint_position: Vector, goal: Vector) -> np.ndarray:
        """How far the robot is from a goal at joint positions [n] rad, one error for each tolerance, [e].

        Raises:
            ValueError: If one of them has another length, or the policy does not measure that.
        """
        if not self.metadata.measures:
            raise ValueError("this policy cannot tell from joint positions how far its robot is from a goal")
        _fill(self._arrays[self._position], joint_position)
        _fill(self._arrays[self._goal], goal)
        return self.module.error(self._tensors[self._position], self._tensors[self._goal])[0].numpy()

    def as_tensordict_module(self) -> "TensorDictModule":
        """Wrap the module for TorchRL code, with its keys; needs tensordict."""
        from tensordict.nn import TensorDictModule

        sides = (self.metadata.inputs, self.metadata.outputs)
        in_keys, out_keys = ([signal.name for signal in side] for side in sides)
        return TensorDictModule(self.module, in_keys=in_keys, out_keys=out_keys)


def _fill(row: np.ndarray, values: Vector) -> None:
    if len(values) != row.shape[1]:  # NumPy would let one value stand for all
        raise ValueError(f"{row.shape[1]} values are needed, not {len(values)}")
    row[0] = values


def read_metadata(path: str | Path) -> Metadata:
    """Read what a policy file says about itself; nothing in the file is unpickled or run.

    Raises:
        PolicyError: If it is not a policy file, or its code and weights are not those that it describes.
    """
    path = Path(path)
    return _described(path, archive.check(path, archive.read(path)))


def load_policy(path: str | Path, sha256: str | None = None, expect_joints: Sequence[str] | None = None) -> Policy:
    """Check a policy file, load it, and see that it still gives the commands that it gave when it was exported.

    A policy file is a program: its checks find damage and mix-ups. Only a hash that came to you another way than the
    file proves who made it.

    Args:
        path: ``policy.pt``.
        sha256: Its expected hash, in hexadecimal. Without it, a ``policy.pt.sha256`` that lies beside is used.
        expect_joints: The joints that the robot's side expects, in the policy's order.

    Returns:
        The policy, warmed up.

    Raises:
        PolicyError: If the file is missing, damaged, altered, of another format, or for other joints; it says which.
    """
    path = Path(path)
    if not isinstance(sha256, str | None):
        raise PolicyError(f"{path}: sha256 must be text, in hexadecimal, not {sha256!r:.80}")
    content = archive.read(path)
    digest = hashlib.sha256(content).hexdigest()
    expected, source = (sha256, "the expected one") if sha256 is not None else _beside(path)
    if expected is not None and digest not in expected.lower().split()[:1]:  # sha256sum writes the name behind it
        raise PolicyError(f"{path}: its SHA-256 is {digest[:16]}..., not {source}, {expected.strip()[:16]}...")
    checked = archive.check(path, content)
    metadata = _described(path, checked)
    joints = metadata.joints if expect_joints is None else tuple(expect_joints)
    if joints != metadata.joints:
        how = "with its joints in another order" if set(joints) == set(metadata.joints) else "for other joints"
        raise PolicyError(f"{path}: a policy {how}: {list(metadata.joints)}, not {list(joints)}")
    try:
        inputs = [signal.name for signal in metadata.inputs]
        policy = Policy(load_module(checked.content, inputs, metadata.measures), metadata, digest)
        policy.golden_error = _golden_error(policy)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except Exception as error:  # whatever torch makes of a program that is not ours
        raise PolicyError(f"{path}: cannot be run ({' '.join(str(error).split())[:120]})") from error
    return policy


def _beside(path: Path) -> tuple[str | None, str]:
    beside = path.with_name(f"{path.name}.sha256")
    if not os.path.lexists(beside):
        return None, ""
    words = archive.read(beside).decode(errors="replace").split()
    return (words[0] if words else ""), f"that of {beside.name}"


def _described(path: Path, checked: archive.Archive) -> Metadata:
    try:
        metadata = Metadata.parse(checked.metadata)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    if metadata.content_sha256 != checked.content_sha256:
        raise PolicyError(f"{path}: its code or weights are not those that were exported (content_sha256 differs)")
    return metadata


def load_module(content: bytes, inputs: Sequence[str], measures: bool) -> torch.jit.ScriptModule:
    """Load the TorchScript of a policy file that has been checked, or that is not written yet.

    Args:
        content: Of the file.
        inputs: What the policy takes.
        measures: Whether it can tell how far a robot is from a goal.

    Raises:
        PolicyError: If its methods are not those of a policy.
        RuntimeError: If torch cannot read it.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of TorchScript
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()
        for method, arguments in (("forward", inputs), *([(ERROR, (POSITION, GOAL))] if measures else [])):
            found = [a.name for a in getattr(module, method).schema.arguments[1:]] if hasattr(module, method) else None
            if found != list(arguments):
                raise PolicyError(f"its {method} takes {found}, not {list(arguments)}")
        storages = [tensor.untyped_storage() for tensor in module.state_dict().values()]
        held = {s.data_ptr() or -place: s.nbytes() for place, s in enumerate(storages)}  # parts may share them
        if sorted(held.values()) != sorted(archive.tensor_sizes(content)):
            raise PolicyError("its weights are shorter or longer than it says")
        return torch.jit.freeze(module, preserved_attrs=[ERROR] if measures else [])


def _golden_error(policy: Policy) -> float:
    """Run all pairs, thrice: the first calls also let TorchScript's profiling executor settle."""
    golden, metadata, worst = policy.metadata.golden, policy.metadata, 0.0
    pairs = [dict(zip(golden, values, strict=True)) for values in zip(*golden.values(), strict=True)]
    for pair in pairs * 3:
        inputs = [pair[signal.name] for signal in metadata.inputs]
        answer = policy(*inputs)
        answers = answer if metadata.memory_size else (answer,)
        found = {signal.name: one for signal, one in zip(metadata.outputs, answers, strict=True)}
        if metadata.measures:
            found[ERROR] = policy.error(pair[POSITION], pair[GOAL])
        for key, given in found.items():
            expected = pair[key]
            if given.shape != expected.shape or given.dtype != np.float32:
                raise PolicyError(f"it gives {given.dtype} {list(given.shape)}, not float32 {list(expected.shape)}")
            error = float(np.abs(given - expected).max())
            if not error <= GOLDEN_TOLERANCE:  # also where it is NaN
                raise PolicyError(
                    f"the {key} of a golden pair differs by {error:.3g}: at {_shown(*inputs)} it gives "
                    f"{_shown(given)}, and gave {_shown(expected)} when it was exported"
                )
            worst = max(worst, error)
    return worst


def _shown(*arrays: np.ndarray) -> str:
    """Numbers for an error message; of a memory, the first ones."""
    return ", ".join(f"{array[:8].tolist()}{'...' if len(array) > 8 else ''}" for array in arrays)
