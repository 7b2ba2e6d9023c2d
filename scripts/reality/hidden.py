"""Stand-ins for reality: what is hidden in the simulation, and what everybody knows."""

from typing import Any

import numpy as np

from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.dividers import RowSharing
from lerobot_vtrefine.tactile.stages.host import Latency
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import (
    BaselineDrift,
    Gain,
    Idle,
    Noise,
    Quantisation,
    TaxelGainSpread,
)

PLAIN = SensorModel((KelvinVoigt(400.0, 1.2), Gain(500.0), Idle(25.0, 10.0), Noise(1.0), Quantisation()))
"""The simulator before diagnosis: the paper's model in the units of the hardware."""


def row_sharing_and_hysteresis() -> dict[str, Any]:
    """A readout whose rows' taxels load each other, under a cover with a wide loop."""
    pad = PLAIN.with_stage(RowSharing(3e-3)).with_stage(Hysteresis(fraction=0.5, width_m=4e-4))
    return {"sensor_model": pad.to_dict()}


def latency_and_gain_spread() -> dict[str, Any]:
    """Readings that arrive two control steps late, from taxels that differ by half."""
    gains = np.exp(np.random.default_rng(186).normal(0.0, 0.5, (12, 32)))
    pad = PLAIN.with_stage(Latency(0.2)).with_stage(TaxelGainSpread(0.5, gains.round(4).tolist()))
    return {"sensor_model": pad.to_dict()}


def pads_as_built() -> dict[str, Any]:
    """Row sharing of a plain pull-down resistor, a loop of 17 % as piezoresistive gloves have, and an idle
    level that has risen by 5 counts since the last zeroing.
    """
    loop = Hysteresis(fraction=0.17, width_m=2e-4)
    drift = BaselineDrift(
        knots_s=(0.0, 4.8), knot_counts=(0.0, 5.0)
    )  # within an episode, which starts at zero
    pad = PLAIN.with_stage(RowSharing(1 / 255)).with_stage(loop).with_stage(drift)
    return {"sensor_model": pad.to_dict()}


def control_latency_and_backlash() -> dict[str, Any]:
    """Worn arms: commands arrive a control step late, and every joint has a degree of play."""
    fingers = ("_left_finger", "_right_finger")
    joints = [name for name in ALOHA.joint_names if not name.endswith(fingers)]
    return {"robot": {"control_latency_s": 0.1, "backlash_rad": dict.fromkeys(joints, 0.02)}}


REALITIES = {
    "row_sharing+hysteresis": row_sharing_and_hysteresis,
    "latency+taxel_gain_spread": latency_and_gain_spread,
    "row_sharing+hysteresis+drift": pads_as_built,
    "control_latency+backlash": control_latency_and_backlash,
}
"""What is hidden: the pads' sensor model, or faults of the robot, as a reality file holds it."""


def of_robot(name: str) -> bool:
    """Whether a reality's robot differs, and not its pads."""
    return "robot" in REALITIES[name]()
