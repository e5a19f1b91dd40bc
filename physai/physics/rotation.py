"""Vectors between the world and bodies that are turned in it: quaternions x, y, z, w, in arrays."""

import numpy as np


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn vectors [N, 3] of bodies with unit quaternions [N, 4] into the world."""
    return _rotated(quaternion[:, :3], quaternion[:, 3:], vector)


def rotate_back(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn vectors [N, 3] of the world into bodies with unit quaternions [N, 4]."""
    return _rotated(-quaternion[:, :3], quaternion[:, 3:], vector)


def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the turn by ``other`` and then by ``one``: unit quaternions, [N, 4] each."""
    axis, real = one[:, :3], one[:, 3:]
    turned = real * other[:, :3] + other[:, 3:] * axis + _cross(axis, other[:, :3])
    return np.concatenate([turned, real * other[:, 3:] - (axis * other[:, :3]).sum(axis=1, keepdims=True)], axis=1)


def shortest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest turns that bring unit vectors [N, 3] to others that are not opposite: quaternions [N, 4]."""
    turn = np.concatenate([_cross(start, end), 1.0 + (start * end).sum(axis=1, keepdims=True)], axis=1)
    normalized: np.ndarray = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return normalized


def _rotated(axis: np.ndarray, real: np.ndarray, vector: np.ndarray) -> np.ndarray:
    twice = 2.0 * _cross(axis, vector)
    return vector + real * twice + _cross(axis, twice)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:  # numpy's own takes twice as long
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
