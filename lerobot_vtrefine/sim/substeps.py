"""What the task needs of the substeps within a control step, computed where the trace lies.

Shapes: m worlds, K substeps, S samples among them, w samples of the force window.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from lerobot_vtrefine.sim.backends import Trace
from lerobot_vtrefine.sim.config import TaskConfig
from lerobot_vtrefine.sim.host import start_copy
from lerobot_vtrefine.sim.scene import Addresses

Array = np.ndarray
Tensor = torch.Tensor

SAMPLE_S = 0.025
"""Sliding on the rim is sampled this often, or once per control step where these are shorter."""
RIM_DEPTH_M = 0.003
"""Contact at less depth than this is contact with the rim."""


@dataclass(frozen=True)
class Substeps:
    """Summary of the substeps of m worlds."""

    force_peak: Array
    """(m,) largest moving average of the contact force between the parts [N]."""
    force_tail: Array
    """(m, w - 1, 3) last contact forces."""
    force: Array
    """(m, 3) contact force of the last substep."""
    tip: Array
    """(m, 3) plug's origin in the socket's frame at the end [m]."""
    rim_slide: Array
    """(m,) way that the plug slid on the socket's rim [m]."""
    touch: Array
    """(m, 4) whether the parts touch at the last substep, 0 or 1, and where [m]: the centre of the contact's
    forces in the socket's frame, zeros where they do not touch."""


def count_substeps(timestep_s: float, config: TaskConfig) -> int:
    """Physics steps per control step.

    Raises: ValueError where that is not a whole number.
    """
    substeps = config.control_dt_s / timestep_s
    if abs(substeps - round(substeps)) > 1e-6:
        raise ValueError(
            f"control_hz = {config.control_hz} is not a whole number of physics steps of {timestep_s} s"
        )
    return round(substeps)


def start_summary(
    trace: Trace, at: Addresses, timestep_s: float, tip: Tensor, tail: Tensor, mouth_z_m: float
) -> Callable[[], Substeps]:
    """Begin to summarise a trace; what is returned waits for it.

    Args:
        trace: K substeps.
        at: where things lie in it.
        timestep_s: length of a substep.
        tip: (m, 3) plug's origin in the socket's frame before the first substep [m], where the trace lies.
        tail: (m, w - 1, 3) contact forces before the first substep [N].
        mouth_z_m: height of first entry in the socket's frame.
    """
    qpos, contact = (torch.as_tensor(part) for part in (trace.qpos, trace.sensors[:, :, at.part_contact]))
    stride = min(max(1, round(SAMPLE_S / timestep_s)), qpos.shape[1])
    samples, touching = qpos[:, stride - 1 :: stride], contact[:, stride - 1 :: stride, 0] > 0
    plug, socket = samples[..., at.plug_qpos], samples[..., at.socket_qpos]
    tips = turn_back(socket[..., 3:], plug[..., :3] - socket[..., :3])
    start = tip.to(tips)
    forces = contact[..., 1:4]
    peak, new_tail = windowed_peak(forces, tail.to(forces))
    slide = rim_slide(torch.cat([start[:, None], tips], 1), touching, mouth_z_m)
    parts = (
        peak,
        new_tail,
        forces[:, -1],
        tips[:, -1],
        slide,
        touch(contact[:, -1], qpos[:, -2:, at.socket_qpos]),
    )
    copied = start_copy(torch.cat([part.reshape(len(part), -1) for part in parts], 1))

    def wait() -> Substeps:
        edges = np.cumsum([part[0].numel() for part in parts])[:-1]
        pieces = np.split(copied().astype(float), edges, 1)
        return Substeps(*(piece.reshape(part.shape) for piece, part in zip(pieces, parts, strict=True)))

    return wait


def touch(contact: Tensor, sockets: Tensor) -> Tensor:
    """Where parts touch, (m, 4) as in `Substeps.touch`, out of the contact sensor's last reading (m, 10) and
    the socket's last poses (m, 1 or 2, 7).

    A reading is of the state before its substep, so the pose is the last but one, where there are two.
    """
    socket = sockets[:, 0]
    centre = turn_back(socket[:, 3:], contact[:, 7:10] - socket[:, :3])
    touching = (contact[:, :1] > 0) & (contact[:, 1:4] != 0).any(-1, keepdim=True)
    return torch.cat([touching.to(centre), torch.where(touching, centre, 0.0)], -1)


def turn_back(quat: Tensor, vector: Tensor) -> Tensor:
    """Apply inverse rotations, as unit quaternions (..., 4), to vectors (..., 3)."""
    axis = quat[..., 1:]
    once = torch.linalg.cross(axis, vector)
    return vector + 2 * (torch.linalg.cross(axis, once) - quat[..., :1] * once)


def windowed_peak(forces: Tensor, tail: Tensor) -> tuple[Tensor, Tensor]:
    """Largest moving average of a force over one control step.

    Args:
        forces: (m, K, 3) of this step [N].
        tail: (m, w - 1, 3), the last forces of the step before, for a window of w samples.

    Returns:
        Magnitudes (m,) [N] and the new tail.
    """
    window = tail.shape[1] + 1
    series = torch.cat([tail, forces], 1)
    means = series.unfold(1, window, 1).mean(-1)
    return torch.linalg.vector_norm(means, dim=-1).amax(1), series[:, series.shape[1] - window + 1 :]


def rim_slide(tips: Tensor, touching: Tensor, mouth_z_m: float) -> Tensor:
    """Way that the plug slid on the socket's rim.

    Args:
        tips: (m, S + 1, 3) plug origins in the socket's frame at successive samples [m].
        touching: (m, S) whether the parts touched in between.
        mouth_z_m: height of first entry in the same frame.

    Returns:
        (m,) lateral way [m], counted only while the plug has not entered.
    """
    way = torch.linalg.vector_norm(tips[:, 1:, :2] - tips[:, :-1, :2], dim=-1)
    outside = mouth_z_m - tips[:, 1:, 2] < RIM_DEPTH_M
    return (way * (touching & outside)).sum(1)
