"""One verdict from several: what was found about parts or a camera, beside what was found about the robot."""

from dataclasses import replace

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.evidence import not_tested
from lerobot_vtrefine.diagnose.verdict import Status

_WORSE: tuple[Status, ...] = ("adequate", "explained", "ambiguous", "unexplained")


def merged(robot: Diagnosis, other: Diagnosis) -> Diagnosis:
    """The robot's diagnosis with other causes beside its own.

    Held-out errors are those of the joints where something was found about these, else those of what was
    found; every cause's own gain stands with it. An alarm about joints says nothing about a camera, but a
    verdict that is unexplained holds symptoms only.
    """
    one, two = robot.verdict, other.verdict
    if two.causes and one.status == "adequate":
        robot = replace(robot, trial_errors=other.trial_errors, unit=other.unit, traces=(), residuals=())
        one = replace(one, heldout=two.heldout)
    unknown = one.unknown if one.unknown.alarm else two.unknown
    causes = [
        replace(cause, role="symptom") if unknown.alarm else cause for cause in (*one.causes, *two.causes)
    ]
    evidence = [
        replace(item, decision="symptom") if unknown.alarm and item.decision == "accepted" else item
        for item in (*robot.evidence, *other.evidence)
    ]
    verdict = replace(
        one,
        status=max(one.status, two.status, key=_WORSE.index),
        causes=tuple(causes),
        ambiguous_with=() if unknown.alarm else (*one.ambiguous_with, *two.ambiguous_with),
        unknown=unknown,
        minimum_detectable={**one.minimum_detectable, **two.minimum_detectable},
        next_experiment=one.next_experiment or two.next_experiment,
        not_tested=not_tested(evidence),
    )
    return replace(robot, verdict=verdict, evidence=tuple(evidence))
