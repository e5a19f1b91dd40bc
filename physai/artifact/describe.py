"""The metadata of an exported policy."""

import datetime
import hashlib
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from torch import Tensor

import physai
from physai.artifact.states import States
from physai.deploy.metadata import (
    FORMAT,
    FORMAT_VERSION,
    MEMORY,
    NEW_MEMORY,
    OUTPUT,
    UNITS,
    input_keys,
    output_keys,
)
from physai.envs.simulation import Simulation


def describe_robot(simulation: Simulation, memory_size: int = 0) -> dict[str, Any]:
    """Robot, joints, limits, rate and goals, and how much the policy remembers: what a controller must know."""
    spec, config = simulation.spec, simulation.config
    joints, goal = len(spec.joints), simulation.task.goal_size
    inner, outer = simulation.task.goal_region
    sizes = {"joint_position": joints, "joint_velocity": joints, "goal": goal, OUTPUT: joints}
    sizes |= {MEMORY: memory_size, NEW_MEMORY: memory_size}
    return {
        "robot": {
            "name": spec.name,
            "joints": list(spec.joints),
            "end_effector": spec.end_effector,
            "urdf_sha256": hashlib.sha256(spec.urdf.read_bytes()).hexdigest(),
        },
        "units": UNITS,
        "inputs": {key: ["N", sizes[key]] for key in input_keys(memory_size)},
        "outputs": {key: ["N", sizes[key]] for key in output_keys(memory_size)},
        "limits": {
            "position": [[x if np.isfinite(x) else None for x in pair] for pair in spec.position_limit.tolist()],
            "velocity": spec.velocity_limit.tolist(),
            "effort": spec.effort_limit.tolist(),
            "command": [config.max_velocity] * joints,
        },
        "control_rate": 1.0 / config.control_dt,
        "goal": {"frame": spec.base, "radius": [inner, outer], "tolerance": simulation.task.tolerance},
    }


def describe_origin(git_commit: str | None) -> dict[str, Any]:
    """What made the file, and when."""
    packages = ("torch", "torchrl", "tensordict", "pybullet", "numpy")
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "created": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "versions": {"physai": physai.__version__, **{package: version(package) for package in packages}},
        "git_commit": git_commit,
    }


def golden_pairs(states: States, answers: dict[str, Tensor], pairs: int) -> dict[str, Any]:
    """Pick pairs for the loader to try, evenly from S states and the answers to them, asked for at batch 1."""
    rows = torch.linspace(0, len(states.goal) - 1, pairs).long()
    columns = states.named() | answers
    return {key: value[rows].tolist() for key, value in columns.items()}  # doubles hold float32 exactly
