"""Other modules in the dress of a policy, and policies with another weight: refused by their hash or golden pairs."""

import hashlib
import io
import json

import pytest
import torch
from torch import Tensor, nn

from physai.deploy import PolicyError, load_policy, read_metadata
from physai.deploy.archive import content_sha256
from physai.deploy.metadata import metadata_sha256
from tests.deploy.files import (
    METADATA,
    described,
    pack,
    records,
    refusal,
    save,
    sign,
)

# --- altered weights


def altered(content: bytes, name: str, by: float) -> bytes:
    """The policy, loaded and saved with one weight that differs by so much, and the same metadata."""
    module = torch.jit.load(io.BytesIO(content))
    with torch.no_grad():
        module.state_dict()[name].view(-1)[0] += by
    return save(module, records(content)[METADATA].decode())


WEIGHTS = ("network.0.weight", "network.2.bias", "network.4.weight", "normalizer.loc", "command.scale")


@pytest.mark.parametrize("name", WEIGHTS)
def test_a_weight_that_differs_is_refused(content, path, name):
    path.write_bytes(altered(content, name, 1e-3))
    assert "content_sha256 differs" in refusal(path)
    with pytest.raises(PolicyError, match="content_sha256 differs"):
        read_metadata(path)


@pytest.mark.parametrize("name", [*WEIGHTS, "observation.coarse", "observation.kinematics.constant"])
def test_a_weight_that_differs_in_a_forged_file_breaks_the_golden_pairs(content, path, name):
    path.write_bytes(pack(sign(records(altered(content, name, 2e-2)))))
    assert "a golden pair differs by" in refusal(path)


def test_a_weight_that_differs_by_a_thousandth_in_a_forged_file_breaks_the_golden_pairs(content, path):
    path.write_bytes(pack(sign(records(altered(content, "network.4.bias", 1e-3)))))
    message = refusal(path)
    assert "a golden pair differs by" in message
    assert "when it was exported" in message


def test_a_command_that_differs_from_the_golden_one_is_refused(content, path):
    def change(metadata):
        metadata["golden"]["joint_velocity_command"][-1][0] += 1e-3

    path.write_bytes(described(content, change))
    assert "the joint_velocity_command of a golden pair differs by 0.001:" in refusal(path)


# --- other modules in the dress of a policy


class Base(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2), requires_grad=False)

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return torch.zeros(joint_position.size(0), 1)


class Other(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position * self.weight


class FewerArguments(Base):
    def forward(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return joint_position * self.weight


class OtherOrder(Base):
    def forward(self, joint_velocity: Tensor, joint_position: Tensor, goal: Tensor) -> Tensor:
        return joint_position * self.weight


class OneArgumentMore(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor, gain: float = 1.0) -> Tensor:
        return joint_position * self.weight * gain


class NoError(nn.Module):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position


class ErrorIsATensor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("error", torch.ones(1))

    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position * self.error


class OtherShape(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return torch.cat([joint_position, goal], dim=1)


class OneForAll(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position[:, :1]


class OtherType(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position.double()


class NoTensor(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> float:
        return float(joint_position[0, 0])


class TwoTensors(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        return joint_position, joint_velocity


class AllNaN(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position * float("nan")


class OneNaN(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position.masked_fill(joint_position < 0, float("nan"))


class Infinite(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position / 0.0


class Raises(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        raise ValueError("first line\nsecond line")
        return joint_position


class LongError(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        return joint_position

    @torch.jit.export
    def error(self, joint_position: Tensor, goal: Tensor) -> Tensor:
        return joint_position


def disguise(module: nn.Module, content: bytes, forged: bool, **changes) -> bytes:
    """A module with a policy's metadata; forged, they describe it."""
    scripted = torch.jit.script(module)
    metadata = json.loads(records(content)[METADATA]) | changes
    if forged:
        metadata["content_sha256"] = content_sha256(save(scripted))
        metadata["metadata_sha256"] = metadata_sha256(metadata)
    return save(scripted, json.dumps(metadata))


def test_another_module_is_refused(content, path):
    path.write_bytes(save(torch.jit.script(Other())))
    assert "a TorchScript file, but no physai policy (metadata.json is missing)" in refusal(path)
    path.write_bytes(disguise(Other(), content, forged=False))
    assert "content_sha256 differs" in refusal(path)


@pytest.mark.parametrize(
    ("module", "reason"),
    [
        (Other, "a golden pair differs by"),
        (FewerArguments, "its forward takes ['joint_position', 'goal'], not"),
        (OtherOrder, "its forward takes ['joint_velocity', 'joint_position', 'goal'], not"),
        (OneArgumentMore, "its forward takes"),
        (NoError, "its error takes None, not"),
        (ErrorIsATensor, ""),
        (OtherShape, "it gives float32 [4], not float32 [2]"),
        (OneForAll, "it gives float32 [1], not float32 [2]"),
        (OtherType, "it gives float64 [2], not float32 [2]"),
        (NoTensor, "cannot be run"),
        (TwoTensors, ""),
        (AllNaN, "a golden pair differs by nan"),
        (Infinite, "a golden pair differs by inf"),
        (Raises, "cannot be run"),
    ],
)
def test_another_module_in_a_forged_file_is_refused(content, path, module, reason):
    path.write_bytes(disguise(module(), content, forged=True))
    assert reason in refusal(path)


def golden_positions(content: bytes) -> dict:
    """Golden pairs of a policy that commands its positions, and thinks that it is always at the goal."""
    golden = json.loads(records(content)[METADATA])["golden"]
    return golden | {"joint_velocity_command": golden["joint_position"], "error": [[0.0]] * len(golden["goal"])}


def test_a_forged_file_with_forged_golden_pairs_loads_and_only_its_hash_can_tell(content, path):
    path.write_bytes(disguise(Other(), content, forged=True, golden=golden_positions(content)))
    assert load_policy(path).golden_error == 0
    assert "its SHA-256 is" in refusal(path, sha256=hashlib.sha256(content).hexdigest())


def test_a_command_that_is_no_number_in_a_few_of_the_golden_pairs_is_refused(content, path):
    path.write_bytes(disguise(OneNaN(), content, forged=True, golden=golden_positions(content)))
    assert "a golden pair differs by nan" in refusal(path)


def test_errors_that_are_too_many_is_refused(content, path):
    path.write_bytes(disguise(LongError(), content, forged=True, golden=golden_positions(content)))
    assert "it gives float32 [2], not float32 [1]" in refusal(path)


# --- what reading metadata does


class Prints(Base):
    def forward(self, joint_position: Tensor, joint_velocity: Tensor, goal: Tensor) -> Tensor:
        print("it ran")
        return joint_position


def test_metadata_are_read_without_running_anything(content, path, capfd):
    path.write_bytes(disguise(Prints(), content, forged=True))
    assert read_metadata(path).joints == ("joint1", "joint2")
    assert "it ran" not in capfd.readouterr().out
    refusal(path)
    assert "it ran" in capfd.readouterr().out  # so it would have been seen
