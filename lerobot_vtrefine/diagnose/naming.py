"""Causes and evidence as the verdict and the report name them."""

from collections.abc import Sequence

from lerobot_vtrefine.diagnose.baseline import plain_weights
from lerobot_vtrefine.diagnose.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.evidence import Evidence
from lerobot_vtrefine.diagnose.fitting import Fit, fit, predict, squared_errors
from lerobot_vtrefine.diagnose.intervals import LeftOut, form_parameters, map_parameters
from lerobot_vtrefine.diagnose.parallel import on_all_cores
from lerobot_vtrefine.diagnose.presses import PressSet
from lerobot_vtrefine.diagnose.screening import ALPHA
from lerobot_vtrefine.diagnose.search import Search
from lerobot_vtrefine.diagnose.selection import EXTRA_GAIN, MAPS
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
        )

    return tuple(on_all_cores(named, fitted.model.families))


SLIM_STEPS = 5
"""Steps of the refit that tells what held-out recordings lose without a cause."""


def _parameters(search: Search, fitted: Fit, name: str, left_out: LeftOut, seed: int) -> dict[str, Parameter]:
    if name == "taxel_gain_spread":
        return map_parameters(fitted, search.presses, search.weights, seed)
    if name == "dead_taxels":
        return {"taxels": Parameter([list(taxel) for taxel in fitted.model.dead], None, "1")}
    index = [form.family for form in fitted.model.forms].index(name)
    return form_parameters(fitted, index, left_out, search.presses, search.weights)


def evidence_table(
    search: Search, fitted: Fit, role: str, groups: Sequence[Sequence[str]]
) -> tuple[Evidence, ...]:
    """One row per candidate, found or not, the most promising first."""
    setting = fitted.model.setting
    possible = {form.family: False for form in CATALOGUE}
    for form in CATALOGUE:
        possible[form.family] |= form.possible(setting)
    rows = [_row(name, search, fitted, role, groups, possible.get(name, True)) for name in [*possible, *MAPS]]
    return tuple(sorted(rows, key=lambda row: (-(row.heldout_gain or -1.0), row.p_adjusted or 1.0)))


def _row(
    name: str, search: Search, fitted: Fit, role: str, groups: Sequence[Sequence[str]], possible: bool
) -> Evidence:
    found = search.screened.get(name)
    p_value, adjusted = (found.p_value, found.p_adjusted) if found is not None else (None, None)
    gain = search.tried.get(name)
    if name in fitted.model.families:
        adjusted = search.p_adjusted.get(name, adjusted)
        tied = [other for group in groups if name in group for other in group if other != name]
        if tied and role != "symptom":
            return Evidence(
                name, p_value, adjusted, gain, "tie", f"explains the data, but so does {', '.join(tied)}"
            )
        if role == "symptom":
            text = "improves the fit, but structure is left that no cause explains: the name may be borrowed"
            return Evidence(name, p_value, adjusted, gain, "symptom", text)
        return Evidence(name, p_value, adjusted, gain, "accepted", "predicts held-out recordings better")
    if any(name in group for group in groups) and role != "symptom":
        return Evidence(name, p_value, adjusted, gain, "tie", "explains the data as well as what was named")
    if not possible:
        return Evidence(name, None, None, None, "not identifiable", "cannot act in these recordings")
    return Evidence(name, p_value, adjusted, gain, "rejected", _why_rejected(adjusted, gain))


def _why_rejected(adjusted: float | None, gain: float | None) -> str:
    if adjusted is None:
        return "no sign of it"
    if adjusted > ALPHA:
        return f"recordings agree on it no more than by chance (adjusted p above {ALPHA:g})"
    if gain is None:
        return "passed the screening, but others explained more and left nothing for it"
    if gain <= EXTRA_GAIN:
        return "takes away too little of the error on recordings left out"
    return "another cause explains the same better"
