"""What the pads' sensor model reads of worlds: poses, velocities and the solver's loads, wherever they live.

Shapes: m worlds, 4 pads, B = 2 bodies (plug, socket).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim.backends import Backend
from lerobot_vtrefine.sim.scene import Scene
from lerobot_vtrefine.sim.sensing import Kinematics

Array = np.ndarray
ArrayLike = np.ndarray | torch.Tensor


@dataclass(frozen=True)
class Touch:
    """Arguments of `PadSensors.counts`: arrays, or tensors on the pads' device."""

    poses: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike, ArrayLike, ArrayLike]
    """Positions (m, 4, 3) [m], rotations (m, 4, 3, 3) and velocities (m, 4, 6) of the pads, world frame; the
    same of the bodies (m, B, ...).
    """
    load: ArrayLike
    """(m, 4, 3) normal force [N], its centre's x and y in the pad's frame [m]."""


TouchSource = Callable[[Array, Callable[[], Kinematics], Array], Touch]
"""ids (m,), what gives their kinematics on the host where these are needed, and their loads (m, 4, 3)."""


def touch_source(scene: Scene, backend: Backend) -> TouchSource:
    """How to come by a `Touch`: on the worlds' own device where they have one, else from host arrays."""
    reader = backend.touch_reader(scene)
    if reader is None:
        return partial(touch_from_host, scene.embodiment)
    return lambda ids, _see, _load: Touch(*reader(ids))


def touch_from_host(embodiment: Embodiment, _ids: Array, see: Callable[[], Kinematics], load: Array) -> Touch:
    """`Touch` by the embodiment's forward kinematics."""
    seen = see()
    joints, rates = torch.from_numpy(seen.joints), torch.from_numpy(seen.joint_velocities)
    position, rotation = embodiment.pad_poses(joints)
    poses = (
        position.numpy(),
        rotation.numpy(),
        embodiment.pad_twists(joints, rates).numpy(),
        np.stack([seen.plug[0], seen.socket[0]], 1),
        np.stack([seen.plug[1], seen.socket[1]], 1),
        np.stack([seen.plug_velocity, seen.socket_velocity], 1),
    )
    return Touch(poses, load)
