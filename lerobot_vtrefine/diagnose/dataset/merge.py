"""One verdict from several: what was found about parts or a camera, beside what was found about the robot."""

from dataclasses import replace

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.verdict import Status

_WORSE: tuple[Status, ...] = ("adequate", "explained", "ambiguous", "unexplained")


def merged(robot: Diagnosis, other: Diagnosis) -> Diagnosis:
    """The robot's diagnosis with other causes beside its own.

    Held-out errors are those of the joints where something was found about these, else those of what was
    found; every cause's own gain stands with it. An alarm about joints says nothing about a camera, but a
    verdict that is unexplained holds symptoms only.
    """
    if other.causes and robot.status == "adequate":
        errors = {"heldout": other.heldout, "trial_errors": other.trial_errors, "unit": other.unit}
        robot = replace(robot, **errors, traces=(), residuals=())
    unknown = robot.unknown if robot.unknown.alarm else other.unknown
    causes = [
        replace(cause, role="symptom") if unknown.alarm else cause for cause in (*robot.causes, *other.causes)
    ]
    evidence = [
        replace(item, decision="symptom") if unknown.alarm and item.decision == "accepted" else item
        for item in (*robot.evidence, *other.evidence)
    ]
    return replace(
        robot,
        status=max(robot.status, other.status, key=_WORSE.index),
        causes=tuple(causes),
        ambiguous_with=() if unknown.alarm else (*robot.ambiguous_with, *other.ambiguous_with),
        unknown=unknown,
        minimum_detectable={**robot.minimum_detectable, **other.minimum_detectable},
        next_experiment=robot.next_experiment or other.next_experiment,
        evidence=tuple(evidence),
    )
