"""PyBullet as a batch of robots: several small worlds in one process, each a DIRECT client of its own."""

import tempfile
import weakref
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import pybullet as bullet

from physai.errors import UserError
from physai.physics.impulse import motor_effort
from physai.physics.interface import (
    DynamicsParameters,
    RobotState,
    at_home,
    loaded_links,
    loaded_mass,
    nominal_dynamics,
)
from physai.physics.pybullet_floating import FloatingBodies, Springs, put_on_floor
from physai.robots import RobotSpec, engine_urdf
from physai.signals import Quantity

APART = 10.0  # m; each pair of robots that could touch costs time in each step, and few arms are longer than 5 m


def robots_per_world(spec: RobotSpec) -> int:
    """How many robots share a PyBullet client.

    A client takes 25 ms and 28 MB to make, so few are wanted; but the cost of a step grows faster than what is in it:
    with 32 robots instead of 16, two-link arms step 4 percent slower, and arms of seven links 6 percent.
    """
    return 32 if len(spec.moving_links) < 5 else 16


@dataclass(frozen=True)
class _World:
    client: int
    bodies: list[int]


class PyBulletPhysics:
    """N robots under gravity: with a fixed base in free space, or with a floating base on a floor.

    The interface is :class:`physai.physics.Physics`. Joints that the spec does not control are welded at zero, and
    shapes are left out but for the spheres with which a robot that stands on the floor touches it. Robots never touch
    each other. Contacts are hard, and centres of mass stay where the description has them. What PyBullet remembers of
    contacts is no part of the state: with a floating base, a restored robot goes on as before, but not to the last bit.

    Joints that are springs (``servo`` of the robot) are given their effort once a substep. Elsewhere each joint
    is driven by PyBullet's velocity motor with a limited effort, of which Coulomb friction takes its share
    (:func:`physai.physics.impulse.motor_effort`); where the robot takes positions, a servo tells the motor how fast to
    go, once a control period.

    Args:
        spec: The robot.
        num_robots: How many, N.
        control_dt: Control period, s.
        substeps: Physics steps per control period; joints that are springs get as many as their damping needs.

    Raises:
        UserError: If PyBullet refuses the URDF, has no room for so many worlds, or has not what the robot has: rotors.
    """

    simulated = True
    ignores = "armature", "contact_time", "center_of_mass"

    def __init__(self, spec: RobotSpec, num_robots: int, control_dt: float, substeps: int = 1) -> None:
        if spec.armature.any():
            raise UserError(f"robot '{spec.name}': PyBullet has no rotors (armature: 0, or physics=mujoco)")
        self.num_robots = num_robots
        self.substeps = substeps
        self._spec, self._control_dt = spec, control_dt
        self._worlds: list[_World] = []
        self._finalizer = weakref.finalize(self, _disconnect, self._worlds)
        try:
            with tempfile.TemporaryDirectory(prefix="physai-") as folder:
                model = Path(folder) / "robot.urdf"
                spheres = spec.floating.spheres if spec.floating else ()
                shapes = [(sphere.body, sphere.center, sphere.radius) for sphere in spheres]
                model.write_bytes(engine_urdf(spec.bodies, spec.joints, shapes))
                most = robots_per_world(spec)
                for first in range(0, num_robots, most):
                    robots = min(most, num_robots - first)
                    self._worlds.append(_make_world(spec, model, robots, control_dt / substeps))
        except BaseException:
            self.close()
            raise
        joints, links, masses = _indices(self._worlds[0], spec)
        self._joints: list[int] = joints
        self._links: list[int] = links
        self._unit_inertia = masses
        self._row = [(world.client, body) for world in self._worlds for body in world.bodies]
        n = len(joints)
        self._springs = None
        if spec.servo is not None:
            self._springs = Springs(self._row, joints)
            held = spec.floating is None
            self.substeps = max(substeps, self._springs.substeps(control_dt, spec.home, spec.servo.damping, held))
            for world in self._worlds:
                bullet.setTimeStep(control_dt / self.substeps, world.client)
        self._base = FloatingBodies(spec.floating, self._row, loaded_links(spec), links) if spec.floating else None
        # Of all joints of all robots, in lists: what PyBullet takes and gives are single numbers.
        self._position, self._velocity, self._effort = ([0.0] * (num_robots * n) for _ in range(3))
        # Body, joint, gain.
        self._motors = [(body, joint, 0.0) for _, body in self._row for joint in joints]
        self._parameters = {key: np.repeat(value, num_robots, axis=0) for key, value in nominal_dynamics(spec).items()}
        self.reset(np.arange(num_robots), at_home(spec, num_robots), self._parameters)

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        """See :meth:`physai.physics.Physics.reset`."""
        n = len(self._joints)
        columns = rows.tolist(), state.joint_position.tolist(), state.joint_velocity.tolist()
        for row, q, qd in zip(*columns, strict=True):
            client, body = self._row[row]
            self._position[row * n : (row + 1) * n], self._velocity[row * n : (row + 1) * n] = q, qd
            self._effort[row * n : (row + 1) * n] = [0.0] * n
            for joint, position, velocity in zip(self._joints, q, qd, strict=True):
                bullet.resetJointState(body, joint, position, velocity, client)
        if self._base is not None:
            self._base.reset(rows, state)
        if parameters is not None:
            self._set_parameters(rows, parameters)

    def _set_parameters(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        for key, value in parameters.items():
            self._parameters[key][rows] = value
        mass = loaded_mass(self._spec, {key: value[rows] for key, value in self._parameters.items()})
        damping = self._parameters["joint_damping"][rows]
        for row, masses, dampings in zip(rows.tolist(), mass.tolist(), damping.tolist(), strict=True):
            client, body = self._row[row]
            for link, link_mass, (xx, yy, zz) in zip(self._links, masses, self._unit_inertia, strict=True):
                bullet.changeDynamics(
                    body,
                    link,
                    mass=link_mass,
                    localInertiaDiagonal=(xx * link_mass, yy * link_mass, zz * link_mass),
                    physicsClientId=client,
                )
            for joint, value in zip(self._joints, dampings, strict=True):
                bullet.changeDynamics(body, joint, jointDamping=value, physicsClientId=client)
        if self._base is not None:
            self._base.set(rows, self._parameters["floor_friction"][rows])
        if self._springs is not None:
            self._springs.set(rows, {key: value[rows] for key, value in self._parameters.items()})
            return
        # Applied once a substep: the time constant stays the same, and how far gravity pulls a joint down.
        gain = np.minimum(self._parameters["velocity_gain"][rows], 1.0)
        gain /= gain + self.substeps * (1.0 - gain)
        n = len(self._joints)
        for row, gains in zip(rows.tolist(), gain.tolist(), strict=True):
            bodies = [self._row[row][1]] * n
            self._motors[row * n : (row + 1) * n] = zip(bodies, self._joints, gains, strict=True)

    def step(self, command: np.ndarray) -> RobotState:
        """See :meth:`physai.physics.Physics.step`."""
        expected = self.num_robots, len(self._joints)
        if command.shape != expected:
            raise ValueError(f"commands of shape {expected} are needed, got {command.shape}")
        if self._springs is not None:
            self._position, self._velocity, self._effort = self._springs.step(command, self.substeps)
            if self._base is not None:
                self._base.update()
            return self.robot_state()
        if self._spec.command is Quantity.JOINT_POSITION:
            fastest, to_go = self._spec.velocity_limit, command - self.robot_state().joint_position
            command = np.clip(self._spec.position_gain * to_go, -fastest, fastest)
        limit, friction = self._parameters["effort_limit"], self._parameters["joint_friction"]
        velocity = np.array(self._velocity).reshape(expected)
        largest = motor_effort(limit, friction, command, velocity, self._control_dt)
        self._advance(command.ravel().tolist(), largest.ravel().tolist())
        return self.robot_state()

    def _advance(self, targets: list[float], largest_efforts: list[float]) -> None:
        # One flat pass over all joints of all robots: this loop is what collection costs most.
        commands = zip(self._motors, targets, largest_efforts, strict=True)
        command, step, read = bullet.setJointMotorControl2, bullet.stepSimulation, bullet.getJointStates
        mode, joints = bullet.VELOCITY_CONTROL, self._joints
        positions: list[float] = []
        velocities: list[float] = []
        efforts: list[float] = []
        for world in self._worlds:
            client = world.client
            motors = islice(commands, len(world.bodies) * len(joints))
            for (body, joint, gain), target, largest in motors:
                command(body, joint, mode, 0.0, target, largest, 0.1, gain, 0.0, client)
            for _ in range(self.substeps):
                step(client)
            for body in world.bodies:
                for position, velocity, _, effort in read(body, joints, client):
                    positions.append(position)
                    velocities.append(velocity)
                    efforts.append(effort)
        self._position, self._velocity, self._effort = positions, velocities, efforts

    def robot_state(self) -> RobotState:
        """See :meth:`physai.physics.Physics.robot_state`."""
        shape = self.num_robots, len(self._joints)
        state = RobotState(
            *(np.fromiter(each, float).reshape(shape) for each in (self._position, self._velocity, self._effort))
        )
        return state if self._base is None else self._base.added_to(state)

    def parameters(self) -> DynamicsParameters:
        """Masses and damping as PyBullet holds them; the rest as every step hands it to the motors."""
        parameters = {key: value.copy() for key, value in self._parameters.items()}
        for world in self._worlds:
            bullet.syncBodyInfo(world.client)  # getJointInfo answers from a copy that changeDynamics does not reach
        for row, (client, body) in enumerate(self._row):
            masses = dict(zip(loaded_links(self._spec), self._links, strict=True))
            masses = {name: bullet.getDynamicsInfo(body, link, client)[0] for name, link in masses.items()}
            masses[self._spec.carrier] -= parameters["payload"][row, 0]
            parameters["link_mass"][row] = [masses[name] for name in self._spec.moving_links]
            parameters["joint_damping"][row] = [bullet.getJointInfo(body, joint, client)[6] for joint in self._joints]
        return parameters

    def state(self) -> dict[str, np.ndarray]:
        """See :meth:`physai.physics.Physics.state`."""
        state = self.robot_state()
        return {
            "joint_position": state.joint_position,
            "joint_velocity": state.joint_velocity,
            **({} if self._base is None else {"base_pose": state.base_pose, "base_twist": state.base_twist}),
            **{key: value.copy() for key, value in self._parameters.items()},
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See :meth:`physai.physics.Physics.set_state`."""
        parameters = {key: state[key] for key in self._parameters}
        robots = RobotState(
            state["joint_position"], state["joint_velocity"], None, state.get("base_pose"), state.get("base_twist")
        )
        self.reset(np.arange(self.num_robots), robots, parameters)

    def close(self) -> None:
        """Disconnect all clients."""
        _disconnect(self._worlds)


def _disconnect(worlds: list[_World]) -> None:
    while worlds:
        bullet.disconnect(worlds.pop().client)


def _make_world(spec: RobotSpec, model: Path, robots: int, time_step: float) -> _World:
    client = bullet.connect(bullet.DIRECT)
    if client < 0:
        raise UserError("PyBullet has no room for another world in this process (it holds 1,024)")
    bullet.setTimeStep(time_step, client)
    bullet.setGravity(*spec.gravity, client)
    # By default PyBullet ends after 50 sweeps over the motors, or when their impulses hardly change. An arm of seven
    # joints then goes up to 0.07 rad astray in 4 s; going on until they agree costs a fifth of its steps, and 3 percent
    # of a two-link arm's. Each robot is solved by itself, as long as it needs.
    bullet.setPhysicsEngineParameter(
        numSolverIterations=1000, solverResidualThreshold=1e-10, minimumSolverIslandSize=1, physicsClientId=client
    )
    options = {"useFixedBase": spec.floating is None, "flags": bullet.URDF_USE_INERTIA_FROM_FILE}
    try:
        bodies = [
            bullet.loadURDF(str(model), basePosition=(APART * robot, 0, 0), physicsClientId=client, **options)
            for robot in range(robots)
        ]
    except bullet.error as error:
        bullet.disconnect(client)
        raise UserError(f"{spec.urdf}: PyBullet cannot load it: {error}") from error
    for body in bodies:
        for link in range(-1, bullet.getNumJoints(body, client)):
            # The damping that counts is that of the joints.
            bullet.changeDynamics(body, link, linearDamping=0, angularDamping=0, physicsClientId=client)
            # Even shapeless robots meet in the broadphase; solved in one island, they would feel each other's rounding.
            bullet.setCollisionFilterGroupMask(body, link, 0, 0, client)
    if spec.floating is not None:
        put_on_floor(client, bodies)
    return _World(client, bodies)


def _indices(world: _World, spec: RobotSpec) -> tuple[list[int], list[int], list[tuple[float, float, float]]]:
    """PyBullet's indices of the joints and links of the spec, and the links' inertia per kg."""
    body, client = world.bodies[0], world.client
    infos = [bullet.getJointInfo(body, joint, client) for joint in range(bullet.getNumJoints(body, client))]
    joints = {info[1].decode(): info[0] for info in infos}
    links = {bullet.getBodyInfo(body, client)[0].decode(): -1} | {info[12].decode(): info[0] for info in infos}
    loaded = [links[name] for name in loaded_links(spec)]
    dynamics = [bullet.getDynamicsInfo(body, link, client) for link in loaded]
    unit_inertia = [tuple(moment / (info[0] or 1.0) for moment in info[2]) for info in dynamics]
    return [joints[name] for name in spec.joints], loaded, unit_inertia
