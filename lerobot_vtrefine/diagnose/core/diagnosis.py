"""What every instrument's diagnosis is: the verdict, both models, and what the report draws."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import Evidence, ResidualView, Savable, Trace, TrialError
from lerobot_vtrefine.diagnose.verdict import DataIssue, Parameter, Verdict


@dataclass(frozen=True)
class Diagnosis:
    """What was found, for pads, joints, cameras and parts alike.

    Attributes:
        verdict: what ``verdict.json`` holds.
        baseline_model, extended_model: what ``vtrefine-predict`` loads; None where nothing was fitted.
        measured_models: the same two as they were when errors on locked trials were measured; users may get
            refits to all trials.
        baseline_params: the refitted parameters of the baseline, name -> value with interval.
        evidence: every candidate that was examined, rejected ones too.
        traces, residuals, trial_errors: about locked trials only.
        alarms: everything behind `verdict.unknown`.
        maps: title -> (R, C); of pads only.
        unit: of readings or positions: "counts", "rad", "m".
        checked: number of recordings that passed quality control.
    """

    verdict: Verdict
    baseline_model: Savable | None = None
    extended_model: Savable | None = None
    measured_models: tuple[Savable | None, Savable | None] = (None, None)
    baseline_params: Mapping[str, Parameter] = field(default_factory=dict)
    evidence: tuple[Evidence, ...] = ()
    traces: tuple[Trace, ...] = ()
    residuals: tuple[ResidualView, ...] = ()
    trial_errors: tuple[TrialError, ...] = ()
    alarms: tuple[Alarm, ...] = ()
    maps: Mapping[str, np.ndarray] = field(default_factory=dict)
    unit: str = "rad"
    checked: int = 0

    def noting(self, *issues: DataIssue) -> "Diagnosis":
        """The same with more problems of the data in front of those that are noted."""
        noted = (*issues, *self.verdict.data_issues)
        return replace(self, verdict=replace(self.verdict, data_issues=noted))
