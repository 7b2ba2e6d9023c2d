"""A diagnosed robot as a reality file: what `--env.reality` makes of the simulated arms."""

import json
from pathlib import Path
from typing import Any

from lerobot_vtrefine.diagnose.robot.gravity import is_sliding
from lerobot_vtrefine.diagnose.robot.model import RobotModel
from lerobot_vtrefine.diagnose.verdict import write_atomically
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.reality import MAX_LATENCY_S, SCHEMA


def reality_of(model: RobotModel) -> dict[str, Any]:
    """The delay, the play and the encoders' offsets of a model's revolute joints.

    Sag and friction are left out: the twin has gravity and friction of its own. Raises ValueError for joints
    that the simulated arms do not have.
    """
    unknown = [name for name in model.names if name not in ALOHA.joint_names]
    if unknown:
        raise ValueError(f"the simulated arms have no joint {unknown[0]!r}")
    arms = [joint for joint in model.joints if not is_sliding(joint.name)]
    play = {joint.name: joint.backlash_command + joint.backlash_output for joint in arms}
    offsets = {joint.name: joint.encoder_offset for joint in arms}
    return {
        "schema": SCHEMA,
        "robot": {
            "control_latency_s": min(model.control_latency_s, MAX_LATENCY_S),
            "backlash_rad": {name: value for name, value in play.items() if value},
            "encoder_offset_rad": {name: value for name, value in offsets.items() if value},
        },
    }


def save_reality(model: RobotModel, path: str | Path) -> None:
    """Write the file that `--env.reality` reads."""
    write_atomically(path, json.dumps(reality_of(model), indent=2) + "\n")
