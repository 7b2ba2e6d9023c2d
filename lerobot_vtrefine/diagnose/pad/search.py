"""What a search for causes works on, and the probes of everything that it may add."""

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import Baseline
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import held, irregular_periods, pattern
from lerobot_vtrefine.diagnose.pad.crossvalidation import folds_of
from lerobot_vtrefine.diagnose.pad.fitting import Fit, movable, tangents
from lerobot_vtrefine.diagnose.pad.parallel import on_all_cores
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.score_test import Probe, Scorer, Screened, probe_form
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead, map_evidence
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

SEEN = 1e9
"""Size that stands for what is seen in the readings themselves: it explains more than any score."""


@dataclass
class Search:
    """Discovery recordings, the present weights, and what the search has found so far."""

    presses: PressSet
    seed: int
    weights: tuple[TrialWeights, ...]
    folds: list[list[int]]
    screened: dict[str, Screened] = field(default_factory=dict)
    """First screening of every candidate, against the baseline."""
    cv_gains: dict[str, float] = field(default_factory=dict)
    """Best cross-validated gain that each candidate reached when it was refitted."""
    rivals: dict[str, set[str]] = field(default_factory=dict)
    """Survivors beside which each accepted cause was chosen."""
    p_adjusted: dict[str, float | None] = field(default_factory=dict)
    """Adjusted p-value with which each accepted cause was screened; None where it was observed."""


def start_search(baseline: Baseline, presses: PressSet, seed: int) -> Search:
    """A search with the baseline's weights."""
    return Search(presses, seed, baseline.weights, folds_of(presses, seed))


def forms_of(family: str, fitted: Fit) -> list[Form]:
    """Forms of a family that can show in these recordings."""
    return [form for form in CATALOGUE if form.family == family and form.possible(fitted.model.setting)]


def all_probes(search: Search, fitted: Fit, families: Collection[str] | None = None) -> list[Probe]:
    """Probes of every candidate (or of those families) that the model does not hold yet."""
    _, columns = tangents(fitted.model, search.presses, movable(fitted))
    scorer = Scorer(fitted, search.presses, search.weights, columns)
    held = set(fitted.model.families)
    forms = [
        form
        for form in CATALOGUE
        if form.screened and form.possible(fitted.model.setting) and form.family not in held
        if families is None or form.family in families
    ]
    return [probe for found in on_all_cores(partial(probe_form, scorer=scorer), forms) for probe in found]


def gain_spread_probe(search: Search, fitted: Fit) -> Probe:
    """Products between recordings of what they say about every taxel's gain: quadratic in the signs."""
    evidence = map_evidence(fitted, search.presses, search.weights)
    total = evidence.information.sum(axis=0)
    known = total > 0
    unit = np.where(known, evidence.scores / np.sqrt(np.where(known, total, 1.0)), 0.0)
    products = unit @ unit.T
    np.fill_diagonal(products, 0.0)
    share = np.where(known, evidence.information / np.where(known, total, 1.0), 0.0)
    scatter = float(np.sqrt(2.0 * (share.sum(axis=0) ** 2 - (share**2).sum(axis=0)).sum()))
    size = np.array([max(float(products.sum()), 0.0)])
    return Probe(
        "taxel_gain_spread",
        None,
        np.zeros(0),
        size,
        np.maximum(size, 1e-12),
        True,
        products=products,
        products_scatter=scatter,
    )


def map_probes(search: Search, fitted: Fit) -> list[Probe]:
    """Probes of gains and dead taxels that the model does not hold yet."""
    found = []
    if search.presses.layout.num_taxels < 2:
        return found
    if "taxel_gain_spread" not in fitted.model.families:
        found.append(gain_spread_probe(search, fitted))
    if "dead_taxels" not in fitted.model.families and find_dead(fitted, search.presses):
        # Answers that fail by a factor of eight at many times their error are seen, not tested.
        found.append(_observed("dead_taxels", None, np.zeros(0)))
    return found


def _observed(name: str, form: Form | None, values: np.ndarray) -> Probe:
    """What is seen in the readings themselves explains more than any score."""
    size = np.array([SEEN])
    return Probe(name, form, values, size, size, True, observed=True)


def hold_probe(search: Search, fitted: Fit) -> Probe | None:
    """Readings that repeat, in a rhythm or more often than by chance, are held whatever the motion."""
    if "sample_and_hold" in fitted.model.families:
        return None
    frame_s = fitted.model.setting.frame_s
    rhythm = pattern(search.presses, frame_s)
    forms = forms_of("sample_and_hold", fitted)
    if rhythm is not None:
        return _observed("sample_and_hold", forms[int(rhythm.free)], np.array([rhythm.period_s]))
    if held(search.presses):
        values = np.array(irregular_periods(search.presses, frame_s)[0])
        return _observed("sample_and_hold", forms[-1], values)
    return None
