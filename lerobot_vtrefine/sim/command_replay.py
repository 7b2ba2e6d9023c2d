"""Recorded joint commands through the simulated twin: its arms alone, or the whole scene with its parts.

Shapes: E episodes of T frames, J joints, P pads. Frame t of an episode is what the sensors give when command
t is issued; the command acts until frame t + 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends import get_backend
from lerobot_vtrefine.sim.backends.base import ramp
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.parts import Part, PartPair
from lerobot_vtrefine.sim.rotations import about_axis, matrix_to_quat
from lerobot_vtrefine.sim.scene import build_arms, map_joints
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.sim.starts import HAND_RETREAT_M, Start

Array = np.ndarray

HOLDS = ("zero_order", "linear")
"""How a command is approached: at once (as motors get it), or linearly over the frame (as `InsertionSim`)."""
CLOSING_M = 0.005
"""A gripper whose fingers move less than this in an episode never closes."""
CLOSED_M = 0.001
"""Fingers this close to where they stay have closed."""
_SETTLE_S = 0.1


@dataclass(frozen=True)
class SceneReplay:
    """What the twin's sensors gave during one episode."""

    position: Array
    """(T, J) [rad, m]"""
    counts: Array
    """(T, P, R*C) uint8 raw counts."""
    baseline: Array
    """(P, R*C) uint8 idle counts."""
    success: bool
    """Whether the plug was seated and held."""


def replay_commands(
    commands: Sequence[Array],
    starts: Array,
    dt_s: float,
    config: SceneConfig | None = None,
    *,
    hold: str = "zero_order",
    num_threads: int = 0,
) -> list[Array]:
    """Joint positions of the twin's arms under recorded commands, without parts and contacts.

    Nothing touches: what the servos do alone is seen, and grippers close on nothing.

    Args:
        commands: E arrays (T, J) of joint targets [rad, m]; clamped to the limits, one opening per gripper.
        starts: (E, J) joint positions at the first frames; the arms start at rest.
        dt_s: time between frames.
        config: servo gains, gravity compensation and time step; the latter is shortened to divide `dt_s`.
        hold: see `HOLDS`.
        num_threads: 0 uses all cores.

    Returns:
        E arrays (T, J); the first frame is the start.

    Raises:
        ValueError: shapes that disagree, or an unknown `hold`.
    """
    check_choice("hold", hold, HOLDS)
    if not dt_s > 0.0:
        raise ValueError(f"the time between frames must be above 0, got {dt_s}")
    config = config or SceneConfig()
    substeps = int(np.ceil(dt_s / config.timestep_s - 1e-6))
    model, embodiment, _ = build_arms(replace(config, timestep_s=dt_s / substeps))
    joints = map_joints(model, embodiment)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    lengths = _checked_lengths(commands, starts, embodiment)
    backend = get_backend("batch", model, len(lengths), num_threads)
    ids = np.arange(len(lengths))
    qpos = np.zeros((len(ids), model.nq))
    joints.write(qpos, np.clip(starts, embodiment.lower, embodiment.upper))
    backend.write(ids, qpos, np.zeros((len(ids), model.nv)))
    padded = np.stack([_padded(item, max(lengths)) for item in commands])
    servo = np.stack([task.servo_commands(embodiment, frame) for frame in padded.swapaxes(0, 1)])
    positions, before = [qpos[:, joints.qpos]], servo[0]
    for command in servo[:-1]:
        controls = ramp(before, command, substeps) if hold == "linear" else _held(command, substeps)
        positions.append(np.asarray(backend.advance(ids, controls).qpos)[:, -1, joints.qpos])
        before = command
    stacked = np.stack(positions, 1)
    return [stacked[episode, :length] for episode, length in enumerate(lengths)]


def replay_scene(
    sim: InsertionSim,
    commands: Array,
    seed: int,
    start: Start | None = None,
    watch: Callable[[], None] = lambda: None,
) -> SceneReplay:
    """One episode in world 0 of a simulation, with parts and pads.

    The simulation's own clamps, rates and ramps act on the commands, as in its recordings: an episode that it
    recorded comes out the same, counts included.

    Args:
        commands: (T, J) [rad, m].
        seed: of the episode; decides the start (unless given), the pads' idle levels and noise.
        start: one world's state to start from.
        watch: called at every frame, and at the end.
    """
    world = np.zeros(1, np.int64)
    sim.reset(world, np.array([seed]), start)
    first = sim.observe(world)
    positions, counts = [first["state"]], [first["tactile"]]
    watch()
    for command in commands[:-1]:
        sim.step(command[None], world)
        watch()
        positions.append(sim.joint_state(world))
        counts.append(sim.tactile(world))
    sim.step(commands[-1:], world)
    watch()
    return SceneReplay(
        position=np.concatenate(positions),
        counts=np.concatenate(counts),
        baseline=first["tactile_baseline"][0],
        success=bool(sim.metrics(world)["success"][0]),
    )


def grasp_start(
    embodiment: Embodiment, pair: PartPair, position: Array, table_height_m: float
) -> Start | None:
    """A start from the table with the parts where the recorded grippers closed on them.

    Parts stand upright, turned as their hand is at the moment of the grasp; how high and how far forward in
    the hand a part was held is taken as ideal, because joints do not tell.

    Args:
        position: (T, J) of one episode [rad, m].
        table_height_m: of the table on which the parts stand.

    Returns:
        None when a gripper never closes, or a part has no hand of its own.
    """
    poses = []
    if None in embodiment.holders:
        return None
    for arm, (part, yaw) in enumerate(((pair.socket, np.pi / 2), (pair.plug, -np.pi / 2))):
        moment = grasp_frame(embodiment, position, arm)
        if moment is None:
            return None
        pose = _standing_pose(embodiment, part, yaw, position[moment], arm)
        poses.append(pose + np.eye(7)[2] * table_height_m)
    first = np.clip(position[:1], embodiment.lower, embodiment.upper).astype(float)
    return Start(first, first, plug=poses[1][None], socket=poses[0][None], settle_s=_SETTLE_S)


def grasp_frame(embodiment: Embodiment, position: Array, arm: int) -> int | None:
    """First frame at which a gripper has closed as far as it then stays the longest; None if it never does.

    Args:
        position: (T, J) of one episode.
    """
    opening = embodiment.openings(position)[:, arm]
    low, high = float(opening.min()), float(opening.max())
    if high - low < CLOSING_M:
        return None
    closed = opening < (low + high) / 2
    edges = np.flatnonzero(np.diff(closed, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - begins))
    run = opening[begins[longest] : ends[longest]]
    return int(begins[longest]) + int(np.argmax(run < np.median(run) + CLOSED_M))


def _standing_pose(embodiment: Embodiment, part: Part, nominal_yaw: float, joints: Array, arm: int) -> Array:
    """Pose (7,) of an upright part on a table at height 0, held ideally by a hand at these joints (J,)."""
    tcp, rotation = (
        item.numpy() for item in embodiment.tcp_poses(torch.as_tensor(joints, dtype=torch.float64))
    )
    forward = rotation[arm][:, 0]
    hand_yaw = float(np.arctan2(forward[1], forward[0]))
    turned = about_axis(2, hand_yaw - nominal_yaw)
    ahead = np.array([np.cos(hand_yaw), np.sin(hand_yaw), 0.0])
    origin = tcp[arm] + HAND_RETREAT_M * ahead - turned @ np.asarray(part.grip.centre_m)
    return np.concatenate([origin[:2], [part.rest_height_m], matrix_to_quat(turned)])


def _checked_lengths(commands: Sequence[Array], starts: Array, embodiment: Embodiment) -> list[int]:
    if not len(commands) or np.shape(starts) != (len(commands), embodiment.num_joints):
        raise ValueError(
            f"{len(commands)} episodes need starts of shape ({len(commands)}, {embodiment.num_joints}),"
            f" got {np.shape(starts)}"
        )
    for episode, item in enumerate(commands):
        if item.ndim != 2 or item.shape[1] != embodiment.num_joints or not len(item):
            raise ValueError(
                f"episode {episode}: commands must be (T, {embodiment.num_joints}), got {item.shape}"
            )
        if not np.isfinite(item).all():
            raise ValueError(f"episode {episode}: commands must be finite")
    return [len(item) for item in commands]


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), 0)])


def _held(command: Array, substeps: int) -> Array:
    return np.repeat(command[:, None], substeps, 1)
