"""Policy files made of a few lines: modules that a test scripts, and signals that it declares."""

import json

import numpy as np
import torch

from physai.collision import Kinematics, Motions
from physai.deploy.archive import content_sha256
from physai.deploy.metadata import FORMAT, FORMAT_VERSION, describe_region, describe_signal, metadata_sha256
from physai.signals import Quantity, Signal
from tests.deploy.files import save

LIMIT = 2.0  # rad/s
PAIRS = 4


def of_joints(name, quantity, joints):
    most = np.full(len(joints), 3.0)
    return Signal.of_joints(name, Quantity(quantity), joints, -most, most)


def _in_a_row(joints: int) -> Kinematics:
    """Joints that turn about z, 0.3 m from each other along x."""
    constant, cosine, sine = np.zeros((3, joints, 4, 4))
    constant[:] = np.diag([0.0, 0.0, 1.0, 1.0])
    constant[:, 0, 3] = 0.3
    cosine[:] = np.diag([1.0, 1.0, 0.0, 0.0])
    sine[:, 1, 0], sine[:, 0, 1] = 1.0, -1.0
    return Kinematics(Motions(constant, cosine, sine), ((joints, np.eye(4)),))


def policy_file(module, joints, inputs, outputs, region, tolerances, collision=None, home=None) -> bytes:
    """A policy file of a module: joints within 3 rad, commands of 2 rad/s, at 50 Hz."""
    n, scripted = len(joints), torch.jit.script(module.eval())
    draw = torch.Generator().manual_seed(0)
    golden = {signal.name: torch.rand(PAIRS, *signal.shape, generator=draw) for signal in inputs}
    answers = [scripted(*(value[row : row + 1] for value in golden.values())) for row in range(PAIRS)]
    columns = zip(*(answer if isinstance(answer, tuple) else (answer,) for answer in answers), strict=True)
    golden |= {signal.name: torch.cat(column) for signal, column in zip(outputs, columns, strict=True)}
    golden["error"] = scripted.error(golden["joint_position"], golden["goal"])
    home = [0.0] * n if home is None else list(home)
    people = {"checkpoint": {}, "evaluation": {}, "config": {}, "versions": {}, "created": ""}
    raw = people | {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "robot": {"name": "arm", "joints": list(joints), "home": home, "end_effector": "", "urdf_sha256": ""},
        "inputs": [describe_signal(signal) for signal in inputs],
        "outputs": [describe_signal(signal) for signal in outputs],
        "limits": {"position": [[-3.0, 3.0]] * n, "velocity": [LIMIT] * n, "effort": [9.0] * n, "command": [LIMIT] * n},
        "control_rate": 50.0,
        "goal": {
            "region": describe_region(region),
            "tolerances": [{"name": one.name, "unit": one.unit, "value": one.value} for one in tolerances],
        },
        "kinematics": _in_a_row(n).describe(),
        "collision": None if collision is None else collision.describe(),
        "golden": {name: value.tolist() for name, value in golden.items()},
        "content_sha256": content_sha256(save(scripted)),
    }
    return save(scripted, json.dumps(raw | {"metadata_sha256": metadata_sha256(raw)}))
