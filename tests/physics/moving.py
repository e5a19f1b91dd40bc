"""Robots that are put somewhere, given dynamics, and moved."""

import numpy as np

from physai.physics import DynamicsParameters, Physics, RobotState, nominal_dynamics
from physai.robots import RobotSpec

DT = 0.02  # s, control period
WEAK = {"effort_limit": 0.2, "velocity_gain": 0.3}


def dynamics(spec: RobotSpec, rows: int, **changes: object) -> DynamicsParameters:
    """Nominal dynamics of so many robots; ``changes`` are absolute: a number, or one value a robot."""
    values = {key: np.repeat(value, rows, axis=0) for key, value in nominal_dynamics(spec).items()}
    for key, value in changes.items():
        values[key] = np.broadcast_to(np.reshape(np.asarray(value, float), (-1, 1)), values[key].shape).copy()
    return values


def weak(spec: RobotSpec, rows: int) -> DynamicsParameters:
    values = dynamics(spec, rows, payload=1.0)
    return {**values, **{key: scale * values[key] for key, scale in WEAK.items()}}


def wild(spec: RobotSpec, rows: int, random: np.random.Generator) -> DynamicsParameters:
    """Dynamics that differ from robot to robot."""
    values = dynamics(spec, rows, payload=random.uniform(0, 1, rows))
    for key in ("link_mass", "effort_limit", "velocity_gain", "joint_damping", "joint_friction"):
        values[key] = values[key] * random.uniform(0.2, 1.0, values[key].shape)
    return values


def start(spec: RobotSpec, rows: int, random: np.random.Generator) -> RobotState:
    n = len(spec.joints)
    return RobotState(spec.home + random.uniform(-1, 1, (rows, n)), random.uniform(-0.5, 0.5, (rows, n)))


def resting(robots: int, position: object = 0.0, velocity: object = 0.0, joints: int = 2) -> RobotState:
    """Robots that are all in one pose and at one speed: a number, or one value a joint."""
    return RobotState(*(np.broadcast_to(value, (robots, joints)).astype(float) for value in (position, velocity)))


def one_of(state: RobotState, rows: slice) -> RobotState:
    return RobotState(state.joint_position[rows], state.joint_velocity[rows])


def commands(spec: RobotSpec, steps: int, rows: int, random: np.random.Generator) -> np.ndarray:
    """Commands that hold for ten steps and then jump."""
    drawn = random.uniform(-2, 2, (-(-steps // 10), rows, len(spec.joints)))
    return np.repeat(drawn, 10, axis=0)[:steps]


def joints(state: RobotState) -> np.ndarray:
    """Positions and velocities, [2, N, n]."""
    return np.array([state.joint_position, state.joint_velocity])


def run(physics: Physics, given: np.ndarray) -> np.ndarray:
    """Give commands [T, N, n]; return positions and velocities, [T, 2, N, n]."""
    return np.array([joints(physics.step(command)) for command in given])


def reset_all(physics: Physics, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
    physics.reset(np.arange(physics.num_robots), state, parameters)
