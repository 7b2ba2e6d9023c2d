"""One diagnosis of a dataset: its joints, and its camera where it has depth images."""

from dataclasses import replace

from lerobot_vtrefine.diagnose.robot.engine import RobotDiagnosis
from lerobot_vtrefine.diagnose.verdict import Status
from lerobot_vtrefine.diagnose.vision.engine import VisionDiagnosis

_WORSE: tuple[Status, ...] = ("adequate", "explained", "ambiguous", "unexplained")


def with_camera(robot: RobotDiagnosis, camera: VisionDiagnosis) -> RobotDiagnosis:
    """The robot's diagnosis with the camera's causes beside its own.

    Held-out errors stay those of the joints; the camera's gain stands with its cause. An alarm about joints
    says nothing about the camera, but a verdict that is unexplained holds symptoms only.
    """
    status = max(robot.status, camera.status, key=_WORSE.index)
    alarmed = robot.unknown.alarm
    causes = [replace(cause, role="symptom") if alarmed else cause for cause in camera.causes]
    evidence = [
        replace(item, decision="symptom") if alarmed and item.decision == "accepted" else item
        for item in camera.evidence
    ]
    return replace(
        robot,
        status=status,
        causes=(*robot.causes, *causes),
        ambiguous_with=() if alarmed else (*robot.ambiguous_with, *camera.ambiguous_with),
        minimum_detectable={**robot.minimum_detectable, **camera.minimum_detectable},
        next_experiment=robot.next_experiment or camera.next_experiment,
        evidence=(*robot.evidence, *evidence),
    )
