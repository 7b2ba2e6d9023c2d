"""Presses of a pad as the core's problem: recordings are trials, and one channel holds all taxels.

Fits weigh readings by the noise around the model, and forgive every recording a gain and a first touch of its
own; what users get is judged by plain squared errors. Shapes: K recordings.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.problem import OptionalSteps, PlainCandidate, Promise
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN
from lerobot_vtrefine.diagnose.core.score_test import screen
from lerobot_vtrefine.diagnose.core.screened_search import CHANNEL, folds_for
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import final_model, review
from lerobot_vtrefine.diagnose.pad.baseline import Baseline, fit_baseline, plain_weights, weigh
from lerobot_vtrefine.diagnose.pad.candidates import BETWEEN_FRAMES
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.coincidence import cover_or_leak
from lerobot_vtrefine.diagnose.pad.error_level import slow_errors
from lerobot_vtrefine.diagnose.pad.face_map import face_evidence, face_of, uneven
from lerobot_vtrefine.diagnose.pad.final_model import FinalFit
from lerobot_vtrefine.diagnose.pad.fitting import (
    Fit,
    losses_of,
    predict,
    refit_weighted,
    rest,
    squared_errors,
)
from lerobot_vtrefine.diagnose.pad.form_fitting import Starts, grown, settle, starts_of, with_form, without
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.never_touched import seen_dead
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.own_delay import moved
from lerobot_vtrefine.diagnose.pad.own_touch import allowed, losses_at_own_touch
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import FAR_OFF, FORGIVEN, FURTHER_GAIN
from lerobot_vtrefine.diagnose.pad.screening import DEAD, GAIN_MAP, all_probes, form_probes, forms_of
from lerobot_vtrefine.diagnose.pad.shown_dead import with_shown_dead
from lerobot_vtrefine.diagnose.pad.suspicions import surprises, suspicions
from lerobot_vtrefine.diagnose.pad.taxel_maps import MapEvidence, map_evidence, map_of, with_map
from lerobot_vtrefine.diagnose.pad.thinning import thinned
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights, in_deviations

Array = np.ndarray
type Found = Fit | FinalFit
type Selected = Selection["PadProblem", Any, "Candidate"]


@dataclass(frozen=True)
class Candidate(PlainCandidate):
    """One form of a cause, or a map, with the starting points that scores suggest for the cause's forms."""

    form: Form | None = None
    starts: Mapping[str, Starts] = field(default_factory=dict, compare=False)
    others: tuple[Form, ...] = field(default=(), compare=False)
    """Further forms of the cause that these recordings can show."""

    @property
    def terms(self) -> int:
        """Coordinates; maps are shrunk, or found without any."""
        return len(self.form.values) if self.form is not None else 0

    @property
    def peer(self) -> bool:
        """Whether the form is no richer than the plain one."""
        return self.form is not None and self.form.peer

    @property
    def disturbs(self) -> bool:
        """Taxels without an answer disturb whatever else is fitted."""
        return self.cause == DEAD


@dataclass(frozen=True)
class Refits:
    """See `core.problem.Scored`."""

    problem: "PadProblem"
    fit: Fit

    @cached_property
    def _evidence(self) -> MapEvidence:
        return map_evidence(self.fit, self.problem.presses, self.problem.weights)

    @cached_property
    def _face_evidence(self) -> MapEvidence:
        return face_evidence(self.fit, self.problem.presses, self.problem.weights)

    @property
    def _mapped(self) -> bool:
        return self.fit.model.gain_map is not None or uneven(self.fit.model)

    def errors(self, weights: Array, trials: Array) -> Array:
        """Mean squared errors (trials, 1).

        They tell what a map is worth, which shows at places that it knows: it comes from all recordings but
        the one that is judged.
        """
        model, part = refit_weighted(self.fit, weights), self.problem.presses.subset(trials.tolist())
        if not self._mapped:
            return squared_errors(predict(model, part), part)[:, None]
        every = np.arange(len(weights))
        signals = [
            predict(self._with_map_of(model, every[every != k]), part.subset([place]))[0]
            for place, k in enumerate(trials)
        ]
        return squared_errors(signals, part)[:, None]

    def log_scores(self, weights: Array, trials: Array) -> Array:
        """Log scores (trials, 1)."""
        part = self.problem.presses.subset(trials.tolist())
        return self.log_scores_of(refit_weighted(self.fit, weights), part, weights, trials)

    def log_scores_of(self, model: Composite, part: PressSet, weights: Array, trials: Array) -> Array:
        """The same of other coordinates and presses of those trials.

        They tell whether a map belongs to the taxels: it comes from recordings that count, so that other
        commands must agree on it.
        """
        if self._mapped:
            model = self._with_map_of(model, np.flatnonzero(weights))
        noise = self.problem.noise
        if noise is not None and allowed(part, self.problem.weights):
            losses = losses_at_own_touch(model, part, noise)
        else:
            losses = losses_of(predict(model, part), part, [self.problem.weights[k] for k in trials])
        return -0.5 * losses[:, None]

    def _with_map_of(self, model: Composite, trials: Array) -> Composite:
        if uneven(model):
            model = face_of(model, self.fit, self._face_evidence, trials.tolist())
        if model.gain_map is None:
            return model
        return map_of(model, self.fit, self._evidence, trials.tolist())


@dataclass(frozen=True)
class PadProblem(OptionalSteps):
    """See `core.problem.ScreenedProblem`."""

    presses: PressSet
    seed: int = 0
    weights: tuple[TrialWeights, ...] = ()
    """Of the present fit; none before the baseline's."""
    noise: Noise | None = None
    """Around the present fit."""
    whole: "PadProblem | None" = field(default=None, repr=False)
    """The same recordings with all their frames, where these are some of them."""
    together: "PadProblem | None" = field(default=None, repr=False)
    """The same recordings as they are, where these were moved by delays of their own."""

    subject = "pad"
    channels = ("pad",)
    screens = True
    further_gain = FURTHER_GAIN

    @property
    def conditions(self) -> tuple[str, ...]:
        """(K,)"""
        return tuple(self.presses.conditions)

    @property
    def files(self) -> tuple[str, ...]:
        """(K,)"""
        return tuple(press.trial.file for press in self.presses.presses)

    @cached_property
    def folds(self) -> Array:
        """(K,) as the search has them."""
        return folds_for(self.conditions, self.seed)

    @cached_property
    def refitted_baseline(self) -> Baseline:
        """Gain, stiffness and damping, and the noise around them."""
        return fit_baseline(self.presses)

    @cached_property
    def even(self) -> "PadProblem":
        """The same where all readings count alike."""
        return replace(self, weights=tuple(plain_weights(self.presses)))

    def subset(self, trials: Array) -> "PadProblem":
        """Only some recordings."""
        return PadProblem(self.presses.subset([int(k) for k in trials]), self.seed)

    def thinned(self) -> "PadProblem":
        """With fewer frames, where there are more than a search needs.

        What recordings are told apart by is how they differ from each other, and not the noise of frames that
        follow each other by a hundredth of a second. How readings are held is asked of all frames.
        """
        presses = thinned(self.presses)
        if presses is self.presses:
            return self
        together = self.together and self.together.thinned()
        return PadProblem(presses, self.seed, whole=self, together=together)

    def with_delays(self, delays_s: Array) -> "PadProblem":
        """Each recording moved by a delay of its own (K,) [s]; without weights."""
        if self.whole is not None:
            return self.whole.with_delays(delays_s).thinned()
        together = self.together or self
        return PadProblem(moved(together.presses, delays_s), self.seed, together=together)

    @property
    def as_recorded(self) -> "PadProblem":
        """The same under the same weights, with no recording moved."""
        if self.together is None:
            return self
        return replace(self.together, weights=self.weights, noise=self.noise)

    def with_all_frames(self, selection: Selection[Any, Fit, Candidate]) -> Selection[Any, Fit, Candidate]:
        """What was selected on some frames, fitted to all."""
        whole = selection.problem.whole
        if whole is None:
            return selection
        problem, fitted = whole.fitted_as(selection.fit.model)
        return replace(
            selection,
            problem=problem,
            baseline=whole.baseline(),
            fit=fitted,
            errors=out_of_fold(problem, fitted, problem.folds).errors,
        )

    # Fits.

    def baseline(self) -> Fit:
        """The one that predicts plain readings best, and that an extension is measured against."""
        return (self.together or self).refitted_baseline.plain

    def extended(self, now: Fit, candidate: Candidate, channels: Array, plainer: Fit | None = None) -> Fit:
        """With a candidate; other forms grow from their plain one's fit, where they can."""
        form = candidate.form
        if candidate.cause == GAIN_MAP:
            return self.settled(with_map(now, self.presses, self.weights))
        if form is None:
            return self.settled(replace(now.model, dead=seen_dead(now, self.presses)))
        if plainer is not None and form.grown is not None:
            return grown(plainer, form, self.presses, self.weights)
        return with_form(now, form, candidate.starts.get(form.label, ()), self.presses, self.weights)

    def reduced(self, now: Found, candidates: Sequence[Candidate], channels: Array) -> Found:
        """Without candidates."""
        families = [item.cause for item in candidates]
        if isinstance(now, FinalFit):
            return now.without(families, self.as_recorded)
        return without(now, families, self.presses, self.weights)

    def settled(self, model: Any) -> Fit:
        """A model's best coordinates under the present weights."""
        return settle(model, self.presses, self.weights)

    def refitted(self, now: Fit) -> Fit:
        """Under the present weights."""
        return self.settled(now.model)

    def errors(self, fit: Found) -> Array:
        """(K, 1) as users' predictions have them, where there is a model for users already."""
        if isinstance(fit, FinalFit):
            return self.predictions.errors(fit.sensor)
        return squared_errors(predict(fit.model, self.presses), self.presses)[:, None]

    @cached_property
    def predictions(self) -> final_model.Predictions:
        """What users' models say about these recordings."""
        return final_model.Predictions(self.presses)

    def reweighted(self, fit: Fit) -> Refits:
        """By one Newton step."""
        return Refits(self, fit)

    def credible(self, baseline: Fit, now: Fit, best: Fit, candidate: Candidate) -> Array:
        """(1,) Delays must predict better also where all readings count alike.

        Weights trust fast changes most, and it is there that a course drawn between two frames is wrong.
        """
        if candidate.cause not in BETWEEN_FRAMES:
            return np.ones(1, dtype=bool)
        even = self.even
        before, after = (out_of_fold(even, even.refitted(fit), self.folds) for fit in (now, best))
        return np.array([after.gain_over(before) > LEAST_GAIN])

    # Weights and scores.

    def weighed(self, now: Fit | None) -> tuple["PadProblem", Fit]:
        """Noise and weights anew around a better model, and the model's fit with them.

        Weights forgive recordings their own gain and touch; a model that is far off may use that to fit next
        to nothing. Then all readings count alike until a better one is found.
        """
        if now is None:
            start = self.refitted_baseline
            return replace(self, weights=start.weights, noise=start.noise), start.fitted
        _, weights = weigh(now, self.presses)
        other = replace(self, weights=tuple(weights))
        found = other.refitted(now)
        if found.mse.sum() <= FORGIVEN * now.mse.sum():
            return other, found
        return other.even, other.even.refitted(now)

    def fitted_as(self, model: Composite) -> tuple["PadProblem", Fit]:
        """The problem with the noise around a model that was found on other frames or recordings for weights,
        and the model's fit with them."""
        problem, _ = self.weighed(None)
        return problem.weighed(rest(model, self.presses, problem.weights))

    def unweighed(self, now: Fit) -> tuple["PadProblem", Fit]:
        """All readings count alike."""
        return self.even, self.even.refitted(now)

    def far_off(self, now: Fit) -> bool:
        """Whether slow errors are far above noise: what weights forgive a recording hides what is wrong."""
        each, readings = slow_errors(now, now.residuals(self.presses), self.weights)
        return float(each @ readings) > FAR_OFF * max(float(readings.sum()), 1.0)

    def screened(self, now: Fit, only: Collection[str] | None = None) -> list[Promise[Candidate]]:
        """Scores of all forms that are screened, of maps, and of frames that repeat."""
        probes = all_probes(self, now) if only is None else form_probes(self, now, only)
        out, sized = [], in_deviations(self.weights)
        for name, tested in screen(probes, len(self.weights), self.seed, sized=sized).items():
            forms = tuple(forms_of(name, now))
            starts = {form.label: starts_of(form, probes) for form in forms}
            plain = Candidate(name, form=forms[0] if forms else None, starts=starts, others=forms[1:])
            elsewhere = tested.probe.form not in (None, plain.form) or tested.probe.observed
            out.append(Promise(plain, tested, elsewhere))
        return out

    def refinements(self, candidate: Candidate) -> list[Candidate]:
        """The cause's other forms."""
        return [replace(candidate, form=form, others=()) for form in candidate.others]

    def without_effect(self, fit: FinalFit, baseline: FinalFit) -> FinalFit:
        """Names and sizes stay; users get the baseline with what was seen."""
        return replace(fit, model=final_model.with_seen(self.as_recorded, baseline.fit, fit.fit))

    @property
    def in_nats(self) -> bool:
        """Whether recordings have touches of their own, under which they are scored."""
        return self.noise is not None and allowed(self.presses, self.weights)

    def log_scores(self, fit: FinalFit) -> Array:
        """(K,) with every recording's own gain and touch; by plain errors where these are not known."""
        noise = fit.problem.noise
        if noise is None or not allowed(self.presses, fit.problem.weights):
            return -self.errors(fit)[:, 0]
        return -0.5 * losses_at_own_touch(fit.model, self.presses, noise)

    # Between the steps of the method.

    def reviewed(
        self, selection: Selection[Any, Fit, Candidate], seed: int
    ) -> Selection[Any, Fit, Candidate]:
        """Two names where one stands in for them, forms as plain as they may be, trade-offs resolved, and
        recordings with delays of their own."""
        return review.reviewed(selection, seed)

    def reformed(
        self, selection: Selection[Any, Fit, Candidate], seed: int
    ) -> Selection[Any, Fit, Candidate]:
        """The same names in their likeliest forms."""
        return review.reformed(selection, seed)

    def settles(self, rival: Rival, selection: Selected, seed: int) -> int:
        """Between a cover that spreads and leaks that happen to be alike."""
        return cover_or_leak(self, selection.fit, rival)

    def suspicions(self, selection: Selected, seed: int) -> list[Suspicion]:
        """What may be left."""
        return suspicions(self, selection)

    def shown(self, selection: Selected, locked: "PadProblem") -> Selected:
        """With taxels that locked recordings show to be dead."""
        fitted = with_shown_dead(self, selection.fit, locked.presses)
        selection, named = replace(selection, fit=fitted), selection.fit.model.dead
        if named or not fitted.model.dead:
            return selection
        chosen = {CHANNEL: (*selection.chosen.get(CHANNEL, ()), Candidate(DEAD))}
        return replace(selection, chosen=chosen, p_values={**selection.p_values, (DEAD, CHANNEL): None})

    def surprises(self, fit: Fit, locked: "PadProblem") -> list[Suspicion]:
        """Errors of single taxels in locked recordings."""
        return surprises(self, fit, locked.presses)

    def handed_out(self, selection: Selected, seed: int, *, doubtful: bool) -> Selected:
        """With models as users load them."""
        return final_model.handed_out(selection, seed, doubtful=doubtful)

    def completed(self, selection: Selected) -> tuple[FinalFit, FinalFit]:
        """Fitted to all presses: one site in four may have been pressed in locked ones only."""
        return final_model.completed(selection, self)
