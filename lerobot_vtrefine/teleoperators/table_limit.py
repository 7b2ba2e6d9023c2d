"""Keeps the corners of boxes above the table.

mink's own limit knows one closest point of each pair of geoms. With a box that lies flat above the table, the
bound on one corner lets the opposite one dip in, and so on in turn; here every corner has its own bound.
Shapes: G boxes, C = 8 corners each, V velocities of the model.
"""

import mink
import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


class TableLimit(mink.Limit):
    """Bounds how fast corners approach the table.

    Args:
        model: arms and table.
        boxes: ids of the box geoms that stay above it.
        top_m: height of the table's top.
        apart_m: corners stay this far above it.
        look_ahead_m: corners farther away are free.
        approach: largest share of what is left above `apart_m` by which one step may come closer.
        parting_m_s: corners that are lower are raised this fast.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        boxes: list[int],
        top_m: float,
        apart_m: float,
        look_ahead_m: float,
        approach: float,
        parting_m_s: float,
    ) -> None:
        self._model, self._boxes = model, np.array(boxes, int)
        self._least_m, self._look_ahead_m = top_m + apart_m, look_ahead_m
        self._approach, self._parting_m_s = approach, parting_m_s
        self._corners = CORNERS * model.geom_size[self._boxes][:, None]  # (G, C, 3)

    def compute_qp_inequalities(self, configuration: mink.Configuration, dt: float) -> mink.Constraint:
        """G (N, V) times a step <= h (N,) for the N corners that are near; inactive where there are none."""
        data = configuration.data
        turn = data.geom_xmat[self._boxes].reshape(-1, 1, 3, 3)
        places = data.geom_xpos[self._boxes][:, None] + (turn @ self._corners[..., None])[..., 0]
        left = places[..., 2] - self._least_m  # (G, C)
        near = np.argwhere(left < self._look_ahead_m)
        if not len(near):
            return mink.Constraint()
        rows, most = np.zeros((len(near), self._model.nv)), np.zeros(len(near))
        jacobian = np.zeros((3, self._model.nv))
        for row, (box, corner) in enumerate(near):
            body = int(self._model.geom_bodyid[self._boxes[box]])
            mujoco.mj_jac(self._model, data, jacobian, None, places[box, corner], body)
            rows[row] = -jacobian[2]
            above = left[box, corner]
            most[row] = self._approach * above if above > 0 else -self._parting_m_s * dt
        return mink.Constraint(G=rows, h=most)
