"""From the state of worlds to what the robot's sensors would give: joint positions, raw pad counts, depth.

Shapes: m worlds, A hands, P pads of T taxels, B = 2 bodies (plug, socket).
"""

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.embodiments.kinematics import Hands
from lerobot_vtrefine.sim.config import ShearConfig
from lerobot_vtrefine.sim.host import to_host
from lerobot_vtrefine.sim.pairs import Part
from lerobot_vtrefine.sim.rotations import quat_to_matrix, turn, turn_back
from lerobot_vtrefine.sim.scene import Scene
from lerobot_vtrefine.tactile import (
    BodyGeometry,
    PadLayout,
    PadSensors,
    Poses,
    SensorModel,
    layout_from_mesh,
)
from lerobot_vtrefine.tactile.shear import Shear, ShearSensors

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.touch import Touch

Array = np.ndarray


def held_bodies(embodiment: Embodiment) -> tuple[int, ...]:
    """What each pad holds, of (plug, socket): (P,) indices."""
    return tuple(
        ("plug", "socket").index(arm.holds) for arm in embodiment.arms for _ in embodiment.fingers.sides
    )


class Kinematics:
    """Where everything is in m worlds with positions (m, nq) and velocities (m, nv); what is asked for is
    computed once.
    """

    def __init__(self, scene: Scene, qpos: Array, qvel: Array) -> None:
        self._scene, self._qpos, self._qvel = scene, qpos, qvel

    @cached_property
    def joints(self) -> Array:
        """(m, J)"""
        return self._qpos[:, self._scene.addresses.qpos]

    @cached_property
    def joint_velocities(self) -> Array:
        """(m, J)"""
        return self._qvel[:, self._scene.addresses.dof]

    @cached_property
    def hands(self) -> tuple[Array, Array]:
        """Positions (m, A, 3) and rotations (m, A, 3, 3) of the TCPs."""
        position, rotation = self._arms.tcp()
        return position.numpy(), rotation.numpy()

    @cached_property
    def pads(self) -> tuple[Array, Array]:
        """Positions (m, P, 3) and rotations (m, P, 3, 3) of the pads."""
        position, rotation = self._arms.pads()
        return position.numpy(), rotation.numpy()

    @cached_property
    def pad_velocities(self) -> Array:
        """(m, P, 6) linear velocity of the origin, then angular, world frame; the same of the parts."""
        return self._arms.pad_twists(torch.from_numpy(self.joint_velocities)).numpy()

    @cached_property
    def parts(self) -> tuple[Array, Array]:
        """Positions (m, B, 3) and rotations (m, B, 3, 3) of the plug and the socket."""
        at = self._scene.addresses
        return part_pose(np.stack([self._qpos[:, at.plug_qpos], self._qpos[:, at.socket_qpos]], 1))

    @cached_property
    def part_velocities(self) -> Array:
        """(m, B, 6)"""
        at = self._scene.addresses
        velocity = np.stack([self._qvel[:, at.plug_dof], self._qvel[:, at.socket_dof]], 1)
        # A free joint's velocity has its angular part in the body's frame.
        return np.concatenate([velocity[..., :3], turn(self.parts[1], velocity[..., 3:])], -1)

    @property
    def plug(self) -> tuple[Array, Array]:
        """Position (m, 3) and rotation (m, 3, 3)."""
        return self.parts[0][:, 0], self.parts[1][:, 0]

    @property
    def socket(self) -> tuple[Array, Array]:
        """Position (m, 3) and rotation (m, 3, 3)."""
        return self.parts[0][:, 1], self.parts[1][:, 1]

    @cached_property
    def _arms(self) -> Hands:
        return self._scene.embodiment.hands(torch.from_numpy(self.joints))


def part_pose(pose: Array) -> tuple[Array, Array]:
    """(..., 7) position and quaternion -> position (..., 3) and rotation (..., 3, 3)."""
    return pose[..., :3], quat_to_matrix(pose[..., 3:])


def pad_loads(pads: tuple[Array, Array], contacts: Array) -> Array:
    """Contact sensors' wrenches as loads on the pads.

    Args:
        pads: their positions (m, P, 3) and rotations (m, P, 3, 3).
        contacts: (m, P, 10) found, force of the pad on its counterpart, torque, centre; world frame.

    Returns:
        (m, P, LOAD_SIZE): normal force pressing on the pad [N], its centre's x and y [m], the tangential
        force on the pad along x and y [N]; in the pad's frame, zeros where nothing touches.
    """
    position, rotation = pads
    force = turn_back(rotation, contacts[..., 1:4])
    centre = turn_back(rotation, contacts[..., 7:10] - position)[..., :2]
    touched = contacts[..., 0] > 0
    load = np.concatenate([np.maximum(force[..., 2:], 0.0), centre, -force[..., :2]], -1)
    return np.where(touched[..., None], load, 0.0)


class Pads:
    """The pads of every world."""

    def __init__(
        self,
        scene: Scene,
        model: SensorModel,
        num_envs: int,
        control_dt_s: float,
        device: str = "cpu",
        num_threads: int = 1,
        shear: ShearConfig | None = None,
    ) -> None:
        self._dt_s = control_dt_s
        bodies = [_touch_geometry(scene.pair.plug), _touch_geometry(scene.pair.socket)]
        self.layout = pad_layout(scene.embodiment)
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

    def advance(self, ids: Array, touch: "Touch") -> None:
        """Let one control step pass, for readings that remember."""
        if self._shear is not None:
            poses = Poses(*touch.poses)
            normal = self.sensors.forces(ids, poses, self._dt_s, touch.load)
            self._shear.advance(ids, normal, poses, self._dt_s, touch.pull)
        if self._in_order:
            self._last[ids] = self._read(ids, touch)

    def counts(self, ids: Array, touch: "Touch") -> torch.Tensor:
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

    def set_state(self, env: int, state: dict[str, Any]) -> None:
        """Continue from a state taken by `get_state`."""
        self.sensors.set_state(env, state["sensors"])
        self._last[env] = state["last"]
        if self._shear is not None:
            self._shear.set_state(env, state["shear"])

    def _read(self, ids: Array, touch: "Touch") -> torch.Tensor:
        return torch.as_tensor(self.sensors.counts(ids, Poses(*touch.poses), self._dt_s, touch.load))


def pad_layout(embodiment: Embodiment) -> PadLayout:
    """The taxels, found on the pad's own surface as in the paper's appendix."""
    length, width, thickness = embodiment.fingers.pad_size_m
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    vertices = signs * np.array([length, width, thickness]) / 2
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    wanted, outward = embodiment.pad_layout, np.array([0.0, 0.0, 1.0])
    return layout_from_mesh(
        vertices, np.array(faces), wanted.rows, wanted.cols, wanted.pitch_m, outward=outward
    )


def _touch_geometry(part: Part) -> BodyGeometry:
    return BodyGeometry([part.surface] if part.surface is not None else list(part.pieces))
