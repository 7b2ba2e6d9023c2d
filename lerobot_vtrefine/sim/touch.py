"""What the pads' sensor model reads of worlds: poses, velocities and the solver's loads, wherever they live.

Shapes: m worlds, P pads, B = 2 bodies (plug, socket).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import override

import numpy as np
import torch

from lerobot_vtrefine.sim.backends import Backend, Trace
from lerobot_vtrefine.sim.backends.base import TouchReader
from lerobot_vtrefine.sim.host import start_copy
from lerobot_vtrefine.sim.kinematics import Kinematics, pad_loads
from lerobot_vtrefine.sim.scene import Scene

Array = np.ndarray
ArrayLike = np.ndarray | torch.Tensor
See = Callable[[], Kinematics]


@dataclass(frozen=True)
class Touch:
    """Arguments of `PadSensors.counts`: arrays, or tensors on the pads' device."""

    poses: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike, ArrayLike, ArrayLike]
    """Positions (m, P, 3) [m], rotations (m, P, 3, 3) and velocities (m, P, 6) of the pads, world frame; the
    same of the bodies (m, B, ...).
    """
    load: ArrayLike
    """(m, P, 3) normal force [N], its centre's x and y in the pad's frame [m]."""
    pull: ArrayLike
    """(m, P, 2) tangential force on the pad, in its frame [N]: what `Pads` shares out as shear."""


class TouchSource(ABC):
    """Where a `Touch` comes from."""

    @abstractmethod
    def start_load(self, ids: Array, trace: Trace, see: See) -> Callable[[], Array]:
        """Begin to read the loads on the pads at the end of a trace that has just been made; what is returned
        waits for them, (m, P, LOAD_SIZE) on the host. `see` gives the worlds' kinematics there.
        """

    def load(self, ids: Array, trace: Trace, see: See) -> Array:
        """The same at once."""
        return self.start_load(ids, trace, see)()

    @abstractmethod
    def __call__(self, ids: Array, see: See, load: Array) -> Touch:
        """At the present state; `see` gives the worlds' kinematics, `load` is what `load` gave."""


class HostTouch(TouchSource):
    """By the host's kinematics."""

    def __init__(self, scene: Scene) -> None:
        self._at = scene.addresses

    @override
    def start_load(self, ids: Array, trace: Trace, see: See) -> Callable[[], Array]:
        contacts = np.asarray(trace.sensors[:, -1][:, self._at.pad_contacts])
        return lambda: pad_loads(see().pads, contacts)

    @override
    def __call__(self, ids: Array, see: See, load: Array) -> Touch:
        seen = see()
        poses = (*seen.pads, seen.pad_velocities, *seen.parts, seen.part_velocities)
        return Touch(poses, load[..., :3], load[..., 3:])


class DeviceTouch(TouchSource):
    """By the worlds' own device, without asking the host."""

    def __init__(self, reader: TouchReader) -> None:
        self._reader = reader

    @override
    def start_load(self, ids: Array, trace: Trace, see: See) -> Callable[[], Array]:
        copied = start_copy(torch.cat(self._reader(ids)[1:], -1))
        return lambda: copied().astype(float)

    @override
    def __call__(self, ids: Array, see: See, load: Array) -> Touch:
        return Touch(*self._reader(ids))


def touch_source(scene: Scene, backend: Backend) -> TouchSource:
    """The one that suits a backend."""
    reader = backend.touch_reader(scene)
    return HostTouch(scene) if reader is None else DeviceTouch(reader)
