"""Normal equations whose unknowns have unlike units."""

import numpy as np

Array = np.ndarray


def solved(normal: Array, slope: Array, ridge: float | Array) -> Array:
    """Solution x (P,) of normal (P, P) x = slope (P,).

    Args:
        ridge: added to the diagonal once every unknown is scaled to a curvature of one; a number, or (P,).
    """
    diagonal = np.diag(normal)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    matrix = normal * scale[:, None] * scale + np.diag(np.broadcast_to(ridge, len(normal)))
    return scale * np.linalg.solve(matrix, scale * slope)
