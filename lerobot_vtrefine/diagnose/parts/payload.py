"""The twin's arms under recorded commands, with weights that hang in their hands for part of an episode.

Shapes: E episodes of T frames, J joints, A hands.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch

from lerobot_vtrefine.cores import usable_cores
from lerobot_vtrefine.diagnose.joints.batch import padded
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode, without_hands
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends.base import ramp
from lerobot_vtrefine.sim.scene import build_arms
from lerobot_vtrefine.sim.starts import HAND_RETREAT_M

Array = np.ndarray


def replay_loaded(
    scene: AssumedScene,
    episodes: Sequence[HandledEpisode],
    weight_n: Sequence[Array],
    *,
    contacts: bool = True,
) -> list[Array]:
    """Joint positions (T, J) of the twin's arms in every episode, from its first position at rest.

    Args:
        weight_n: per episode (T, A), the weight in each hand while frame t + 1 comes about, at the place
            where hands hold parts ideally.
        contacts: whether hands stop at the table and at each other.
    """
    dt_s = scene.rules.control_dt_s
    substeps = int(np.ceil(dt_s / scene.scene.timestep_s - 1e-6))
    model, robot, joints = build_arms(scene.scene)
    model.opt.timestep = dt_s / substeps
    if not contacts:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    lengths = [len(episode.command) for episode in episodes]
    commands = np.stack([padded(given(scene, item), max(lengths)) for item in episodes], 1)
    weights = np.zeros((max(lengths), len(episodes), robot.num_arms))
    for place, values in enumerate(weight_n):
        weights[: len(values), place] = values
    worlds = Batch(model, nsim=len(episodes), nthread=usable_cores())
    qpos, qvel, push = (worlds.bind(name) for name in ("qpos", "qvel", "xfrc_applied"))
    worlds.reset(None, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
    start = np.stack([episode.position[0] for episode in episodes])
    qpos[:] = 0.0
    qpos[:, joints] = np.clip(start, robot.lower, robot.upper)
    qvel[:] = 0.0
    last = robot.joints[-1].name
    hand_bodies = [model.body(f"{arm.name}_{last}").id for arm in robot.arms]
    before, path = task.servo_commands(robot, start), [qpos[:, joints].copy()]
    for command, weight in zip(commands[:-1], weights[:-1], strict=True):
        after = task.servo_commands(robot, command)
        if weight.any() or push[:, hand_bodies].any():
            push[:, hand_bodies] = _wrenches(robot, path[-1], weight)
        out = worlds.rollout(substeps, control=ramp(before, after, substeps), record=("qpos",), ids=None)
        path.append(out["qpos"][:, -1][:, joints])
        before = after
    stacked = np.stack(path, 1)
    return [stacked[place, :length] for place, length in enumerate(lengths)]


def given(scene: AssumedScene, episode: HandledEpisode) -> Array:
    """(T, J) commands as the servos get them: within limits and rates, fingers where they hold something."""
    body = scene.body
    wanted = task.servo_commands(body, without_hands(body, episode))
    rates = task.rate_limits(body, scene.rules)
    now, out = task.servo_commands(body, episode.position[:1])[0], []
    for row in wanted:
        now = np.clip(row, now - rates, now + rates)
        out.append(now)
    return task.joint_targets(body, np.array(out))


def _wrenches(body: Embodiment, joints: Array, weight: Array) -> Array:
    """(E, A, 6) force and torque on the last links' centres of mass: weights (E, A) where parts are held."""
    chain = body.hands(torch.as_tensor(joints))
    position, rotation = (item.numpy() for item in chain.tcp())
    lever = position - chain.position.numpy() - rotation @ np.asarray(body.joints[-1].com_m)
    ahead = rotation[..., 0] * [1.0, 1.0, 0.0]
    lever = lever + HAND_RETREAT_M * ahead / np.linalg.norm(ahead, axis=-1, keepdims=True).clip(1e-9)
    force = np.zeros((*weight.shape, 3))
    force[..., 2] = -weight
    return np.concatenate([force, np.cross(lever, force)], -1)
