"""Scores of everything that these presses may hold, before it is fitted."""

from collections.abc import Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.parallel import on_all_cores
from lerobot_vtrefine.diagnose.core.score_test import Probe, cleared
from lerobot_vtrefine.diagnose.pad.candidates import BETWEEN_FRAMES, CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import (
    held,
    irregular_periods,
    pattern,
    periods_apart,
)
from lerobot_vtrefine.diagnose.pad.fitting import Fit, movable, predict, tangents
from lerobot_vtrefine.diagnose.pad.forward_model.run import Prefix
from lerobot_vtrefine.diagnose.pad.map_prior import parts
from lerobot_vtrefine.diagnose.pad.never_touched import seen_dead
from lerobot_vtrefine.diagnose.pad.own_touch import allowed, touches_of
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.taxel_maps import map_evidence
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

GAIN_MAP, DEAD = "taxel_gain_spread", "dead_taxels"
MAPS = (GAIN_MAP, DEAD)
"""Causes that are maps over taxels: shrunk, or found without a descent."""


class Scorer:
    """Scores any change of the expected signals against one fitted model."""

    def __init__(
        self,
        fitted: Fit,
        presses: PressSet,
        weights: Sequence[TrialWeights],
        columns: Sequence[Sequence[np.ndarray]],
    ) -> None:
        self.fitted, self.presses, self.weights = fitted, presses, weights
        self._prefix = Prefix()
        predict(fitted.model, presses, self._prefix)
        self._prefix.frozen = True
        self._fixed = []
        for k, (press, weight) in enumerate(zip(presses.presses, weights, strict=True)):
            residual = press.signal - fitted.signals[k]
            self._fixed.append(weight.whiten(np.stack([*(column[k] for column in columns), residual])))
        self._known = [weight.gram(fixed) for weight, fixed in zip(weights, self._fixed, strict=True)]

    def change(self, form: Form, values: np.ndarray) -> list[np.ndarray]:
        """What adding a form does to the expected signals: (T, n) per recording."""
        moved = predict(self.fitted.model.plus(form, values), self.presses, self._prefix)
        return [a - b for a, b in zip(moved, self.fitted.signals, strict=True)]

    def grams(self, change: Sequence[np.ndarray]) -> np.ndarray:
        """Inner products of (own tangents, the change, residual): (K, q, q)."""
        grams = []
        for k, (fixed, known, weight) in enumerate(zip(self._fixed, self._known, self.weights, strict=True)):
            products = weight.products(fixed, weight.whiten(change[k]))
            last = len(products) - 2
            order = [*range(last), last + 1, last]
            gram = np.empty((last + 2, last + 2))
            gram[:-1, :-1] = known
            gram[-1] = gram[:, -1] = products
            grams.append(gram[np.ix_(order, order)])
        return np.array(grams)

    def score(self, change: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Effective scores and information (K,) of a change (T, n) per recording."""
        return cleared(self.grams(change))


def scorer_of(problem: "PadProblem", fitted: Fit) -> Scorer:
    """Scores against a fit, cleared of what its coordinates can do."""
    _, columns = tangents(fitted.model, problem.presses, movable(fitted))
    return Scorer(fitted, problem.presses, problem.weights, columns)


def freed_scorer(problem: "PadProblem", fitted: Fit) -> Scorer | None:
    """The same cleared also of what coordinates could do if no bound stopped them; None where none does.

    A delay that some places do not have makes the damping vanish, and these then seem early. Whether a
    change stands in for a negative damping or brings the damping back, no score says.
    """
    free = fitted.model.free
    if len(movable(fitted)) == len(free):
        return None
    _, columns = tangents(fitted.model, problem.presses, free)
    return Scorer(fitted, problem.presses, problem.weights, columns)


def probe_form(form: Form, scorer: Scorer) -> list[Probe]:
    """Scores of all probes of a form."""
    probes = []
    for guess in form.probes(scorer.fitted.model.setting):
        values = np.asarray(guess, dtype=float)
        scores, information = scorer.score(scorer.change(form, values))
        probes.append(Probe(form.family, form, values, scores, information, not form.signed))
    return probes


def forms_of(family: str, fitted: Fit, *, settled: bool = False) -> list[Form]:
    """Forms of a family that can show in these recordings, the plain one first; with those that are asked
    about once names are settled."""
    setting, others = fitted.model.setting, set(fitted.model.families)
    return [
        form
        for form in CATALOGUE
        if form.family == family
        and (form.competes or settled)
        and form.possible(setting)
        and (not form.beside or others.intersection(form.beside))
    ]


def form_probes(problem: "PadProblem", fitted: Fit, families: Collection[str] | None = None) -> list[Probe]:
    """Probes of every form (of those families) of causes that the model does not hold yet."""
    scorer, freed = scorer_of(problem, fitted), freed_scorer(problem, fitted)
    known = set(fitted.model.families)
    forms = [
        form
        for form in CATALOGUE
        if form.screened and form.possible(fitted.model.setting) and form.family not in known
        if families is None or form.family in families
    ]
    jobs = [partial(probe_form, form, scorer) for form in forms]
    if freed is not None:
        jobs += [partial(probe_form, form, freed) for form in forms if form.family in BETWEEN_FRAMES]
    return [probe for found in on_all_cores(lambda job: job(), jobs) for probe in found]


def all_probes(problem: "PadProblem", fitted: Fit) -> list[Probe]:
    """Probes of forms, of maps, and of frames that repeat."""
    probes = [*form_probes(problem, fitted), *map_probes(problem, fitted)]
    touch = touch_probe(problem, fitted)
    probes += [touch] if touch is not None else []
    repeats = hold_probe(problem, fitted)
    if repeats is not None:
        probes = [*(probe for probe in probes if probe.name != repeats.name), repeats]
    return probes


def gain_spread_probes(problem: "PadProblem", fitted: Fit) -> list[Probe]:
    """Products between recordings of what they say about taxels' gains, quadratic in the signs: of every
    taxel's own gain, and of what lines and regions share, which commands with no common taxel tell, too."""
    evidence = map_evidence(fitted, problem.presses, problem.weights)
    total = evidence.information.sum(axis=0)
    known = np.flatnonzero(total > 0)
    scores, share = evidence.scores[:, known], evidence.information[:, known] / total[known]
    # A level that all taxels share belongs to the gain.
    level = scores.sum(axis=1, keepdims=True) / max(float(total.sum()), 1e-300)
    unit = scores / np.sqrt(total[known]) - level * np.sqrt(total[known])
    found = []
    for part in parts(known, known, evidence.shape):
        alike = part / np.linalg.norm(part, 2)
        products = unit @ alike @ unit.T
        np.fill_diagonal(products, 0.0)
        each = np.einsum("ki,ij,kj->", share, alike**2, share)
        scatter = float(np.sqrt(2.0 * max((alike**2).sum() - each, 0.0)))
        size = np.array([max(float(products.sum()), 0.0)])
        found.append(
            Probe(
                GAIN_MAP,
                None,
                np.zeros(0),
                size,
                np.maximum(size, 1e-12),
                one_sided=True,
                products=products,
                products_scatter=scatter,
            )
        )
    return found


def map_probes(problem: "PadProblem", fitted: Fit) -> list[Probe]:
    """Probes of gains and dead taxels that the model does not hold yet."""
    found = []
    if problem.presses.layout.num_taxels < 2:
        return found
    if GAIN_MAP not in fitted.model.families:
        found += gain_spread_probes(problem, fitted)
    if DEAD not in fitted.model.families and seen_dead(fitted, problem.presses):
        # Answers that fail by a factor of eight at many times their error are seen, not tested.
        found.append(_observed(DEAD, None, np.zeros(0)))
    return found


def touch_probe(problem: "PadProblem", fitted: Fit) -> Probe | None:
    """Recordings' own touches, which all lie on one side if the face is not where it was assumed.

    Between that and recordings that differ, a change of the readings near the touch cannot tell: the earliest
    recordings decide its score.
    """
    forms, noise = forms_of("contact_offset", fitted), problem.noise
    if not forms or forms[0].family in fitted.model.families or noise is None:
        return None
    if not allowed(problem.presses, problem.weights):
        return None
    late = touches_of(fitted.model, problem.presses, noise) / noise.offset_m
    size = np.array([noise.offset_m])
    return Probe(forms[0].family, forms[0], size, late, np.ones(len(late)), one_sided=False)


def hold_probe(problem: "PadProblem", fitted: Fit) -> Probe | None:
    """Readings that repeat, in a rhythm or more often than by chance, are held whatever the motion."""
    forms = forms_of("sample_and_hold", fitted)
    if not forms or forms[0].family in fitted.model.families:
        return None
    presses, frame_s = problem.presses, fitted.model.setting.frame_s
    if fitted.model.setting.row_groups:
        return _observed(forms[0].family, forms[0], np.array(periods_apart(presses, frame_s)[0]))
    rhythm = pattern(presses, frame_s)
    if rhythm is not None:
        return _observed(forms[0].family, forms[int(rhythm.free)], np.array([rhythm.period_s]))
    if held(presses):
        values = np.array(irregular_periods(presses, frame_s)[0])
        return _observed(forms[0].family, forms[-1], values)
    return None


def _observed(name: str, form: Form | None, values: np.ndarray) -> Probe:
    return Probe(name, form, values, np.ones(1), np.ones(1), one_sided=True, observed=True)
