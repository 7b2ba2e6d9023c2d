"""What every instrument's diagnosis is: the verdict's fields, both models, and what the report draws."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import Evidence, ResidualView, Savable, Trace, TrialError, not_tested
from lerobot_vtrefine.diagnose.verdict import Cause, DataIssue, Heldout, Parameter, Status, Unknown, Verdict


@dataclass(frozen=True)
class Diagnosis:
    """What was found, for pads, joints, cameras and parts alike.

    Attributes:
        status, causes, ambiguous_with, unknown, heldout, minimum_detectable, next_experiment: as in
            `Verdict`.
        issues: problems of the data.
        baseline_model, extended_model: what ``vtrefine-predict`` loads; None where nothing was fitted.
        baseline_params: the refitted parameters of the baseline, name -> value with interval.
        evidence: every candidate that was examined, rejected ones too.
        traces, residuals, trial_errors: about locked trials only.
        channel_gains: channel -> its gain on locked trials.
        alarms: everything behind `unknown`.
        maps: title -> (R, C); of pads only.
        unit: of readings or positions: "counts", "rad", "m".
        checked: number of recordings that passed quality control.
    """

    status: Status
    causes: tuple[Cause, ...] = ()
    ambiguous_with: tuple[tuple[str, ...], ...] = ()
    unknown: Unknown = field(default_factory=lambda: Unknown(alarm=False))
    heldout: Heldout | None = None
    minimum_detectable: Mapping[str, float] = field(default_factory=dict)
    next_experiment: Mapping[str, Any] | None = None
    issues: tuple[DataIssue, ...] = ()
    baseline_model: Savable | None = None
    extended_model: Savable | None = None
    baseline_params: Mapping[str, Parameter] = field(default_factory=dict)
    evidence: tuple[Evidence, ...] = ()
    traces: tuple[Trace, ...] = ()
    residuals: tuple[ResidualView, ...] = ()
    trial_errors: tuple[TrialError, ...] = ()
    channel_gains: Mapping[str, float] = field(default_factory=dict)
    alarms: tuple[Alarm, ...] = ()
    maps: Mapping[str, np.ndarray] = field(default_factory=dict)
    unit: str = "rad"
    checked: int = 0

    @property
    def verdict(self) -> Verdict:
        """What ``verdict.json`` holds."""
        return Verdict(
            self.status,
            self.causes,
            self.ambiguous_with,
            self.unknown,
            self.heldout,
            self.minimum_detectable,
            self.next_experiment,
            self.issues,
            not_tested(self.evidence),
        )
