"""PyBullet's velocity motors and joint limits, for any engine that tells its mass matrix."""

import numpy as np

FASTEST = 100.0  # rad/s; PyBullet lets no joint turn faster, before and after the motors
_ERP = 0.2  # share of the way back to its limit that a joint goes in one substep
# A joint that is farther beyond its limit is stopped, and not pushed back (Bullet's split impulse).
_DEEPEST = 0.04  # rad
# Friction adds to a motor that brakes as hard for a whole step, and in part where it does so for a part of the step.
_FULL_BRAKING = 25.0  # rad/s²
_ROUNDS, _TOGETHER = 100, 10
_EXACT = 1e-9  # rad/s, and a share of the impulses


def motor_velocity(
    mass: np.ndarray, free: np.ndarray, target: np.ndarray, limit: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint velocities after one substep, rad/s, and the impulses of the motors, N·m·s, [N, n] each.

    Each motor gives its joint the impulse that brings it to its target, or as much as it can; each limit what it takes.
    All are solved together, exactly: PyBullet's own sweeps end before they agree where joints are hard to tell apart.
    See Bullet's ``btMultiBodyJointMotor`` and ``btMultiBodyJointLimitConstraint``. What happens to a robot does not
    depend on the others by a bit.

    Args:
        mass: Mass matrices, kg·m², [N, n, n].
        free: Velocities without motors, [N, n].
        target: Velocities that the motors want, [N, n].
        limit: The largest impulses of the motors, N·m·s, [N, n].
        lower: Smallest velocities, whatever it takes; -inf where there is no bound, [N, n].
        upper: Largest velocities, likewise, [N, n].
    """
    impulse = _product(mass, target - free)
    bound = np.isfinite(lower) | np.isfinite(upper) | (np.abs(impulse) > limit)
    rows = bound.any(axis=1).nonzero()[0]
    if not len(rows):
        return target, impulse
    velocity = target.copy()
    velocity[rows] = _solve(*(array[rows] for array in (mass, free, target, limit, lower, upper, impulse)))
    impulse[rows] = _product(mass[rows], velocity[rows] - free[rows])
    return velocity, np.clip(impulse, -limit, limit)  # beyond that it is a joint's limit that pushes


def motor_effort(
    limit: np.ndarray, friction: np.ndarray, command: np.ndarray, velocity: np.ndarray, dt: float
) -> np.ndarray:
    """Return the largest efforts of motors, N·m, which Coulomb friction makes smaller or larger, [N, n].

    PyBullet's motors have no such friction. It takes from a motor that accelerates a joint, and adds to one that brakes
    it. It adds in proportion to the velocity, or to what of it is too much, until all of it adds: a velocity too small
    to be measured changes little.

    Args:
        limit: Largest efforts without friction, N·m, [N, n].
        friction: Of the joints, N·m, [N, n].
        command: Velocities that the motors aim at, rad/s, [N, n].
        velocity: Of the joints, rad/s, [N, n].
        dt: Control period, s.
    """
    # Twice the smaller of velocity and missing velocity where one is against the other, and 0 elsewhere.
    braking = np.abs(velocity) + np.abs(command - velocity) - np.abs(command)
    return np.maximum(limit - friction + np.minimum(braking / (_FULL_BRAKING * dt), 2.0) * friction, 0.0)


def limit_velocity(beyond: np.ndarray, dt: float) -> np.ndarray:
    """Return how fast joints are pushed back at least, rad/s; -inf within the limits.

    Args:
        beyond: How far joints are beyond a limit, rad.
        dt: Substep, s.
    """
    back = np.where(beyond > _DEEPEST, 0.0, _ERP / dt * beyond)
    return np.where(beyond >= 0.0, back, -np.inf)


def _solve(
    mass: np.ndarray,
    free: np.ndarray,
    target: np.ndarray,
    limit: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    impulse: np.ndarray,
) -> np.ndarray:
    """Pivot until each joint stands on a step of its staircase that fits the others'.

    The less velocity, the more impulse: a staircase with five steps for each joint. On even ones the velocity is
    given: 0 by the upper limit, 2 by the motor's target, 4 by the lower limit. On odd ones the impulse is: all that
    the motor has, backward on 1 and forward on 3. All joints that do not fit take a step at once, which needs few
    rounds; after some, one at a time, which cannot go round in circles (Júdice and Pires, 1994, on pivoting in blocks).
    """
    middle, endless = np.clip(target, lower, upper), np.full_like(target, np.inf)
    # On a target that a limit has moved, that limit helps the motor without end.
    least, most = np.where(target > upper, -endless, -limit), np.where(target < lower, endless, limit)
    # Of each step: the change of velocity or the impulse that is given, and the bounds of the other one; those of a
    # velocity are negated, so that all are passed upward where there must be more impulse.
    known = np.stack([upper - free, -limit, middle - free, limit, lower - free])
    largest = np.stack([-limit, -middle, most, -lower, endless])
    smallest = np.stack([-endless, -upper, least, -middle, limit])
    step = np.where(impulse > most, 3, np.where(impulse < least, 1, 2))
    velocity, rows = target.copy(), np.arange(len(target))
    eye, each = np.eye(target.shape[1]), np.arange(target.size).reshape(target.shape)
    for round_ in range(_ROUNDS):
        given, at = step % 2 == 0, step * step.size + each
        matrix = np.where(given[:, :, None], eye, mass)
        change = np.linalg.solve(matrix, known.take(at)[:, :, None])[:, :, 0]
        impulse, speed = _product(mass, change), free + change
        velocity[rows] = speed
        slack = np.where(given, _EXACT * (1.0 + np.abs(impulse)), _EXACT)
        found = np.where(given, impulse, -speed)
        up, down = found > largest.take(at) + slack, found < smallest.take(at) - slack
        if round_ >= _TOGETHER:
            last = np.cumsum((up | down)[:, ::-1], axis=1)[:, ::-1] == 1
            up, down = up & last, down & last
        step = step + up - down
        open_ = (up | down).any(axis=1)
        if not open_.any():
            break
        if not open_.all():
            rows, step, mass, free = (array[open_] for array in (rows, step, mass, free))
            known, largest, smallest = (array.compress(open_, axis=1) for array in (known, largest, smallest))
            each = each[: len(rows)]
    return velocity


def _product(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Matrices [N, n, n] times vectors [N, n], added up in one order however many there are."""
    product = matrix[:, :, 0] * vector[:, :1]
    for column in range(1, vector.shape[1]):
        product += matrix[:, :, column] * vector[:, column : column + 1]
    return product
