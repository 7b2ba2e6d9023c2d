"""Causes that hide behind a third: adding one cause at a time finds the one name that stands in for two."""

from itertools import combinations

from lerobot_vtrefine.diagnose.pad.fitting import Fit, tangents
from lerobot_vtrefine.diagnose.pad.score_test import Scorer, probe_form
from lerobot_vtrefine.diagnose.pad.search import Search, forms_of
from lerobot_vtrefine.diagnose.pad.selection import (
    EXTRA_GAIN,
    clearly_better,
    refit,
    reweigh,
    scored,
    take_away,
)

BENDS = ("nonlinear_stiffness", "saturation", "contact_offset")
"""All bend readings against depth: hardening with saturation is an S, whose lower part an offset fits."""


def reconsider(search: Search, fitted: Fit) -> Fit:
    """Where one of the bends was named, any two of them in its place, if these foretell clearly better."""
    held = [name for name in fitted.model.families if name in BENDS]
    if len(held) != 1:
        return fitted
    best, score = fitted, scored(search, fitted)
    slim = take_away(search, fitted, held[0])
    for pair in combinations(BENDS, 2):
        if not all(forms_of(name, slim) for name in pair):
            continue
        found = slim
        for name in pair:
            found = _with_plain(search, found, name)
        other = scored(search, found)
        if clearly_better(other, score, search.seed, EXTRA_GAIN):
            best, score = found, other
    if best is fitted:
        return fitted
    for name in set(best.model.families) - set(fitted.model.families):
        search.rivals[name] = set(BENDS)
        search.p_adjusted[name] = search.p_adjusted[held[0]]
    return reweigh(search, best)


def _with_plain(search: Search, fitted: Fit, name: str) -> Fit:
    """A cause added in its plain form."""
    form = forms_of(name, fitted)[0]
    _, columns = tangents(fitted.model, search.presses, fitted.model.free)
    probes = probe_form(form, Scorer(fitted, search.presses, search.weights, columns))
    return refit(search, fitted, form, probes)
