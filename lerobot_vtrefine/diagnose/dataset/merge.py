"""One verdict from several: what was found about parts or a camera, beside what was found about the robot."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

from lerobot_vtrefine.diagnose.evidence import Evidence, TrialError
from lerobot_vtrefine.diagnose.joints.engine import RobotDiagnosis
from lerobot_vtrefine.diagnose.verdict import Cause, Heldout, Status

_WORSE: tuple[Status, ...] = ("adequate", "explained", "ambiguous", "unexplained")


class Findings(Protocol):
    """What else a dataset tells."""

    @property
    def status(self) -> Status: ...  # noqa: D102
    @property
    def causes(self) -> tuple[Cause, ...]: ...  # noqa: D102
    @property
    def ambiguous_with(self) -> tuple[tuple[str, ...], ...]: ...  # noqa: D102
    @property
    def minimum_detectable(self) -> Mapping[str, float]: ...  # noqa: D102
    @property
    def next_experiment(self) -> Mapping[str, Any] | None: ...  # noqa: D102
    @property
    def heldout(self) -> Heldout | None: ...  # noqa: D102
    @property
    def trial_errors(self) -> tuple[TrialError, ...]: ...  # noqa: D102
    @property
    def unit(self) -> str: ...  # noqa: D102
    @property
    def evidence(self) -> tuple[Evidence, ...]: ...  # noqa: D102


def beside(robot: RobotDiagnosis, other: Findings) -> RobotDiagnosis:
    """The robot's diagnosis with other causes beside its own.

    Held-out errors are those of the joints where something was found about these, else those of what was
    found; every cause's own gain stands with it. An alarm about joints says nothing about a camera, but a
    verdict that is unexplained holds symptoms only.
    """
    if other.causes and robot.status == "adequate":
        errors = {"heldout": other.heldout, "trial_errors": other.trial_errors, "unit": other.unit}
        robot = replace(robot, **errors, traces=(), residuals=())
    alarmed = robot.unknown.alarm
    causes = [replace(cause, role="symptom") if alarmed else cause for cause in other.causes]
    evidence = [
        replace(item, decision="symptom") if alarmed and item.decision == "accepted" else item
        for item in other.evidence
    ]
    return replace(
        robot,
        status=max(robot.status, other.status, key=_WORSE.index),
        causes=(*robot.causes, *causes),
        ambiguous_with=() if alarmed else (*robot.ambiguous_with, *other.ambiguous_with),
        minimum_detectable={**robot.minimum_detectable, **other.minimum_detectable},
        next_experiment=robot.next_experiment or other.next_experiment,
        evidence=(*robot.evidence, *evidence),
    )
