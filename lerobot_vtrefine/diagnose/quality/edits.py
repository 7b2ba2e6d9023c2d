"""What every check returns, and how it changes a recording set."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import DataIssue

SET_ASIDE = "set aside"
KEPT = "kept"
NO_VERDICT = "no verdict"
"""The set cannot be judged before this is corrected in the recordings."""


@dataclass(frozen=True)
class Finding:
    """A fault of trial ``index`` (None: of the whole set) and what becomes of it.

    ``trial`` takes the old one's place after a repair; without it, ``action`` says whether the old one stays.
    ``setting`` holds fields of the set that are repaired.
    """

    index: int | None
    problem: str
    action: str
    trial: Any = None
    setting: Mapping[str, Any] = field(default_factory=dict)


Check = Callable[[RecordingSet], Iterable[Finding]]


def apply(recordings: RecordingSet, findings: Iterable[Finding]) -> tuple[RecordingSet, list[DataIssue]]:
    """The set without what was set aside and with what was repaired, and the list of it."""
    trials = dict(enumerate(recordings.trials))
    issues, settings = [], {}
    for finding in findings:
        settings |= finding.setting
        file = None if finding.index is None else recordings.trials[finding.index].file
        issues.append(DataIssue(file, finding.problem, finding.action))
        if finding.action == NO_VERDICT:
            trials.clear()
        if finding.index is None:
            continue
        if finding.action == SET_ASIDE:
            trials.pop(finding.index, None)
        elif finding.trial is not None and finding.index in trials:
            trials[finding.index] = finding.trial
    return dataclasses.replace(recordings, trials=tuple(trials.values()), **settings), issues


def columns(trial: Any) -> dict[str, np.ndarray]:
    """The trial's columns, an entry per frame: name -> (N,) or (N, K)."""
    found = {item.name: getattr(trial, item.name) for item in dataclasses.fields(trial)}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}


def take(trial: Any, frames: np.ndarray) -> Any:
    """The trial with only these frames: a mask (N,) or indices."""
    return dataclasses.replace(trial, **{name: value[frames] for name, value in columns(trial).items()})


def place(taxel: int, cols: int) -> str:
    """A taxel by row and column, "(2, 7)"."""
    return f"({taxel // cols}, {taxel % cols})"


def few(names: list[str], most: int) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
