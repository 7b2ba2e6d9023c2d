"""The task as pure functions on arrays: servo commands, insertion geometry, success, in-hand shift, forces.

Shapes: m worlds. Poses are (position (m, 3) [m], rotation (m, 3, 3)) in the world frame. Parts, and hands by
the part that they hold, are ordered socket, plug.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim.config import SceneConfig, SuccessConfig, TaskConfig
from lerobot_vtrefine.sim.parts import Grip, PartPair
from lerobot_vtrefine.sim.rotations import turn, turn_back

__all__ = ["FAILURES", "TaskConfig"]

Array = np.ndarray
Pose = tuple[Array, Array]
Holders = tuple[int | None, int | None]
"""Arms that hold the socket and the plug."""

FAILURES = ("none", "in_hand_shift", "contact_force", "dropped", "unstable", "overflow")
NO_FAILURE, SHIFTED, FORCED, DROPPED, UNSTABLE, OVERFLOWED = range(6)
SIMULATION_FAILED = (UNSTABLE, OVERFLOWED)
"""The simulation's own failures: a state that blew up, and contacts that found no room."""

HELD_FORCE_N = 1.0
"""A part is held while both pads of its hand press at least this hard."""


@dataclass(frozen=True)
class Insertion:
    """Where the plug is with respect to its socket; (m,) or (m, 3) arrays."""

    position_m: Array
    """(m, 3) of the plug's origin in the socket's frame."""
    rotation: Array
    """(m, 3, 3)"""
    depth_m: Array
    """(m,) how far the plug has entered, negative above the mouth."""
    remaining_m: Array
    """(m,) way left to fully seated."""
    lateral_m: Array
    tilt_rad: Array
    mouth_height_m: Array
    """Above the table."""


def rules_in(scene: SceneConfig, config: TaskConfig) -> TaskConfig:
    """The rules as they hold in a scene: a socket that stands need not be lifted above the table."""
    if scene.socket == "held":
        return config
    return replace(config, success=replace(config.success, mouth_height_m=-np.inf))


def checked_action(action: Array, shape: tuple[int, int]) -> Array:
    """Joint targets as float64 (m, J). Raises: ValueError for another shape, infinities and NaN."""
    action = np.asarray(action, float)
    if action.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {action.shape}")
    wrong = np.argwhere(~np.isfinite(action))
    if len(wrong):
        row, joint = wrong[0].tolist()
        raise ValueError(f"action must be finite: joint {joint} is to go to {action[row, joint]}")
    return action


def servo_commands(embodiment: Embodiment, targets: Array) -> Array:
    """Joint targets (m, J) -> servo commands (m, nu): clamped to the limits, one command per gripper."""
    return servo_values(embodiment, np.clip(targets, embodiment.lower, embodiment.upper))


def servo_values(embodiment: Embodiment, joints: Array) -> Array:
    """Values per joint (m, J) -> values per servo (m, nu), the grippers' merged into one each."""
    arms, count = embodiment.by_arm(joints), len(embodiment.joints)
    gripper = embodiment.fingers.command(arms[..., count:])
    return np.concatenate([arms[..., :count], gripper], -1).reshape(len(joints), -1)


def joint_targets(embodiment: Embodiment, commands: Array) -> Array:
    """Servo commands (m, nu) -> joint targets (m, J), the inverse of `servo_commands`."""
    arms = commands.reshape(len(commands), embodiment.num_arms, -1)
    gripper = embodiment.fingers.targets(arms[..., -1:])
    return np.concatenate([arms[..., :-1], gripper], -1).reshape(len(commands), embodiment.num_joints)


def rate_limits(embodiment: Embodiment, config: TaskConfig) -> Array:
    """Largest change of each servo command in one control step (nu,)."""
    gripper = embodiment.fingers.command_rate(config.finger_rate)
    arm = [config.joint_rate] * len(embodiment.joints) + [gripper]
    return np.array(arm * embodiment.num_arms) * config.control_dt_s


def held_parts(holders: Holders, num_arms: int, pad_force: Array) -> Array:
    """(m, part) whether all pads of the hand whose part it is press on something, for forces (m, P) [N]."""
    pressed = np.all((pad_force > HELD_FORCE_N).reshape(len(pad_force), num_arms, -1), axis=-1)
    nobody = np.zeros(len(pad_force), bool)
    return np.stack([nobody if arm is None else pressed[:, arm] for arm in holders], 1)


def holding_hands(holders: Holders, hands: Pose) -> Pose:
    """Poses (m, part, ...) of the hands that hold the socket and the plug, out of those of all hands (m, A,
    ...); the world's frame for a part that no hand holds.
    """
    none = np.zeros_like(hands[0][:, 0]), np.broadcast_to(np.eye(3), hands[1][:, 0].shape)
    chosen = [none if arm is None else (hands[0][:, arm], hands[1][:, arm]) for arm in holders]
    position, rotation = zip(*chosen, strict=True)
    return np.stack(position, 1), np.stack(rotation, 1)


def insertion(pair: PartPair, plug: Pose, socket: Pose, table_height_m: float) -> Insertion:
    """Pose of the plug in the socket's frame and what follows from it."""
    position = turn_back(socket[1], plug[0] - socket[0])
    rotation = np.swapaxes(socket[1], -1, -2) @ plug[1]
    mouth_height = socket[0][:, 2] + pair.mouth_z_m * socket[1][:, 2, 2] - table_height_m
    return Insertion(
        position_m=position,
        rotation=rotation,
        depth_m=pair.mouth_z_m - position[:, 2],
        remaining_m=position[:, 2] - pair.seated_z_m,
        lateral_m=np.hypot(position[:, 0], position[:, 1]),
        tilt_rad=np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0)),
        mouth_height_m=mouth_height,
    )


def is_seated(state: Insertion, config: SuccessConfig) -> Array:
    """(m,) whether the plug is in, straight, and high enough above the table."""
    return (
        (state.remaining_m <= config.depth_slack_m)
        & (state.lateral_m < config.lateral_m)
        & (state.tilt_rad < config.tilt_rad)
        & (state.mouth_height_m > config.mouth_height_m)
    )


def grip_points(grips: tuple[Grip, Grip], parts: tuple[Pose, Pose], hands: Pose) -> Array:
    """Both ends of each gripped block in its hand's frame: (m, hand, end, 3) [m].

    Two points per part, so that a part that turns in the hand counts as shifted too.
    """
    hand_position, hand_rotation = hands
    points = []
    for index, (grip, (position, rotation)) in enumerate(zip(grips, parts, strict=True)):
        ends = np.asarray(grip.centre_m) + np.outer([-1.0, 1.0], [0.0, 0.0, grip.half_size_m[2]])
        world = position[:, None] + turn(rotation[:, None], ends)
        points.append(turn_back(hand_rotation[:, index, None], world - hand_position[:, index, None]))
    return np.stack(points, 1)


def in_hand_shift(points: Array, reference: Array) -> Array:
    """Largest displacement of a part's grip points since the grasp: (m, hand) [m]."""
    return np.linalg.norm(points - reference, axis=-1).max(-1)
