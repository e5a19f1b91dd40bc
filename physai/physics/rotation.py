"""Vectors between the world and bodies that are turned in it: quaternions x, y, z, w, in arrays."""

import numpy as np


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn vectors [N, 3] of bodies with unit quaternions [N, 4] into the world."""
    return _rotated(quaternion[:, :3], quaternion[:, 3:], vector)


def rotate_back(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn vectors [N, 3] of the world into bodies with unit quaternions [N, 4]."""
    return _rotated(-quaternion[:, :3], quaternion[:, 3:], vector)


def _rotated(axis: np.ndarray, real: np.ndarray, vector: np.ndarray) -> np.ndarray:
    twice = 2.0 * _cross(axis, vector)
    return vector + real * twice + _cross(axis, twice)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:  # numpy's own takes twice as long
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
