"""How episodes start: poses of parts and hands as a pure function of uniform random numbers.

Shapes: m worlds. Draws are uniform in [-1, 1].
"""

from dataclasses import dataclass

import numpy as np
import torch

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim.config import GraspedStart, TableStart
from lerobot_vtrefine.sim.parts import Part, PartPair
from lerobot_vtrefine.sim.rotations import about_axis, matrix_to_quat, turn

Array = np.ndarray

TABLE_DRAWS = 6
GRASPED_DRAWS = 14
HAND_RETREAT_M = 0.010
"""How far the hands' pads stay behind the parts' axes, so that opposing fingers do not meet."""


@dataclass(frozen=True)
class Start:
    """States to start from."""

    joints: Array
    """(m, J) joint positions."""
    targets: Array
    """(m, J) joint targets that the servos hold meanwhile."""
    plug: Array
    """(m, 7) position and quaternion (w, x, y, z)."""
    socket: Array
    settle_s: float


def uniform_draws(seeds: Array, stream: int, count: int) -> Array:
    """(m, count) uniform numbers in [-1, 1], each row a pure function of its seed and the stream."""
    rows = [np.random.default_rng([int(seed), stream]).uniform(-1.0, 1.0, count) for seed in seeds]
    return np.reshape(rows, (len(seeds), count))


def start_on_table(
    config: TableStart, pair: PartPair, embodiment: Embodiment, table_height_m: float, draws: Array
) -> Start:
    """Both parts stand upright in their squares, both arms at home. `draws`: (m, TABLE_DRAWS)."""
    poses = []
    for part, centre, own in (
        (pair.plug, config.plug_centre_m, draws[:, :3]),
        (pair.socket, config.socket_centre_m, draws[:, 3:6]),
    ):
        xy = np.asarray(centre) + config.square_m / 2 * own[:, :2]
        height = np.full((len(draws), 1), table_height_m + part.rest_height_m)
        quat = matrix_to_quat(about_axis(2, config.yaw_rad * own[:, 2]))
        poses.append(np.concatenate([xy, height, quat], 1))
    home = np.tile(embodiment.home, (len(draws), 1))
    return Start(home, home, poses[0], poses[1], settle_s=0.1)


def start_in_hand(config: GraspedStart, pair: PartPair, embodiment: Embodiment, draws: Array) -> Start:
    """Both parts in hand, the plug above the mouth. `draws`: (m, GRASPED_DRAWS), seven for each hand.

    Raises:
        ValueError: the body has one hand only, or its hands do not reach there.

    Each hand stands displaced and turned about the vertical from where it would hold its part ideally; the
    part stands displaced along both axes of the pads and turned about their normal from where its hand
    expects it (slip).
    """
    if None in embodiment.holders:
        raise ValueError(f"start=grasped needs two hands, and {embodiment.name} has one: use start=table")
    plug_at, socket_at = _ideal_places(config, pair)
    left = _hand_and_part(config, pair.socket, socket_at, np.pi / 2, config.left_pitch_rad, draws[:, :7])
    right = _hand_and_part(config, pair.plug, plug_at, -np.pi / 2, config.right_pitch_rad, draws[:, 7:])
    position = np.stack([left[0], right[0]], 1)
    rotation = np.stack([left[1], right[1]], 1)
    touching = grip_openings(pair, embodiment)
    nominal = _nominal_joints(config, pair, embodiment, touching)
    joints = solve_hands(embodiment, position, rotation, nominal)
    targets = joints.copy()
    embodiment.set_openings(joints, touching)
    embodiment.set_openings(targets, np.maximum(touching - config.squeeze_m, 0.0))
    return Start(joints, targets, plug=right[2], socket=left[2], settle_s=config.settle_s)


def grip_openings(pair: PartPair, embodiment: Embodiment) -> Array:
    """Grippers' openings (2,) [m] at which the pads of both hands just touch their parts."""
    width = np.array([pair.socket.grip.half_size_m[0], pair.plug.grip.half_size_m[0]])
    return width + embodiment.fingers.face_offset_m


def solve_hands(embodiment: Embodiment, position: Array, rotation: Array, initial: Array) -> Array:
    """Joint positions (m, J) that bring both TCPs to (m, 2, 3) and (m, 2, 3, 3), starting from `initial` (J,)
    nearby.
    """
    start = torch.as_tensor(np.tile(initial, (len(position), 1)))
    return embodiment.solve_tcp(
        torch.as_tensor(position), torch.as_tensor(rotation), start, iterations=8
    ).numpy()


def ideal_hand(part: Part, yaw_rad: float, pitch_rad: float) -> tuple[Array, Array]:
    """TCP pose (3,), (3, 3) in the part's frame from which a hand holds it, approaching from its own side."""
    rotation = about_axis(2, yaw_rad) @ about_axis(1, pitch_rad)
    return np.asarray(part.grip.centre_m) - HAND_RETREAT_M * about_axis(2, yaw_rad)[:, 0], rotation


def _hand_and_part(
    config: GraspedStart, part: Part, part_at: Array, yaw_rad: float, pitch_rad: float, draws: Array
) -> tuple[Array, Array, Array]:
    """TCP positions (m, 3) and rotations (m, 3, 3), and part poses (m, 7), for seven draws per world."""
    hand_position, hand_rotation = ideal_hand(part, yaw_rad, pitch_rad)
    turned = about_axis(2, config.hand_yaw_rad * draws[:, 3])
    scale = np.array([config.hand_xy_m, config.hand_xy_m, config.hand_z_m])
    expected = part_at + scale * draws[:, :3]  # where the hand believes its part's origin
    position = expected + turn(turned, hand_position)
    rotation = turned @ hand_rotation
    # Slip, in the hand's frame: along its x and z, about its y, around the middle of the grip.
    slip = np.zeros((len(draws), 3))
    slip[:, [0, 2]] = np.asarray(config.slip_xz_m) * draws[:, 4:6]
    spin = rotation @ about_axis(1, config.slip_rad * draws[:, 6]) @ np.swapaxes(rotation, -1, -2)
    middle = expected + turn(turned, np.asarray(part.grip.centre_m)) + turn(rotation, slip)
    part_rotation = spin @ turned
    origin = middle - turn(part_rotation, np.asarray(part.grip.centre_m))
    return position, rotation, np.concatenate([origin, matrix_to_quat(part_rotation)], 1)


def _ideal_places(config: GraspedStart, pair: PartPair) -> tuple[Array, Array]:
    """Origins (3,) of plug and socket when the plug stands upright above the mouth."""
    mouth, up = np.asarray(config.mouth_m), np.array([0.0, 0.0, 1.0])
    socket_at = mouth - pair.mouth_z_m * up
    return mouth + config.plug_height_m * up, socket_at


def _nominal_joints(config: GraspedStart, pair: PartPair, embodiment: Embodiment, openings: Array) -> Array:
    """Joint positions of the ideal start, found from home: what the jittered ones are solved from."""
    plug_at, socket_at = _ideal_places(config, pair)
    left = ideal_hand(pair.socket, np.pi / 2, config.left_pitch_rad)
    right = ideal_hand(pair.plug, -np.pi / 2, config.right_pitch_rad)
    position = torch.as_tensor(np.stack([socket_at + left[0], plug_at + right[0]]))
    rotation = torch.as_tensor(np.stack([left[1], right[1]]))
    home = embodiment.home.copy()
    embodiment.set_openings(home, openings)  # on which the TCPs of swinging fingers depend
    joints = embodiment.solve_tcp(position, rotation, torch.as_tensor(home), iterations=40)
    reached, _ = embodiment.tcp_poses(joints)
    if float((reached - position).abs().max()) > 1e-3:
        raise ValueError(f"grasped.mouth_m = {config.mouth_m}: the hands cannot reach their parts there")
    return joints.numpy()
