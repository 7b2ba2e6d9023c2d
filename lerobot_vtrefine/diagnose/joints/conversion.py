"""Between the parameters of fits and the model file that is written."""

from typing import TYPE_CHECKING, cast

import numpy as np

from lerobot_vtrefine.diagnose.joints.fitting import PARAMETERS, SAG, Point
from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel

if TYPE_CHECKING:
    from lerobot_vtrefine.embodiments.robot_file import SagForm


def to_model(names: tuple[str, ...], point: Point) -> RobotModel:
    """As the file that is written."""
    joints = []
    for index, name in enumerate(names):
        value = dict(zip(PARAMETERS, point.theta[index].tolist(), strict=True))
        joints.append(
            JointModel(
                name=name,
                natural_frequency_rad_s=float(np.exp(value["log_omega"])),
                damping_ratio=float(np.exp(value["log_zeta"])),
                encoder_offset=value["offset"],
                backlash_command=value["play"],
                backlash_output=value["loose"],
                friction=value["friction"],
                sag_form=cast("SagForm", point.forms[index]),
                sag_terms=tuple(value[name] for name in SAG),
                compliance=value["bend"],
                stop=value["stop"],
                give=value["give"],
                backlash_rounding=value["round"],
                breakaway=value["stick"],
            )
        )
    return RobotModel(tuple(joints), point.tau_s)


def from_model(model: RobotModel) -> Point:
    """Inverse of `to_model`."""
    rows = [
        (
            np.log(joint.natural_frequency_rad_s),
            np.log(joint.damping_ratio),
            joint.encoder_offset,
            joint.backlash_command,
            joint.backlash_output,
            joint.friction,
            *joint.sag_terms,
            joint.compliance,
            joint.stop,
            joint.give,
            joint.backlash_rounding,
            joint.breakaway,
        )
        for joint in model.joints
    ]
    return Point(np.array(rows), tuple(joint.sag_form for joint in model.joints), model.control_latency_s)
