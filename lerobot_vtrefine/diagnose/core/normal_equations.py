"""Normal equations whose unknowns have unlike units."""

import numpy as np

Array = np.ndarray


def solved(normal: Array, slope: Array, ridge: float | Array) -> Array:
    """Solutions x (..., P) of normal (..., P, P) x = slope (..., P).

    Args:
        ridge: added to the diagonal once every unknown is scaled to a curvature of one; a number, or (P,).
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    matrix = normal * scale[..., :, None] * scale[..., None, :] + ridge * np.eye(normal.shape[-1])
    return scale * np.linalg.solve(matrix, (scale * slope)[..., None])[..., 0]
