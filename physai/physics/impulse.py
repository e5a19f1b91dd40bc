"""PyBullet's velocity motor for any engine that tells the mass matrix: an impulse within an effort limit each substep."""

import numpy as np

LIMIT_ERP = 0.2  # share of the way back to its limit that a joint makes in one substep; PyBullet's default
FASTEST = 100.0  # rad/s; PyBullet lets no joint turn faster, before and after the motors
_SWEEPS = 50  # of Gauss-Seidel, as PyBullet's solver
_SETTLED = 1e-9  # rad/s; a robot whose joints a sweep changes by less is done


def motor_velocity(
    mass: np.ndarray,
    free: np.ndarray,
    target: np.ndarray,
    impulse_limit: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> np.ndarray:
    """Return the joint velocities after one substep, rad/s, [N, n].

    Each joint is given the impulse, within its limit, that brings it to its target; all are solved together. A bound
    on the velocity, of a joint beyond its limit, holds at any impulse. See Bullet's ``btMultiBodyJointMotor`` and
    ``btMultiBodyJointLimitConstraint``. What happens to a robot does not depend on the others by a bit.

    Args:
        mass: Mass matrices, kg·m², [N, n, n].
        free: Velocities without motors, [N, n].
        target: Velocities that the motors want, [N, n].
        impulse_limit: N·m·s, [N, n].
        lower: Smallest velocities, -inf where there is no bound, [N, n].
        upper: Largest velocities, inf where there is no bound, [N, n].
    """
    impulse = _product(mass, target - free)
    held = np.isfinite(lower) | np.isfinite(upper) | (np.abs(impulse) > impulse_limit)
    rows = held.any(axis=1).nonzero()[0]
    if not len(rows):
        return target
    velocity = target.copy()
    impulse_limit = impulse_limit[rows]
    impulse = np.clip(impulse[rows], -impulse_limit, impulse_limit)
    velocity[rows] = _settle(mass[rows], free[rows], target[rows], impulse, impulse_limit, lower[rows], upper[rows])
    return velocity


def _settle(
    mass: np.ndarray,
    free: np.ndarray,
    target: np.ndarray,
    impulse: np.ndarray,
    impulse_limit: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> np.ndarray:
    """Gauss-Seidel from a first guess of the impulses."""
    inverse = np.linalg.inv(mass)
    velocity = free + _product(inverse, impulse)
    moving = np.ones(len(mass), bool)
    # Joints in front: what belongs to one is one piece of memory.
    columns, response = inverse.transpose(1, 2, 0).copy(), np.einsum("nii->in", inverse).copy()
    velocity, impulse = velocity.T.copy(), impulse.T.copy()
    target, impulse_limit, lower, upper = target.T, impulse_limit.T, lower.T, upper.T
    for _ in range(_SWEEPS):
        most = np.zeros(len(mass))
        for joint, per_impulse in enumerate(response):
            without = velocity[joint] - per_impulse * impulse[joint]
            wanted = (target[joint] - without) / per_impulse
            wanted = np.minimum(np.maximum(wanted, -impulse_limit[joint]), impulse_limit[joint])
            wanted = np.maximum(wanted, (lower[joint] - without) / per_impulse)
            wanted = np.minimum(wanted, (upper[joint] - without) / per_impulse)
            change = np.where(moving, wanted - impulse[joint], 0.0)
            velocity += columns[joint] * change
            impulse[joint] += change
            most = np.maximum(most, np.abs(change) * per_impulse)
        moving = most > _SETTLED
        if not moving.any():
            break
    return velocity.T


def _product(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Matrices [N, n, n] times vectors [N, n], added up in one order however many there are."""
    product = matrix[:, :, 0] * vector[:, :1]
    for column in range(1, vector.shape[1]):
        product += matrix[:, :, column] * vector[:, column : column + 1]
    return product
