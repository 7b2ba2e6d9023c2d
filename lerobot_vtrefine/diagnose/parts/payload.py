"""The twin's arms under recorded commands, with weights that hang in their hands for part of an episode.

Shapes: E episodes of T frames, J joints, 2 hands.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from lerobot_vtrefine.diagnose.parts.episodes import HandledEpisode, without_hands
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends.base import ramp
from lerobot_vtrefine.sim.backends.batch import usable_cores
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.scene import build_arms
from lerobot_vtrefine.sim.starts import HAND_RETREAT_M

Array = np.ndarray

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Arms:
    """The twin's arms and how commands reach their servos."""

    config: SceneConfig
    rules: TaskConfig | None
    """Clamps of the commanded rates; None: commands are taken as they are."""
    dt_s: float
    hold: str
    """linear (as `InsertionSim`) or zero_order (as motors)."""


def replay_loaded(
    arms: Arms,
    episodes: Sequence[HandledEpisode],
    weight_n: Sequence[Array] | None = None,
    *,
    contacts: bool = True,
) -> list[Array]:
    """Joint positions (T, J) of the twin's arms in every episode, from its first position at rest.

    Args:
        weight_n: per episode (T, 2), the weight in each hand while frame t + 1 comes about, at the place
            where hands hold parts ideally; none by default.
        contacts: whether hands stop at the table and at each other.
    """
    substeps = int(np.ceil(arms.dt_s / arms.config.timestep_s - 1e-6))
    model, robot, joints = build_arms(arms.config)
    model.opt.timestep = arms.dt_s / substeps
    if not contacts:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    lengths = [len(episode.command) for episode in episodes]
    commands = np.stack([_padded(given(arms, item), max(lengths)) for item in episodes], 1)
    weights = np.zeros((max(lengths), len(episodes), 2))
    for place, values in enumerate(weight_n or []):
        weights[: len(values), place] = values
    worlds = Batch(model, nsim=len(episodes), nthread=usable_cores())
    qpos, qvel, push = (worlds.bind(name) for name in ("qpos", "qvel", "xfrc_applied"))
    worlds.reset(None, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
    start = np.stack([episode.position[0] for episode in episodes])
    qpos[:] = 0.0
    qpos[:, joints] = np.clip(start, robot.lower, robot.upper)
    qvel[:] = 0.0
    hand_bodies = [model.body(f"{arm.name}_wrist_rotate").id for arm in robot.arms]
    before, path = task.servo_commands(robot, start), [qpos[:, joints].copy()]
    for command, weight in zip(commands[:-1], weights[:-1], strict=True):
        after = task.servo_commands(robot, command)
        if weight.any() or push[:, hand_bodies].any():
            push[:, hand_bodies] = _wrenches(path[-1], weight)
        if arms.hold == "linear":
            controls = ramp(before, after, substeps)
        else:
            controls = np.repeat(after[:, None], substeps, 1)
        out = worlds.rollout(substeps, control=controls, record=("qpos",), ids=None)
        path.append(out["qpos"][:, -1][:, joints])
        before = after
    stacked = np.stack(path, 1)
    return [stacked[place, :length] for place, length in enumerate(lengths)]


def given(arms: Arms, episode: HandledEpisode) -> Array:
    """(T, J) commands as the servos get them: within limits and rates, fingers where they hold something."""
    wanted = task.servo_commands(ALOHA, without_hands(episode))
    if arms.rules is None:
        return task.joint_targets(ALOHA, wanted)
    rates = task.rate_limits(ALOHA, arms.rules)
    now, out = task.servo_commands(ALOHA, episode.position[:1])[0], []
    for row in wanted:
        now = np.clip(row, now - rates, now + rates)
        out.append(now)
    return task.joint_targets(ALOHA, np.array(out))


def _wrenches(joints: Array, weight: Array) -> Array:
    """(E, 2, 6) force and torque on the hands' centres of mass of weights (E, 2) where parts are held."""
    _, rotation = ALOHA.tcp_poses(torch.as_tensor(joints))
    turn = rotation.numpy()
    com = np.asarray(next(item for item in ALOHA.joints if item.name == "wrist_rotate").com_m)
    lever = turn @ (np.array([ALOHA.tcp_offset_m, 0.0, 0.0]) - com)
    ahead = turn[..., 0] * [1.0, 1.0, 0.0]
    lever = lever + HAND_RETREAT_M * ahead / np.linalg.norm(ahead, axis=-1, keepdims=True).clip(1e-9)
    force = np.zeros((*weight.shape, 3))
    force[..., 2] = -weight
    return np.concatenate([force, np.cross(lever, force)], -1)


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), 0)])
