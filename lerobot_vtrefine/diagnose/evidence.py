"""What an engine hands to the report together with its verdict: evidence per candidate, traces, residuals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lerobot_vtrefine.choices import check_choice


@dataclass(frozen=True)
class Evidence:
    """One candidate cause and what became of it; candidates that were rejected are listed too.

    ``p_adjusted`` is controlled over the family of candidates; both p-values are None where nothing was
    tested, and ``observed`` says that the cause was seen in the readings themselves instead. ``cv_gain`` is
    the part of the mean squared error that the candidate takes away in cross-validation within the
    recordings that choices are made from: not the gain on locked ones, which belongs to `Cause`.
    ``decision`` is one of DECISIONS, ``reason`` one sentence for people.
    """

    name: str
    p_value: float | None
    p_adjusted: float | None
    cv_gain: float | None
    decision: str
    reason: str
    observed: bool = False

    def __post_init__(self) -> None:
        check_choice("decision", self.decision, DECISIONS)


DECISIONS = ("accepted", "symptom", "tie", "rejected", "not identifiable")


def not_tested(evidence: Sequence[Evidence]) -> dict[str, str]:
    """Causes that the recordings could not have shown whatever their size, and what to record for each."""
    return {
        item.name: item.reason
        for item in evidence
        if item.decision == "not identifiable" and item.name.isidentifier()
    }


@dataclass(frozen=True)
class Trace:
    """A held-out trial as it was measured, simulated (baseline) and simulated by the extended model.

    Attributes:
        time_s: (N,) from the trial's start [s].
        channels: names of the K channels that answer most, for example "taxel (5, 14)" or a joint.
        measured, simulated, extended: (N, K) in the diagnosis' unit.
        drive: what drove the trial, name with unit suffix -> (N,), for example "depth_m" or "force_n".
    """

    file: str
    condition: str
    time_s: np.ndarray
    channels: tuple[str, ...]
    measured: np.ndarray
    simulated: np.ndarray
    extended: np.ndarray
    drive: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class ResidualView:
    """Mean of measured − predicted against one axis, over held-out trials, before and after the extension.

    Attributes:
        axis: "load", "rate", "history", "position", "time", ...; ``unit`` is the axis' unit.
        x: (B,) centres of the bins.
        before, after: (B,) mean residual; ``before_ci95``, ``after_ci95`` (B, 2) by resampling trials.
    """

    axis: str
    unit: str
    x: np.ndarray
    before: np.ndarray
    after: np.ndarray
    before_ci95: np.ndarray | None
    after_ci95: np.ndarray | None


@dataclass(frozen=True)
class TrialError:
    """Root mean squared error of a held-out trial before and after the extension, in the diagnosis' unit."""

    file: str
    condition: str
    baseline: float
    extended: float


class Savable(Protocol):
    """A model that writes itself as one JSON file."""

    def save(self, path: str | Path) -> None:
        """Write the file."""
        ...
