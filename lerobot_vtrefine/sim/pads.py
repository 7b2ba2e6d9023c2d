"""The pads of simulated worlds: what touches them, as raw counts.

Shapes: m worlds, P pads of T taxels.
"""

from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim.config import ShearConfig
from lerobot_vtrefine.sim.host import to_host
from lerobot_vtrefine.sim.parts import Part
from lerobot_vtrefine.sim.scene import Scene
from lerobot_vtrefine.sim.touch import Touch
from lerobot_vtrefine.tactile import (
    BodyGeometry,
    PadSensors,
    Poses,
    SensorModel,
)
from lerobot_vtrefine.tactile.shear import Shear, ShearSensors

Array = np.ndarray


class Pads:
    """The pads of every world."""

    def __init__(
        self,
        scene: Scene,
        model: SensorModel,
        num_envs: int,
        control_dt_s: float,
        device: str,
        num_threads: int,
        shear: ShearConfig | None,
    ) -> None:
        self._dt_s = control_dt_s
        bodies = [_touch_geometry(scene.pair.plug), _touch_geometry(scene.pair.socket)]
        self.layout = scene.embodiment.pad_layout
        pads = len(scene.embodiment.pad_names)
        self.sensors = PadSensors(
            self.layout, bodies, num_envs, pads, model=model, device=device, num_threads=num_threads
        )
        self._shear = None
        if shear is not None and shear.on:
            skin = Shear(scene.config.pad_friction, shear.stiffness_n_per_m)
            self._shear = ShearSensors(self.layout, num_envs, held_bodies(scene.embodiment), skin, device)
        self._in_order = model.has_state
        self._last = torch.zeros(
            (num_envs, pads, self.layout.num_taxels), dtype=torch.uint8, device=self.sensors.device
        )

    @property
    def remembers(self) -> bool:
        """Whether readings depend on earlier ones, so that every control step must `advance`."""
        return self._in_order or self._shear is not None

    def reset(self, ids: Array, seeds: Array, drawn: dict[str, Array]) -> None:
        """Start new episodes: sensor traits and noise follow the seeds (m,); `drawn` holds the worlds'
        parameters by the names of `RandomizationConfig`.
        """
        self.sensors.reset(ids, seeds)
        stiffness, gain = drawn["pad_stiffness_scale"], drawn["sensor_gain_scale"]
        self.sensors.randomize(ids, stiffness_scale=stiffness, gain_scale=gain)
        if self._shear is not None:
            self._shear.reset(ids, drawn["pad_friction"])

    def advance(self, ids: Array, touch: Touch) -> None:
        """Let one control step pass, for readings that remember."""
        if self._shear is not None:
            poses = Poses(*touch.poses)
            normal = self.sensors.forces(ids, poses, self._dt_s, touch.load)
            self._shear.advance(ids, normal, poses, self._dt_s, touch.pull)
        if self._in_order:
            self._last[ids] = self._read(ids, touch)

    def counts(self, ids: Array, touch: Touch) -> torch.Tensor:
        """Raw counts (m, P, T) uint8 at the worlds' present state, on the pads' device."""
        return self._last[ids] if self._in_order else self._read(ids, touch)

    def baseline(self, ids: Array) -> torch.Tensor:
        """Counts of the untouched taxels (m, P, T) uint8, on the pads' device."""
        return self.sensors.baseline_counts(ids)

    def shear(self, ids: Array) -> Array:
        """Tangential force per taxel (m, P, T, 2) float32 [N] as of the last control step.

        Raises:
            ValueError: shear is off.
        """
        if self._shear is None:
            raise ValueError("shear is off: switch it on with --env.shear.on=true or ShearConfig(on=True)")
        return to_host(self._shear.forces(ids).flatten(2, 3))

    def get_state(self, env: int) -> dict[str, Any]:
        """Everything that world `env`'s readings depend on."""
        state = {"sensors": self.sensors.get_state(env), "last": self._last[env].clone()}
        return state if self._shear is None else {**state, "shear": self._shear.get_state(env)}

    def set_state(self, env: int | Array, state: dict[str, Any]) -> None:
        """Continue from a state taken by `get_state`; of several worlds (m,), values are (m, ...)."""
        self.sensors.set_state(env, state["sensors"])
        self._last[env] = torch.as_tensor(state["last"], device=self._last.device)
        if self._shear is not None:
            self._shear.set_state(env, state["shear"])

    def _read(self, ids: Array, touch: Touch) -> torch.Tensor:
        return torch.as_tensor(self.sensors.counts(ids, Poses(*touch.poses), self._dt_s, touch.load))


def held_bodies(embodiment: Embodiment) -> tuple[int, ...]:
    """What each pad holds, of (plug, socket): (P,) indices."""
    return tuple(
        ("plug", "socket").index(arm.holds) for arm in embodiment.arms for _ in embodiment.fingers.sides
    )


def _touch_geometry(part: Part) -> BodyGeometry:
    return BodyGeometry([part.surface] if part.surface is not None else list(part.pieces))
