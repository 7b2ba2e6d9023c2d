"""Causes and evidence as the verdict and the report name them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.evidence import Evidence
from lerobot_vtrefine.diagnose.pad.baseline import plain_weights
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, predict, squared_errors
from lerobot_vtrefine.diagnose.pad.intervals import LeftOut, form_parameters, map_parameters
from lerobot_vtrefine.diagnose.pad.parallel import on_all_cores
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.score_test import ALPHA
from lerobot_vtrefine.diagnose.pad.search import Search, forms_of
from lerobot_vtrefine.diagnose.pad.selection import EXTRA_GAIN, MAPS, clearly_better, scored, settle
from lerobot_vtrefine.diagnose.verdict import Cause, Parameter


def named_causes(
    search: Search, fitted: Fit, left_out: LeftOut, role: str, locked: PressSet, seed: int
) -> tuple[Cause, ...]:
    """The model's causes with parameters, evidence, and what each gains on held-out recordings."""
    full = float(squared_errors(predict(fitted.model, locked), locked).mean())

    def named(name: str) -> Cause:
        slim = fit(fitted.model.minus(name), search.presses, plain_weights(search.presses), SLIM_STEPS)
        without = float(squared_errors(predict(slim.model, locked), locked).mean())
        return Cause(
            name,
            "symptom" if role == "symptom" else "cause",
            _parameters(search, fitted, name, left_out, seed),
            search.p_adjusted.get(name),
            1.0 - full / without if without > 0 else 0.0,
            "observed" if _observed(search, name) else "tested",
        )

    return tuple(on_all_cores(named, fitted.model.families))


MORE_COORDINATES = 2
"""Coordinates that another form may have beyond the named one's, for its parameters to be heard."""
SLIM_STEPS = 5
"""Steps of the refit that tells what held-out recordings lose without a cause."""


def _observed(search: Search, name: str) -> bool:
    """Whether an accepted cause was seen in the readings themselves, so that nothing had to be tested."""
    return name in search.p_adjusted and search.p_adjusted[name] is None


def _parameters(search: Search, fitted: Fit, name: str, left_out: LeftOut, seed: int) -> dict[str, Parameter]:
    if name == "taxel_gain_spread":
        return map_parameters(fitted, search.presses, search.weights, seed)
    if name == "dead_taxels":
        return {"taxels": Parameter([list(taxel) for taxel in fitted.model.dead], None, "1")}
    index = [form.family for form in fitted.model.forms].index(name)
    found = form_parameters(fitted, index, left_out, search.presses, search.weights)
    return with_form_spread(found, other_forms(search, fitted, index))


def other_forms(search: Search, fitted: Fit, index: int) -> list[dict[str, tuple[float, str]]]:
    """Parameters in other forms of a cause that predict about as well as form number `index`.

    Recordings that cannot tell two laws apart do not know what only one of them says.
    """
    form, setting = fitted.model.forms[index], fitted.model.setting
    if form.range is not None:
        return []
    others = [
        other
        for other in forms_of(form.family, fitted)
        if other is not form and 0 < len(other.values) <= len(form.values) + MORE_COORDINATES
    ]
    full = scored(search, fitted)
    reports = []
    for other in others:
        found = settle(
            search, fitted.model.plus(other, _start(other, form, fitted.model.own(index), setting))
        )
        if not clearly_better(full, scored(search, found), search.seed):
            place = found.model.forms.index(other)
            reports.append(other.report(found.model.own(place), setting))
    return reports


def _start(other: Form, form: Form, values: np.ndarray, setting: Setting) -> np.ndarray:
    """Where the descent of another form starts: at the same values, where it has the same coordinates."""
    if other.values == form.values:
        return values
    if other.grown is not None and len(values) < len(other.values):
        start = other.grown(values, setting)
    else:
        start = other.probes(setting)[0]
    return np.clip(np.asarray(start, dtype=float), other.low, other.high)


def with_form_spread(
    found: Mapping[str, Parameter], others: Sequence[Mapping[str, tuple[float, str]]]
) -> dict[str, Parameter]:
    """Parameters whose intervals reach as far as what other forms say of the same."""
    wide = {}
    for name, item in found.items():
        values = [other[name][0] for other in others if name in other and other[name][1] == item.unit]
        if isinstance(item.ci95, tuple) and values:
            ends = (min(item.ci95[0], *values), max(item.ci95[1], *values))
            wide[name] = replace(item, ci95=ends)
        else:
            wide[name] = item
    return wide


def evidence_table(
    search: Search,
    fitted: Fit,
    role: str,
    groups: Sequence[Sequence[str]],
    not_tested: Mapping[str, str],
) -> tuple[Evidence, ...]:
    """One row per candidate, found or not, the most promising first.

    Args:
        not_tested: causes that these recordings cannot show, and what to record.
    """
    names = [*dict.fromkeys(form.family for form in CATALOGUE), *MAPS]
    rows = [_row(name, search, fitted, role, groups, not_tested.get(name)) for name in names]
    return tuple(sorted(rows, key=lambda row: (-(row.cv_gain or -1.0), row.p_adjusted or 1.0)))


def _row(
    name: str,
    search: Search,
    fitted: Fit,
    role: str,
    groups: Sequence[Sequence[str]],
    to_record: str | None,
) -> Evidence:
    found = search.screened.get(name)
    p_value, adjusted = (found.p_value, found.p_adjusted) if found is not None else (None, None)
    gain = search.cv_gains.get(name)
    if name in fitted.model.families:
        adjusted = search.p_adjusted.get(name, adjusted)
        observed = _observed(search, name)
        tied = [other for group in groups if name in group for other in group if other != name]
        if tied and role != "symptom":
            text = f"explains the data, but so does {', '.join(tied)}"
            return Evidence(name, p_value, adjusted, gain, "tie", text, observed)
        if role == "symptom":
            text = "improves the fit, but structure is left that no cause explains: the name may be borrowed"
            return Evidence(name, p_value, adjusted, gain, "symptom", text, observed)
        text = "predicts recordings that its fit has not seen better"
        if observed:
            text = f"seen in the readings themselves, not tested; {text}"
        return Evidence(name, p_value, adjusted, gain, "accepted", text, observed)
    if any(name in group for group in groups) and role != "symptom":
        return Evidence(name, p_value, adjusted, gain, "tie", "explains the data as well as what was named")
    if to_record is not None:
        return Evidence(name, None, None, None, "not identifiable", to_record)
    seen = found is not None and found.probe.observed
    reason = _why_rejected(found is not None, adjusted, gain)
    return Evidence(name, p_value, adjusted, gain, "rejected", reason, seen)


def _why_rejected(screened: bool, adjusted: float | None, gain: float | None) -> str:
    if not screened:
        return "no sign of it"
    if adjusted is not None and adjusted > ALPHA:
        return f"recordings agree on it no more than by chance (adjusted p above {ALPHA:g})"
    if gain is None:
        return "passed the screening, but others explained more and left nothing for it"
    if gain <= EXTRA_GAIN:
        return "takes away too little of the cross-validated error"
    return "another cause explains the same better"
