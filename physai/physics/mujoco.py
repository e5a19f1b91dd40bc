"""MuJoCo as a batch of robots, with PyBullet's motors or with a drive's."""

import logging
import math
from threading import Lock
from typing import Literal

import numpy as np

from physai.config import Count, PositiveFloat
from physai.errors import UserError
from physai.physics.impulse import FASTEST, limit_velocity, motor_effort, motor_velocity
from physai.physics.interface import (
    DynamicsParameters,
    RobotState,
    at_home,
    loaded_links,
    loaded_mass,
    nominal_dynamics,
)
from physai.physics.mujoco_floating import FloatingBodies, put_on_floor
from physai.robots import RobotSpec, engine_urdf
from physai.signals import Quantity

try:
    import mujoco
    from mujoco.batch import Batch
except ModuleNotFoundError:  # whoever names this module says what installs it
    raise
except ImportError as error:  # it is three packages, which must be of one version
    raise UserError(" ".join(str(error).split())) from error

_STEPS_PER_TIME_CONSTANT = 7  # of a servo: with fewer, a joint at its effort limit chatters


_log, _told, _telling = logging.getLogger(__name__), set[str](), Lock()


def _warn(text: str) -> None:
    """Tell of one robot of a process; by itself MuJoCo tells of each, and in a file of the current folder, too."""
    what = text.partition(" at ")[0]
    with _telling:  # the threads of a batch come here
        if what in _told or not _log.isEnabledFor(logging.WARNING):
            return
        _told.add(what)
    _log.warning("MuJoCo: %s. Where a robot is unstable, it begins anew at zero. (This is said once.)", what)


mujoco.set_mju_user_warning(_warn)


class MuJoCoPhysics:
    """N robots under gravity: with a fixed base in free space, or with a floating base, each on a floor of its own.

    The interface is :class:`physai.physics.Physics`. Joints that the spec does not control are welded at zero, and
    shapes are left out but for the spheres with which a robot that stands on the floor touches it.

    Joints that are springs (``servo`` of the robot) are solved as such, implicitly. Elsewhere a motor drives each joint
    at a velocity; where the robot takes positions, a servo tells the motor how fast to go, once a control period.

    - ``impulse`` is PyBullet's motor and integration (:mod:`physai.physics.impulse`), so robots move as in
      :class:`physai.physics.pybullet.PyBulletPhysics`, friction included.
    - ``servo`` is how a drive behaves: an effort in proportion to the missing velocity closes in on it with a time
      constant, whatever the pose; the weight of the robot as described is carried at any velocity, as controllers of
      real arms do it, but no payload, nor what links weigh more or less than described; dry friction resists; limits
      of joints are as soft as MuJoCo has them. It takes as many steps a period as the time constant asks for.

    Args:
        spec: The robot.
        num_robots: How many, N.
        control_dt: Control period, s.
        substeps: Physics steps per control period, at least.
        motor: Which motor.
        motor_time_constant: Of a servo with a velocity gain of 1, s.
        threads: Among which the robots are divided; no result depends on it.

    Raises:
        UserError: If MuJoCo refuses the URDF.
    """

    simulated = True

    def __init__(
        self,
        spec: RobotSpec,
        num_robots: int,
        control_dt: float,
        substeps: int = 1,
        *,
        motor: Literal["impulse", "servo"],
        motor_time_constant: PositiveFloat,
        threads: Count,
    ) -> None:
        self.num_robots = num_robots
        self._spec = spec
        if motor == "servo" and spec.servo is None:
            substeps = max(substeps, math.ceil(_STEPS_PER_TIME_CONSTANT * control_dt / motor_time_constant))
        model = _make_model(spec, motor, control_dt / substeps)
        self._batch = Batch(model, num_robots, threads)
        joints = len(spec.joints)  # a base that floats comes before them
        self._position, self._velocity = self._batch.bind("qpos")[:, -joints:], self._batch.bind("qvel")[:, -joints:]
        self._base = FloatingBodies(spec.floating, spec.base, self._batch) if spec.floating else None
        names, mass = loaded_links(spec), model.body_mass
        self._links = [model.body(name).id for name in names]
        self._tip = model.body(spec.carrier).id
        self._moving = [model.body(name).id for name in spec.moving_links]
        self._unit_inertia = model.body_inertia[self._links] / np.where(mass > 0, mass, 1.0)[self._links, None]
        self._mass, self._inertia = self._batch.expand("body_mass"), self._batch.expand("body_inertia")
        self._damping, self._armature = self._batch.expand("dof_damping"), self._batch.expand("dof_armature")
        self._described = loaded_mass(spec, nominal_dynamics(spec))
        self._carried: np.ndarray | None = None
        self._motor: _Impulse | _Servo | _Springs
        if spec.servo is not None:
            self._motor = _Springs(self._batch, substeps, joints)
        elif motor == "impulse":
            self._motor = _Impulse(spec, self._batch, substeps)
        else:
            self._motor = _Servo(self._batch, substeps, control_dt, motor_time_constant)
            self._carried = self._batch.expand("body_gravcomp")
        self._parameters = {key: np.repeat(value, num_robots, axis=0) for key, value in nominal_dynamics(spec).items()}
        self.reset(np.arange(num_robots), at_home(spec, num_robots), self._parameters)

    def reset(self, rows: np.ndarray, state: RobotState, parameters: DynamicsParameters | None = None) -> None:
        """See :meth:`physai.physics.Physics.reset`."""
        self._position[rows], self._velocity[rows] = state.joint_position, state.joint_velocity
        self._motor.effort[rows] = 0.0
        if self._base is not None:
            self._base.reset(rows, state)
        if parameters is None or not len(rows):
            return
        for key, value in parameters.items():
            self._parameters[key][rows] = value
        mass = loaded_mass(self._spec, {key: value[rows] for key, value in self._parameters.items()})
        self._mass[rows[:, None], self._links] = mass
        self._inertia[rows[:, None], self._links] = mass[:, :, None] * self._unit_inertia
        if self._carried is not None:  # the described weight, as a share of what each body weighs
            self._carried[rows[:, None], self._links] = self._described / np.where(mass > 0, mass, 1.0)
        joints = slice(-len(self._spec.joints), None)
        self._damping[rows, joints] = self._parameters["joint_damping"][rows]
        self._armature[rows, joints] = self._parameters["armature"][rows]
        if self._base is not None:
            self._base.set(rows, {key: value[rows] for key, value in self._parameters.items()})
        self._batch.set_const(np.unique(rows))  # what MuJoCo derives from masses
        self._motor.set(rows, {key: value[rows] for key, value in self._parameters.items()})

    def step(self, command: np.ndarray) -> RobotState:
        """See :meth:`physai.physics.Physics.step`."""
        expected = self._position.shape
        if command.shape != expected:
            raise ValueError(f"commands of shape {expected} are needed, got {command.shape}")
        if self._spec.command is Quantity.JOINT_POSITION and self._spec.servo is None:
            fastest, to_go = self._spec.velocity_limit, command - self._position
            command = np.clip(self._spec.position_gain * to_go, -fastest, fastest)
        self._motor.step(command)
        if self._base is not None:
            self._base.update()
        return self.robot_state()

    def robot_state(self) -> RobotState:
        """See :meth:`physai.physics.Physics.robot_state`."""
        state = RobotState(self._position.copy(), self._velocity.copy(), self._motor.effort.copy())
        return state if self._base is None else self._base.added_to(state)

    def parameters(self) -> DynamicsParameters:
        """What the bodies are like as MuJoCo holds it; the rest as the motors got it."""
        parameters = {key: value.copy() for key, value in self._parameters.items()}
        joints = slice(-len(self._spec.joints), None)
        parameters["joint_damping"] = self._damping[:, joints].copy()
        parameters["armature"] = self._armature[:, joints].copy()
        mass = self._mass.copy()
        mass[:, self._tip] -= parameters["payload"][:, 0]
        parameters["link_mass"] = mass[:, self._moving]
        return parameters if self._base is None else parameters | self._base.parameters()

    def state(self) -> dict[str, np.ndarray]:
        """See :meth:`physai.physics.Physics.state`."""
        parameters = {key: value.copy() for key, value in self._parameters.items()}
        joints = {"joint_position": self._position.copy(), "joint_velocity": self._velocity.copy()}
        return {**joints, **parameters, **({} if self._base is None else self._base.state())}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See :meth:`physai.physics.Physics.set_state`."""
        robots = RobotState(
            state["joint_position"], state["joint_velocity"], None, state.get("base_pose"), state.get("base_twist")
        )
        self.reset(np.arange(self.num_robots), robots, {key: state[key] for key in self._parameters})
        if self._base is not None:
            self._base.set_state(state)

    def close(self) -> None:
        """Do nothing: what MuJoCo holds goes with this object."""


class _Impulse:
    """PyBullet's motors, limits, damping and steps, on MuJoCo's mass matrix and forces."""

    def __init__(self, spec: RobotSpec, batch: Batch, substeps: int) -> None:
        self._batch, self._substeps = batch, substeps
        self._lower, self._upper = spec.position_limit.T
        self._position, self._velocity = batch.bind("qpos"), batch.bind("qvel")
        self._acceleration, self._mass = batch.bind("qacc_smooth"), batch.bind("M")
        model = batch.model
        self._places = np.zeros((model.nv, model.nv), int)  # MuJoCo holds the lower triangle of the mass matrix
        for row, (start, count) in enumerate(zip(model.M_rowadr, model.M_rownnz, strict=True)):
            columns = model.M_colind[start : start + count]
            self._places[row, columns] = self._places[columns, row] = np.arange(start, start + count)
        shape = self._position.shape
        self._limit, self._friction, self._gain = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.effort = np.zeros(shape)

    def set(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        self._limit[rows], self._friction[rows] = parameters["effort_limit"], parameters["joint_friction"]
        gain = np.minimum(parameters["velocity_gain"], 1.0)
        self._gain[rows] = gain / (gain + self._substeps * (1.0 - gain))  # the time constant stays the same

    def step(self, command: np.ndarray) -> None:
        dt = self._batch.model.opt.timestep
        position, velocity = self._position.copy(), self._velocity.copy()
        largest = dt * motor_effort(self._limit, self._friction, command, velocity, self._substeps * dt)
        for _ in range(self._substeps):
            self._batch.forward()
            free = np.clip(velocity + dt * self._acceleration, -FASTEST, FASTEST)
            target = free + self._gain * (command - free)
            low, high = limit_velocity(self._lower - position, dt), -limit_velocity(position - self._upper, dt)
            mass = self._mass.take(self._places, axis=1)
            velocity, impulse = motor_velocity(mass, free, target, largest, low, high)
            velocity = np.clip(velocity, -FASTEST, FASTEST)
            position += dt * velocity
            self._position[:], self._velocity[:] = position, velocity
        self.effort = impulse / dt


class _Servo:
    """Velocity actuators whose gain follows the joint's inertia, so that the time constant stays the same."""

    def __init__(self, batch: Batch, substeps: int, control_dt: float, time_constant: float) -> None:
        self._batch, self._substeps, self._dt, self._fastest = batch, substeps, control_dt, time_constant
        self._friction, self._effort = batch.expand("dof_frictionloss"), batch.expand("jnt_actfrcrange")
        self._gain, self._bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        self._mass = batch.bind("M")
        self._own = batch.model.M_rowadr + batch.model.M_rownnz - 1  # the diagonal of the mass matrix
        self._time_constant = np.zeros(batch.bind("qpos").shape)
        self._given, self._resisted = batch.bind("qfrc_actuator"), batch.bind("qfrc_constraint")
        self.effort = np.zeros(self._time_constant.shape)

    def set(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        self._friction[rows] = parameters["joint_friction"]
        self._effort[rows, :, 0], self._effort[rows, :, 1] = -parameters["effort_limit"], parameters["effort_limit"]
        gain = np.clip(parameters["velocity_gain"], 1e-6, 1.0)
        self._time_constant[rows] = self._fastest + self._dt * (1.0 - gain) / gain

    def step(self, command: np.ndarray) -> None:
        self._batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_POS))
        gain = self._mass[:, self._own] / self._time_constant
        self._gain[:, :, 0], self._bias[:, :, 2] = gain, -gain
        self._batch.ctrl = command
        self._batch.step(nstep=self._substeps)
        self.effort = self._given + self._resisted


class _Springs:
    """Position actuators, each with the stiffness and damping of its joint."""

    def __init__(self, batch: Batch, substeps: int, joints: int) -> None:
        self._batch, self._substeps, self._joints = batch, substeps, joints
        self._friction, self._effort = batch.expand("dof_frictionloss"), batch.expand("actuator_forcerange")
        self._gain, self._bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        self._given = batch.bind("actuator_force")
        self.effort = np.zeros((batch.nsim, joints))

    def set(self, rows: np.ndarray, parameters: DynamicsParameters) -> None:
        self._friction[rows, -self._joints :] = parameters["joint_friction"]
        self._effort[rows, :, 0], self._effort[rows, :, 1] = -parameters["effort_limit"], parameters["effort_limit"]
        self._gain[rows, :, 0], self._bias[rows, :, 1] = parameters["stiffness"], -parameters["stiffness"]
        self._bias[rows, :, 2] = -parameters["servo_damping"]

    def step(self, command: np.ndarray) -> None:
        self._batch.ctrl = command
        self._batch.step(nstep=self._substeps)
        self.effort = self._given.copy()


def _make_model(spec: RobotSpec, motor: str, time_step: float) -> "mujoco.MjModel":
    try:
        spheres = spec.floating.spheres if spec.floating else ()
        shapes = [(sphere.body, sphere.center, sphere.radius) for sphere in spheres]
        made = mujoco.MjSpec.from_string(engine_urdf(spec.bodies, spec.joints, shapes).decode())
        made.compiler.fusestatic = False  # a link keeps its mass to itself
        drives, springs = motor == "servo" and spec.servo is None, spec.servo is not None
        for joint in made.joints:
            # The effort limit is the motor's, each robot's own; what carries the weight counts, too.
            joint.actfrclimited, joint.actfrcrange, joint.actgravcomp = drives, [-1.0, 1.0], drives
            if drives or springs:
                actuator = made.add_actuator(name=joint.name, target=joint.name)
                actuator.trntype, actuator.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
                actuator.forcelimited, actuator.forcerange = springs, [-1.0, 1.0]
        for body in made.bodies:
            body.gravcomp = 1.0 if drives else 0.0
        if spec.floating is not None:
            put_on_floor(made, spec.floating, spec.base)
        model = made.compile()
    except ValueError as error:
        raise UserError(f"{spec.urdf}: MuJoCo cannot load it: {' '.join(str(error).split())}") from error
    model.opt.timestep, model.opt.gravity = time_step, spec.gravity
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    off = mujoco.mjtDisableBit
    if spec.servo is None:
        # A warm start would be part of the state; friction and limits are in the impulses.
        model.opt.disableflags |= off.mjDSBL_WARMSTART if motor == "servo" else off.mjDSBL_CONSTRAINT
    return model
