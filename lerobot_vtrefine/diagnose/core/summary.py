"""From what the method found to the diagnosis that is handed out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Inference
from lerobot_vtrefine.diagnose.core.heldout import heldout_gain
from lerobot_vtrefine.diagnose.core.problem import Account
from lerobot_vtrefine.diagnose.core.rivals import without_cause
from lerobot_vtrefine.diagnose.core.rules import ALPHA, LEAST_GAIN, SCREEN_ALPHA
from lerobot_vtrefine.diagnose.core.search import ALL, Examined
from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import Evidence, TrialError, not_tested
from lerobot_vtrefine.diagnose.verdict import Cause, Role, Status, Unknown, Verdict

Array = np.ndarray
Found = Inference[Any, Any, Any]

_CLUES = 4
"""Clues that are listed; further ones are only counted."""
_RECORD_MORE = "no size of it would have been detected: record more conditions, slower and faster, each twice"


def tell(found: Found, account: Account[Any, Any]) -> Diagnosis:
    """The diagnosis, in the words and units of its instrument."""
    selection, test = found.selection, found.test
    before, after = (test.errors(fit) for fit in (selection.baseline, selection.fit))
    alarmed = bool(found.alarms)
    role: Role = "symptom" if alarmed else "cause"
    causes = tuple(
        Cause(
            name,
            role,
            account.parameters(name, own),
            selection.p_value(name),
            _gain(found, name, own) if found.locked else None,
            "observed" if selection.observed(name) else "tested",
        )
        for name, own in selection.causes().items()
    )
    ambiguous = () if alarmed else _pairs(found)
    traces, residuals = account.drawings(test, found.seed) if found.locked else ((), ())
    held = heldout_gain(before, after, test.files, account.metric, account.noise_floor(), found.seed)
    detectable = account.minimum_detectable()
    evidence = tuple(_evidence(found, account, name, detectable) for name in _names(found, account))
    verdict = Verdict(
        _status(bool(causes), bool(ambiguous), alarmed),
        causes,
        ambiguous,
        _unknown(found, test.channels),
        held if found.locked else None,
        detectable,
        account.next_experiment(found.rivals, found.alarms),
        not_tested=not_tested(evidence),
        models_saw_locked=found.refitted,
        withheld=selection.withheld,
    )
    return Diagnosis(
        verdict,
        baseline_model=account.model(found.models[0]),
        extended_model=account.model(found.models[1]),
        measured_models=(account.model(selection.baseline), account.model(selection.fit)),
        baseline_params=account.baseline_parameters(),
        evidence=evidence,
        traces=traces,
        residuals=residuals,
        trial_errors=_trial_errors(test, before, after) if found.locked else (),
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
    named = [(item.cause, item.name) for item in found.rivals if not item.candidate.clue]
    pairs = {frozenset(pair): pair for pair in reversed(named)}
    return tuple(reversed(pairs.values()))


def _gain(found: Found, cause: str, channels: tuple[int, ...]) -> float:
    """What the cause's removal loses on locked trials, everything else refitted."""
    bare = without_cause(found.selection, cause, channels)
    without, now = (found.test.errors(fit).mean() for fit in (bare, found.selection.fit))
    return float(1 - now / max(without, 1e-300))


def _unknown(found: Found, channels: tuple[str, ...]) -> Unknown:
    """Alarms; where there are none, what without a name ties with a cause."""
    alarms: Sequence[Alarm] = found.alarms
    if not alarms:
        clues = [item.candidate.clue for item in found.rivals if item.candidate.clue]
        return Unknown(False, "; ".join(clues) or None)
    if len(channels) == 1:
        clues = [alarm.clue for alarm in alarms]
        more = "" if len(clues) <= _CLUES else f"; and {len(clues) - _CLUES} more"
        return Unknown(True, "; ".join(clues[:_CLUES]) + more)
    channels_of: dict[str, list[str]] = {}
    reported: set[int] = set()
    for alarm in alarms:
        if alarm.channel not in reported:
            channels_of.setdefault(alarm.clue, []).append(channels[alarm.channel])
        reported.add(alarm.channel)
    clues = [f"{', '.join(names)}: {clue}" for clue, names in channels_of.items()]
    more = "" if len(clues) <= _CLUES else f"; and {len(clues) - _CLUES} more"
    return Unknown(True, "; ".join(clues[:_CLUES]) + more)


def _names(found: Found, account: Account[Any, Any]) -> tuple[str, ...]:
    """Every name that is reported, and decoys; the most promising first where scores were tested."""
    return tuple(dict.fromkeys((*account.causes(), *found.selection.examined)))


def _evidence(
    found: Found, account: Account[Any, Any], name: str, detectable: Mapping[str, float]
) -> Evidence:
    """About one name."""
    selection = found.selection
    clues = {item.cause: item.candidate.clue for item in selection.first_round}
    label = "(no name)" if clues.get(name) else name
    seen = selection.examined.get(name, Examined(None, None, None))
    p_adjusted = seen.p_adjusted
    if name in selection.causes():
        p_adjusted = selection.p_value(name)
    decision, reason = _decision(found, account, name, seen)
    showed = name in {*detectable, *_refused(found)} or _superseded(found, seen)
    if decision == "rejected" and name in account.causes() and not showed:
        decision, reason = "not identifiable", account.not_identifiable(name) or _RECORD_MORE
    if decision == "not identifiable":
        return Evidence(label, None, None, None, decision, reason)
    observed = selection.observed(name) or seen.observed
    return Evidence(label, seen.p_alone, p_adjusted, seen.gain, decision, reason, observed)


def _superseded(found: Found, seen: Examined) -> bool:
    """Whether a name showed alone, before others that were accepted explained the same."""
    return bool(found.selection.causes()) and seen.p_adjusted is not None and seen.p_adjusted < ALPHA


def _decision(found: Found, account: Account[Any, Any], name: str, seen: Examined) -> tuple[str, str]:
    """What became of a name, and why."""
    accepted, ties = found.selection.causes(), {item.name: item for item in found.rivals}
    if name in accepted:
        return _accepted(found, name, account.caveat(name, accepted[name]))
    if name in ties:
        return "tie", f"explains as much as {ties[name].cause}{_where(found, ties[name].channels)}"
    if name in (refused := _refused(found)):
        text = f"predicts held-out trials worse than the baseline (gain {refused[name]:.2f})"
        return "rejected", text
    return "rejected", _why_rejected(found, seen)


def _refused(found: Found) -> dict[str, float]:
    """Names that were taken back, with their least gain on locked trials."""
    return {item.cause: item.gain for item in sorted(found.refused, key=lambda item: -item.gain)}


def _accepted(found: Found, name: str, caveat: str) -> tuple[str, str]:
    where = _where(found, found.selection.causes()[name])
    seen = "observed in the readings, not tested; " if found.selection.observed(name) else ""
    reason = f"{seen}improves the prediction of trials left out of the fit{where}{caveat}"
    if found.selection.withheld and not seen:
        reason += "; a model with it predicts held-out trials worse, so that none is handed out"
    if not found.alarms:
        return "accepted", reason
    return "symptom", f"{reason}; but part of the error has no known cause: this may be a symptom of it"


def _why_rejected(found: Found, seen: Examined) -> str:
    if seen.gain is None:
        if seen.p_adjusted is None:
            return "no evidence of it"
        if seen.p_adjusted > SCREEN_ALPHA:
            return f"not significant (adjusted p above {SCREEN_ALPHA:g})"
        return "passed the score test, but explains nothing beyond the causes that were accepted"
    where = " on all channels" if seen.channel == ALL else _where(found, (seen.channel,))
    if seen.gain > LEAST_GAIN and (seen.p_adjusted is None or seen.p_adjusted < ALPHA):
        return f"significant{where} by itself, but another cause explains it better"
    least = f"it removes less than {100 * LEAST_GAIN:.0f} % of the error"
    place = f"strongest{where}; " if where else ""
    return f"{place}not significant, or {least}"


def _where(found: Found, channels: tuple[int, ...]) -> str:
    """On which channels, where there are several."""
    names = found.test.channels
    if len(names) == 1:
        return ""
    if len(channels) == len(names):
        return f" on all {len(names)}"
    return f" on {', '.join(names[channel] for channel in channels)}"


def _trial_errors(test: Any, before: Array, after: Array) -> tuple[TrialError, ...]:
    """Root mean square error of every locked trial."""
    errors = zip(test.files, test.conditions, before.mean(1), after.mean(1), strict=True)
    return tuple(
        TrialError(file, condition, float(np.sqrt(base)), float(np.sqrt(extended)))
        for file, condition, base, extended in errors
    )
