"""Loading a policy: only the file that was exported, for the robot that it was made for, giving the same commands."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from physai.deploy import PolicyError, load_policy, read_metadata
from tests.deploy.files import (
    commands,
    described,
    pack,
    records,
    refusal,
    sign,
)

# --- the policy that was exported


def test_golden_pairs_are_equal_to_the_last_bit(policy):
    golden = policy.metadata.golden
    assert policy.golden_error == 0.0
    assert np.array_equal(commands(policy, golden), golden["joint_velocity_command"])


def test_a_command_is_one_float32_per_joint_and_stays_as_it_is(policy):
    first = policy([0.1, 0.2], (0.0, 0.0), np.array([0.4, 0.0], np.float64))
    kept = first.copy()
    policy([0.3, -0.2], [1.0, 0.0], [0.0, 0.4])
    assert (first.shape, first.dtype) == ((2,), np.float32)
    assert np.array_equal(first, kept)
    assert np.array_equal(first, policy([0.1, 0.2], [0.0, 0.0], [0.4, 0.0]))


@pytest.mark.parametrize("wrong", [0.5, [0.5], [[0.5]], [0.1, 0.2, 0.3], [[0.1, 0.2], [0.1, 0.2]], []], ids=repr)
def test_another_number_of_values_than_joints_is_no_input(policy, wrong):
    right = [0.1, 0.2]
    for inputs in ((wrong, right, right), (right, wrong, right), (right, right, wrong)):
        with pytest.raises((TypeError, ValueError)):
            policy(*inputs)


def test_the_error_is_the_distance_of_the_arm(policy):
    reach = policy.error([0.0, 0.0], [0.0, 0.0])
    assert reach == pytest.approx(policy.error([1.0, 0.0], [0.0, 0.0]), abs=1e-5)  # the first joint turns all
    reach = reach.item()
    assert policy.error([0.0, 0.0], [reach, 0.0]) == pytest.approx(0.0, abs=1e-5)
    assert policy.error([0.0, 0.0], [reach - 0.1, 0.0]) == pytest.approx(0.1, abs=1e-5)


def test_in_torchrl_code_it_gives_the_same_commands(policy):
    golden = policy.metadata.golden
    module = policy.as_tensordict_module()
    assert module.in_keys == ["joint_position", "joint_velocity", "goal"]
    assert module.out_keys == ["joint_velocity_command"]
    one = [
        TensorDict({key: torch.from_numpy(golden[key][i : i + 1]) for key in module.in_keys}, [1]) for i in range(32)
    ]
    alone = torch.cat([module(each)["joint_velocity_command"] for each in one]).numpy()
    assert np.array_equal(alone, golden["joint_velocity_command"])
    all_of_them = TensorDict({key: torch.from_numpy(golden[key]) for key in module.in_keys}, [32])
    together = module(all_of_them)["joint_velocity_command"].numpy()
    assert np.allclose(together, golden["joint_velocity_command"], rtol=0, atol=1e-5)


def test_a_loaded_policy_needs_no_file_any_more(content, path):
    path.write_bytes(content)
    policy = load_policy(str(path))
    path.unlink()
    assert np.array_equal(commands(policy, policy.metadata.golden), policy.metadata.golden["joint_velocity_command"])


# --- its hash


def test_the_hash_of_the_file_is_accepted_however_it_is_written(content, path):
    path.write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    for text in (digest, digest.upper(), f" {digest}\n"):
        assert load_policy(path, sha256=text).sha256 == digest


@pytest.mark.parametrize(
    "change", [lambda d: d[::-1], lambda d: d[:16], lambda d: "", lambda d: d + "0", lambda d: "é"]
)
def test_another_hash_is_refused(content, path, change):
    path.write_bytes(content)
    assert "its SHA-256 is" in refusal(path, sha256=change(hashlib.sha256(content).hexdigest()))


@pytest.mark.parametrize(
    "wrong", [5, b"0" * 64, ["0" * 64], True, np.zeros(2), list(range(999))], ids=lambda v: type(v).__name__
)
def test_a_hash_that_is_no_text_is_refused_in_one_line(content, path, wrong):
    path.write_bytes(content)
    assert refusal(path, sha256=wrong).startswith("sha256 must be text, in hexadecimal, not ")


def test_the_hash_beside_is_used_unless_another_is_given(content, path):
    path.write_bytes(content)
    digest, beside = hashlib.sha256(content).hexdigest(), path.with_name("policy.pt.sha256")
    beside.write_text(f"{digest}  policy.pt\n")
    assert load_policy(path).golden_error == 0
    assert "not the expected one" in refusal(path, sha256="0" * 64)
    beside.write_text(f"{'0' * 64}  policy.pt\n")
    assert "not that of policy.pt.sha256, 0000000000000000..." in refusal(path)
    assert load_policy(path, sha256=digest).golden_error == 0


@pytest.mark.parametrize("text", [b" \n", b"\xff\xfe\x00", b"no hash", b"\x1b[2J"])
def test_a_hash_beside_that_is_none_is_refused(content, path, text):
    path.write_bytes(content)
    path.with_name("policy.pt.sha256").write_bytes(text)
    assert "its SHA-256 is" in refusal(path)


def test_a_hash_beside_that_is_empty_or_a_folder_is_refused(content, path):
    path.write_bytes(content)
    beside = path.with_name("policy.pt.sha256")
    beside.touch()
    with pytest.raises(PolicyError, match=r"policy\.pt\.sha256: the file is empty"):
        load_policy(path)
    beside.unlink()
    beside.mkdir()
    with pytest.raises(PolicyError, match=r"policy\.pt\.sha256: not a file"):
        load_policy(path)


def test_a_hash_beside_that_is_a_dead_link_is_not_passed_over(content, path):
    path.write_bytes(content)
    path.with_name("policy.pt.sha256").symlink_to("nowhere")
    with pytest.raises(PolicyError, match=r"policy\.pt\.sha256: no such file"):
        load_policy(path)


# --- its robot


def test_the_joints_that_are_expected_are_accepted(content, path):
    path.write_bytes(content)
    for joints in (("joint1", "joint2"), ["joint1", "joint2"]):
        assert load_policy(path, expect_joints=joints).metadata.joints == ("joint1", "joint2")


def swap_joints(metadata):
    for labels in (metadata["robot"]["joints"], *(one["labels"] for one in metadata["inputs"] + metadata["outputs"])):
        if "joint1" in labels:
            labels.reverse()


def test_swapped_joints_are_called_in_another_order(content, path):
    path.write_bytes(described(content, swap_joints))
    message = refusal(path, expect_joints=["joint1", "joint2"])
    assert "in another order: ['joint2', 'joint1'], not ['joint1', 'joint2']" in message


@pytest.mark.parametrize("joints", [["lbr_joint1", "lbr_joint2"], ["joint1"], ["joint1", "joint2", "joint3"], []])
def test_another_robots_joints_are_refused(content, path, joints):
    path.write_bytes(content)
    assert f"for other joints: ['joint1', 'joint2'], not {joints}" in refusal(path, expect_joints=joints)


def test_another_format_version_is_refused_with_the_path(content, path):
    path.write_bytes(described(content, lambda metadata: metadata.update(format_version=1)))
    assert "format version 1" in refusal(path)


# --- what reading metadata does, and what loading imports


def test_metadata_are_those_of_the_loaded_policy(exported_run, policy):
    assert read_metadata(exported_run / "policy.pt").raw == policy.metadata.raw


def test_a_forged_file_whose_pickle_is_damaged_is_refused(content, path):
    good = records(content)
    for at in range(0, len(good["archive/data.pkl"]), 150):
        path.write_bytes(pack(sign(good | {"archive/data.pkl": good["archive/data.pkl"][:at]})))
        assert "cannot be run" in refusal(path)


IMPORTS = """
import sys
import physai.deploy
print(*sorted({name.partition(".")[0] for name in sys.modules} & set(sys.argv[1:])))
"""


@pytest.mark.slow
def test_importing_it_imports_nothing_that_a_robot_lacks():
    heavy = ["tensordict", "torchrl", "pybullet", "hydra", "omegaconf", "pydantic", "gymnasium", "pandas", "scipy"]
    done = subprocess.run([sys.executable, "-c", IMPORTS, *heavy], capture_output=True, text=True, check=True)
    # physai registers its environments where Gymnasium is installed, as it is here
    assert set(done.stdout.split()) <= {"gymnasium"}
