"""What only a simulation knows and touch tells: how the parts lie in their hands, and how they touch.

A policy never sees it when it acts; it can be what an encoder has to tell while it is trained.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = np.ndarray

BLOCKS = (
    "socket_in_hand",
    "socket_in_hand_rotation",
    "plug_in_hand",
    "plug_in_hand_rotation",
    "contact_force",
)
"""Of the critic's state: places [m], the first two columns of rotations, and the force on the plug [N]."""
TRUTH_SIZE = 25
"""Values of ``BLOCKS``, and of ``InsertionSim.part_touch`` after them."""


def truth(sim: "InsertionSim", ids: Array) -> Array:
    """(m, TRUTH_SIZE) float32 of worlds ``ids`` (m,).

    Raises:
        ValueError: a part is in no hand.
    """
    chosen = [at for at, name in enumerate(sim.privileged_names) if name.rpartition("_")[0] in BLOCKS]
    values = np.concatenate([sim.privileged(ids)[:, chosen], sim.part_touch(ids)], 1)
    if values.shape[1] != TRUTH_SIZE:
        raise ValueError("how parts lie in their hands needs two hands that hold one each: not socket=stands")
    return values.astype(np.float32)
