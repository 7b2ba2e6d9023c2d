"""Rotations on numpy arrays with any leading shape; quaternions are (w, x, y, z)."""

import numpy as np

Array = np.ndarray


def quat_to_matrix(quat: Array) -> Array:
    """Unit quaternions (..., 4) -> rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quat, float), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quat(matrix: Array) -> Array:
    """Rotation matrices (..., 3, 3) -> unit quaternions (..., 4) with w >= 0."""
    m = np.asarray(matrix, float)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    w2, x2, y2, z2 = np.moveaxis(squares, -1, 0)
    rows = np.stack(
        [np.stack(row, -1) for row in ((w2, a, b, c), (a, x2, d, e), (b, d, y2, f), (c, e, f, z2))], -2
    )
    # Each row is the quaternion times one of its own components: the largest component's row is exact.
    best = np.take_along_axis(rows, squares.argmax(-1)[..., None, None], -2)[..., 0, :]
    best = best / np.linalg.norm(best, axis=-1, keepdims=True)
    return np.where(best[..., :1] < 0, -best, best)


def about_axis(axis: int, angle: Array | float) -> Array:
    """Rotation (..., 3, 3) about x, y or z (0, 1, 2) by `angle` (...) [rad]."""
    angle = np.asarray(angle, float)
    cos, sin = np.cos(angle), np.sin(angle)
    matrix = np.zeros((*angle.shape, 3, 3))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., first, first] = matrix[..., second, second] = cos
    matrix[..., second, first], matrix[..., first, second] = sin, -sin
    return matrix


def turn(matrix: Array, vector: Array) -> Array:
    """Apply rotations (..., 3, 3) to vectors (..., 3)."""
    return np.einsum("...ij,...j->...i", matrix, vector)


def turn_back(matrix: Array, vector: Array) -> Array:
    """Apply inverse rotations (..., 3, 3) to vectors (..., 3)."""
    return np.einsum("...ji,...j->...i", matrix, vector)
