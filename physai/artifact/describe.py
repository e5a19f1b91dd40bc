"""The metadata of an exported policy."""

import datetime
import hashlib
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

import physai
from physai.artifact.module import DeployablePolicy
from physai.artifact.states import States
from physai.collision import CollisionModel
from physai.deploy.metadata import FORMAT, FORMAT_VERSION, describe_region, describe_signal
from physai.envs.simulation import Simulation
from physai.robots import kinematics_of


def describe_robot(simulation: Simulation, policy: DeployablePolicy) -> dict[str, Any]:
    """Robot, signals, limits, rate and goals: what a controller must know."""
    spec, task = simulation.spec, simulation.task
    return {
        "robot": {
            "name": spec.name,
            "joints": list(spec.joints),
            "base": "fixed" if spec.floating is None else "floating",
            "end_effector": spec.end_effector or "",
            "urdf_sha256": hashlib.sha256(spec.urdf.read_bytes()).hexdigest(),
            "home": spec.home.tolist(),
        },
        "inputs": [describe_signal(signal) for signal in policy.inputs],
        "outputs": [describe_signal(signal) for signal in policy.outputs],
        "limits": {
            "position": [[x if np.isfinite(x) else None for x in pair] for pair in spec.position_limit.tolist()],
            "velocity": spec.velocity_limit.tolist(),
            "effort": spec.effort_limit.tolist(),
            "command": spec.command_limit.tolist(),
        },
        "control_rate": 1.0 / simulation.config.control_dt,
        "goal": {
            "region": describe_region(task.region),
            "tolerances": [vars(tolerance) for tolerance in task.tolerances],
        },
        "kinematics": kinematics_of(spec).describe(),
        "collision": None if (model := capsules(simulation)) is None else model.describe(),
    }


def capsules(simulation: Simulation) -> CollisionModel | None:
    """Return the robot's capsules, with what it was trained not to touch; None where it has none."""
    return simulation.task.surroundings or simulation.spec.collision


def describe_origin(git_commit: str | None) -> dict[str, Any]:
    """What made the file, and when."""
    packages = ["torch", "torchrl", "tensordict", "numpy"]
    packages += [engine for engine in ("pybullet", "mujoco") if find_spec(engine)]  # one of them is enough
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "versions": {"physai": physai.__version__, **{package: version(package) for package in packages}},
        "git_commit": git_commit,
    }


def golden_pairs(states: States, answers: dict[str, Tensor], pairs: int) -> dict[str, Any]:
    """Pick pairs for the loader to try, evenly from S states and the answers to them, asked for at batch 1."""
    rows = torch.linspace(0, len(states) - 1, pairs).long()
    columns = states | answers
    return {key: value[rows].tolist() for key, value in columns.items()}  # doubles hold float32 exactly
