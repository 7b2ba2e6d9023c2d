"""How low the recorded hands came, by forward kinematics: does the twin's table stand where the real one did?

Heights alone cannot tell a table that stands higher from hands that hang lower (bent arms, a turned wrist);
raising the twin's table serves either way. Shapes: T frames, J joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.diagnose.episode_replay.touch import pressed
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig
from lerobot_vtrefine.tactile.geometry import Box, Cylinder, quaternion_matrix
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.pairs import Part

TOLERANCE_M = 0.010
"""Hands that pick something from a table come as close as this; the errors of bending arms are smaller."""
HOLDING_S = 3.0
"""Time after a grasp in which the twin's pads are asked whether they hold something."""


@dataclass(frozen=True)
class HandReach:
    """One hand in the episodes in which its gripper closes."""

    arm: str
    episodes: int
    lowest_m: float
    """Lowest pad edge over all of them, above the twin's table."""
    at_grasp_m: float
    """Lowest pad edge when the gripper has closed, above the twin's table; median."""
    over_part_m: float | None
    """How far the pads then reach down below the upper end of the twin's part; median, None without parts."""
    held: int | None
    """Episodes in which both of the twin's pads feel something then; None without parts."""


def lowest_edges(embodiment: Embodiment, joints: Array) -> Array:
    """Height in the world of each hand's lowest pad edge: (T, J) -> (T, A) [m]."""
    position, rotation = embodiment.pad_poses(torch.as_tensor(joints, dtype=torch.float64))
    length, width, _ = embodiment.fingers.pad.size_m
    along, across = rotation[..., 2, 0].abs(), rotation[..., 2, 1].abs()
    lowest = position[..., 2] - (length * along + width * across) / 2
    return lowest.unflatten(-1, (embodiment.num_arms, -1)).amin(-1).numpy()


def hand_reaches(
    embodiment: Embodiment,
    states: Sequence[Array],
    table_height_m: float,
    part_tops_m: Sequence[float] | None = None,
    touches: Sequence[Array] = (),
    fps: float = 1.0,
) -> list[HandReach]:
    """One row per arm whose gripper closes in some episode.

    Args:
        embodiment: The robot.
        states: Recorded positions (T, J) of every episode.
        table_height_m: Of the twin's table.
        part_tops_m: (A,) upper end of the part that each hand grips, above the twin's table.
        touches: Largest counts above idle of the twin's pads (T, P) of every episode, where it was replayed
            with parts.
        fps: Frames per second.
    """
    from lerobot_vtrefine.sim.command_replay import grasp_frame  # MuJoCo takes seconds to import

    rows = []
    for arm, name in enumerate(item.name for item in embodiment.arms):
        moments = [grasp_frame(embodiment, state, arm) for state in states]
        closing = [index for index, moment in enumerate(moments) if moment is not None]
        if not closing:
            continue
        heights = [lowest_edges(embodiment, states[index])[:, arm] - table_height_m for index in closing]
        at_grasp = float(np.median([h[moments[i]] for h, i in zip(heights, closing, strict=True)]))
        window = round(HOLDING_S * fps)
        own = slice(embodiment.pads_per_arm * arm, embodiment.pads_per_arm * (arm + 1))
        held = [_holds(touches[i][moments[i] :][:window], own) for i in closing] if touches else None
        rows.append(
            HandReach(
                arm=name,
                episodes=len(closing),
                lowest_m=float(min(height.min() for height in heights)),
                at_grasp_m=at_grasp,
                over_part_m=None if part_tops_m is None else part_tops_m[arm] - at_grasp,
                held=None if held is None else sum(held),
            )
        )
    return rows


def part_top_m(part: "Part") -> float:
    """Upper end of an upright part above its table."""
    tops = []
    for piece in part.pieces:
        if isinstance(piece, Box | Cylinder):
            up = np.abs(quaternion_matrix(piece.quat)[2])
            tops.append(piece.pos[2] + float(up @ piece.extent()))
        else:
            tops.append(float(np.asarray(piece.vertices)[:, 2].max()))
    return part.rest_height_m + max(tops)


def pad_peaks(counts: dict[str, Array], baselines: dict[str, Array]) -> Array:
    """Each pad's largest count above idle level and noise floor: (T, pads)."""
    peaks = [pressed(counts[pad], np.tile(baselines[pad], (len(counts[pad]), 1))).max(1) for pad in counts]
    return np.stack(peaks, 1)


def _holds(touch: Array, own: slice) -> bool:
    """Whether all of a hand's own pads feel something in most frames of (T, P), by the paper's threshold."""
    felt = np.median(touch[:, own], axis=0) >= VisuoTactileConfig().threshold_counts
    return bool(felt.all())


def describe_reach(rows: Sequence[HandReach], table_height_m: float) -> list[str]:
    """What is amiss, in sentences; empty where the hands reach what they should."""
    lines = []
    for row in rows:
        if row.held is not None and row.over_part_m is not None and row.held < row.episodes:
            episodes = plural(row.episodes, "episode")
            lines.append(
                f"the twin's {row.arm} hand holds its part in {row.held} of {episodes}: when its"
                f" gripper closes, its pads reach {1e3 * row.over_part_m:.0f} mm below the part's upper end"
            )
    lowest = min((row.lowest_m for row in rows), default=0.0)
    if abs(lowest) > TOLERANCE_M:
        came = (
            f"no finger ever came closer than {1e3 * lowest:.0f} mm to the twin's table"
            if lowest > 0
            else f"fingers came {-1e3 * lowest:.0f} mm below the twin's table"
        )
        each = ", ".join(f"{row.arm} {1e3 * row.lowest_m:.0f} mm" for row in rows)
        lines.append(
            f"{came} ({each}): where parts were"
            f" picked from the table, --env.scene.table_height_m={table_height_m + lowest:.3f} is the highest"
            " that no recorded finger passes through"
        )
    return lines
