"""A verdict held against the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hidden.writer import Truth


@dataclass(frozen=True)
class Grade:
    """What became of one set. `kind` is one of KINDS; errors are relative, by cause.parameter."""

    kind: str
    exact: bool
    first_right: bool
    wrong_first: bool
    named: tuple[str, ...]
    in_set: bool
    """Whether every true cause is among the names given or among those that it is tied with."""
    recall: float
    precision: float
    errors: dict[str, float] = field(default_factory=dict)
    covered: dict[str, bool] = field(default_factory=dict)


KINDS = ("exact", "extra", "partial", "wrong", "missed", "ambiguous", "unknown", "invalid", "alarm", "error")


def names_of(verdict: Mapping[str, Any], role: str = "cause") -> tuple[str, ...]:
    return tuple(cause["name"] for cause in verdict["causes"] if cause["role"] == role)


def kind_of(truth: Truth, verdict: Mapping[str, Any], named: set[str]) -> str:
    """One word for the outcome."""
    status, true = verdict["status"], set(truth.causes)
    if status == "invalid_data":
        return "invalid"
    if status == "unexplained":
        return "exact" if truth.outside else "unknown" if true else "alarm"
    if status == "adequate":
        return "missed" if true or truth.outside else "exact"
    if status == "ambiguous":
        return "ambiguous" if true else "alarm"
    if not true:
        return "wrong" if truth.outside else "alarm"
    if truth.outside:
        return "wrong"
    if named == true:
        return "exact"
    return "extra" if named > true else "partial" if named & true else "wrong"


def compare(truth: Truth, verdict: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, bool]]:
    """Relative error and coverage of every parameter that the truth has in the contract's form."""
    errors: dict[str, float] = {}
    covered: dict[str, bool] = {}
    for cause in verdict["causes"]:
        for name, true in truth.params.get(cause["name"], {}).items():
            found = cause["params"].get(name)
            if found is None or not isinstance(true, float) or not isinstance(found["value"], int | float):
                continue
            null = 1.0 if name == "exponent" else 0.0
            size = scale_of(truth, cause["name"], name)
            key = f"{cause['name']}.{name}"
            errors[key] = abs(found["value"] - true) / max(abs(size - null), 1e-12)
            if found["ci95"] is not None:
                low, high = found["ci95"]
                covered[key] = bool(low <= true <= high)
    return errors, covered


def scale_of(truth: Truth, cause: str, name: str) -> float:
    """What an error is relative to: the value, or for two components of one thing their length."""
    params = truth.params[cause]
    if cause in ("pad_tilt", "crosstalk"):
        return sum(value**2 for value in params.values()) ** 0.5
    return params[name]


def grade(truth: Truth, verdict: Mapping[str, Any]) -> Grade:
    """Judge a verdict, given as the contract's JSON object."""
    named = names_of(verdict)
    true, found = set(truth.causes), set(named)
    tied = found | {name for group in verdict["ambiguous_with"] for name in group}
    kind = kind_of(truth, verdict, found)
    confident = verdict["status"] == "explained"
    first = named[0] if named else None
    errors, covered = compare(truth, verdict) if true <= found and confident else ({}, {})
    return Grade(
        kind,
        kind == "exact",
        confident and first in true,
        (confident and first is not None and first not in true)
        or (verdict["status"] == "ambiguous" and not (tied & true)),
        named,
        true <= tied,
        len(found & true) / max(1, len(true)),
        len(found & true) / max(1, len(found)),
        errors,
        covered,
    )
