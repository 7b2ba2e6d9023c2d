"""From what the method found to the diagnosis that is handed out."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Inference
from lerobot_vtrefine.diagnose.core.heldout import heldout_gain
from lerobot_vtrefine.diagnose.core.problem import Account
from lerobot_vtrefine.diagnose.core.rivals import without_cause
from lerobot_vtrefine.diagnose.core.rules import ALPHA, LEAST_GAIN
from lerobot_vtrefine.diagnose.core.search import Tried
from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import Evidence, TrialError
from lerobot_vtrefine.diagnose.verdict import Cause, Role, Status, Unknown

Array = np.ndarray
Found = Inference[Any, Any, Any]

_CLUES = 4
"""Clues that are told; more are counted."""


def tell(found: Found, account: Account[Any, Any]) -> Diagnosis:
    """The diagnosis, in the words and units of its instrument."""
    selection, test = found.selection, found.test
    before, after = (test.errors(fit) for fit in (selection.baseline, selection.fit))
    alarmed = bool(found.alarms)
    role: Role = "symptom" if alarmed else "cause"
    causes = tuple(
        Cause(name, role, account.parameters(name, own), selection.p_value(name), _gain(found, name, own))
        for name, own in selection.causes().items()
    )
    ambiguous = () if alarmed else _pairs(found)
    traces, residuals = account.drawings(test, found.seed)
    gains = 1 - after.mean(0) / before.mean(0).clip(1e-300)
    held = heldout_gain(before, after, test.files, account.metric, account.noise_floor(), found.seed)
    return Diagnosis(
        status=_status(bool(causes), bool(ambiguous), alarmed),
        causes=causes,
        ambiguous_with=ambiguous,
        unknown=_unknown(found.alarms, test.channels),
        heldout=held if found.locked else None,
        minimum_detectable=account.minimum_detectable(),
        next_experiment=account.next_experiment(found.rivals, found.alarms),
        baseline_model=account.model(selection.baseline),
        extended_model=account.model(selection.fit),
        baseline_params=account.baseline_parameters(),
        evidence=tuple(_evidence(found, account, name) for name in _names(found, account)),
        traces=traces,
        residuals=residuals,
        trial_errors=_trial_errors(test, before, after),
        channel_gains={name: float(gain) for name, gain in zip(test.channels, gains, strict=True)},
        alarms=found.alarms,
        unit=account.unit,
    )


def _status(causes: bool, ambiguous: bool, alarmed: bool) -> Status:
    if alarmed:
        return "unexplained"
    if ambiguous:
        return "ambiguous"
    return "explained" if causes else "adequate"


def _pairs(found: Found) -> tuple[tuple[str, ...], ...]:
    """Names that tie, every pair once."""
    pairs = {frozenset((item.cause, item.name)): (item.cause, item.name) for item in reversed(found.rivals)}
    return tuple(reversed(pairs.values()))


def _gain(found: Found, cause: str, channels: tuple[int, ...]) -> float:
    """What the cause's removal loses on locked trials, everything else refitted."""
    bare = without_cause(found.selection, cause, channels)
    without, now = (found.test.errors(fit).mean() for fit in (bare, found.selection.fit))
    return float(1 - now / max(without, 1e-300))


def _unknown(alarms: Sequence[Alarm], channels: tuple[str, ...]) -> Unknown:
    if not alarms:
        return Unknown(alarm=False)
    told: dict[str, list[str]] = {}
    spoken_of: set[int] = set()
    for alarm in alarms:
        if alarm.channel not in spoken_of:
            told.setdefault(alarm.clue, []).append(channels[alarm.channel])
        spoken_of.add(alarm.channel)
    clues = [f"{', '.join(names)}: {clue}" for clue, names in told.items()]
    more = "" if len(clues) <= _CLUES else f"; and {len(clues) - _CLUES} more"
    return Unknown(True, "; ".join(clues[:_CLUES]) + more)


def _names(found: Found, account: Account[Any, Any]) -> tuple[str, ...]:
    """Every name that is told about, and decoys."""
    tried = (item.cause for item in found.selection.first_round)
    return tuple(dict.fromkeys((*account.causes(), *tried)))


def _evidence(found: Found, account: Account[Any, Any], name: str) -> Evidence:
    """About one name, by its best form and channel."""
    selection = found.selection
    tried = [item for item in selection.first_round if item.cause == name]
    label = name if not tried or not tried[0].candidate.clue else "(no name)"
    if not tried:
        return Evidence(label, None, None, None, "not identifiable", account.not_identifiable(name))
    alone, adjusted, gain, where = _strongest(tried, found.test.channels)
    accepted, ties = selection.causes(), {item.name: item for item in found.rivals}
    if name in accepted:
        decision = "symptom" if found.alarms else "accepted"
        channels = accepted[name]
        reason = f"on {_joined(found, channels)}{account.caveat(name, channels)}"
    elif name in ties:
        decision = "tie"
        reason = f"explains {ties[name].cause} on {_joined(found, ties[name].channels)} as well"
    elif refused := [item.gain for item in found.refused if item.cause == name]:
        decision = "rejected"
        reason = f"predicts worse than the baseline on trials left out (gain {min(refused):.2f})"
    elif why := account.not_identifiable(name):
        decision, reason = "not identifiable", why
    else:
        decision = "rejected"
        reason = (
            f"strongest on {where}; in such trials chance gives as much, or it is under "
            f"{100 * LEAST_GAIN:.0f} % of error"
        )
        if adjusted < ALPHA:
            reason = f"significant on {where} by itself, but another cause explains it better"
    return Evidence(label, alone, adjusted, gain, decision, reason)


def _strongest(
    tried: Sequence[Tried[Any, Any]], channels: tuple[str, ...]
) -> tuple[float, float, float, str]:
    item = max(tried, key=lambda one: float(one.gain.max()))
    channel = int(item.gain.argmax())
    assert item.p_alone is not None
    assert item.p_adjusted is not None
    where = "all channels" if item.candidate.shared else channels[channel]
    return float(item.p_alone[channel]), float(item.p_adjusted[channel]), float(item.gain[channel]), where


def _joined(found: Found, channels: tuple[int, ...]) -> str:
    names = found.test.channels
    if len(channels) == len(names) > 1:
        return f"all {len(names)}"
    return ", ".join(names[channel] for channel in channels)


def _trial_errors(test: Any, before: Array, after: Array) -> tuple[TrialError, ...]:
    """Root mean square error of every locked trial."""
    errors = zip(test.files, test.conditions, before.mean(1), after.mean(1), strict=True)
    return tuple(
        TrialError(file, condition, float(np.sqrt(base)), float(np.sqrt(extended)))
        for file, condition, base, extended in errors
    )
