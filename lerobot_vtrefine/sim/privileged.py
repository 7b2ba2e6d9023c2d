"""What only a simulation knows, for an asymmetric critic: one flat vector per world, SI units."""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.sim.config import RANGES, TaskConfig
from lerobot_vtrefine.sim.episode import EpisodeState
from lerobot_vtrefine.sim.kinematics import Kinematics
from lerobot_vtrefine.sim.rotations import turn_back
from lerobot_vtrefine.sim.scene import Scene

Array = np.ndarray


@dataclass(frozen=True)
class Privileged:
    """Named columns (m, n) in order."""

    columns: dict[str, Array]

    @property
    def names(self) -> tuple[str, ...]:
        """One name per entry of `vector`."""
        return tuple(
            name if block.shape[1] == 1 else f"{name}_{index}"
            for name, block in self.columns.items()
            for index in range(block.shape[1])
        )

    @property
    def vector(self) -> Array:
        """(m, P) float32."""
        return np.concatenate(list(self.columns.values()), 1).astype(np.float32)


def describe(
    scene: Scene,
    config: TaskConfig,
    episode: EpisodeState,
    ids: Array,
    seen: Kinematics,
    parameters: dict[str, Array],
    tells_force_limit: bool,
) -> Privileged:
    """State of worlds `ids`. Rotations are given by their first two columns.

    `time_left` and `hold` are fractions; `shift` and `force` fractions of the limits that end the episode.
    The one on force [N] is a column where it differs between episodes.
    """
    m = len(ids)
    insertion = seen.insertion
    velocity = seen.part_velocities[:, 0] - seen.part_velocities[:, 1]
    relative = turn_back(seen.socket[1], velocity[:, :3])
    spin = turn_back(seen.socket[1], velocity[:, 3:])
    columns = {
        "joint_position": seen.joints,
        "joint_velocity": seen.joint_velocities,
        "servo_command": episode.command[ids],
        "plug_in_socket": insertion.position_m,
        "plug_in_socket_rotation": _two_columns(insertion.rotation),
        "plug_in_socket_velocity": relative,
        "plug_in_socket_spin": spin,
    }
    hand_position, hand_rotation = seen.holding_hands
    for hand, (name, part) in enumerate((("socket", seen.socket), ("plug", seen.plug))):
        if scene.holders[hand] is None:
            continue
        rotation = hand_rotation[:, hand]
        columns[f"{name}_in_hand"] = turn_back(rotation, part[0] - hand_position[:, hand])
        columns[f"{name}_in_hand_rotation"] = _two_columns(np.swapaxes(rotation, -1, -2) @ part[1])
    limits, hold_steps = config.limits, config.success.hold_steps(config.control_dt_s)
    columns |= {
        "mouth_height": insertion.mouth_height_m[:, None],
        "contact_force": turn_back(seen.socket[1], episode.part_force[ids]),
        "pad_force": episode.pad_force[ids],
        "shift": episode.shift[ids] / limits.in_hand_shift_m,
        "force": episode.step_force[ids][:, None] / episode.force_limit[ids][:, None],
        "grasped": episode.grasped[ids].astype(float),
        "hold": episode.hold_steps[ids][:, None] / hold_steps,
        "time_left": 1.0 - episode.steps[ids][:, None] / config.steps_of(scene.config.start),
    }
    columns |= {name: parameters[name][ids][:, None] for name in RANGES}
    if tells_force_limit:
        columns["force_limit"] = episode.force_limit[ids][:, None]
    return Privileged({name: np.reshape(block, (m, -1)) for name, block in columns.items()})


def _two_columns(rotation: Array) -> Array:
    return np.concatenate([rotation[..., 0], rotation[..., 1]], -1)
