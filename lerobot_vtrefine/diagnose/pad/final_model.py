"""From what the search settled on to the model that users load, and its predictions.

The search weighs readings; users get what predicts plain readings best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.resampling import agree
from lerobot_vtrefine.diagnose.core.rules import AGREEMENT_P, DOUBTFUL_GAIN, DOUBTFUL_P, LEAST_GAIN
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, rest
from lerobot_vtrefine.diagnose.pad.idle_level import settled_idle
from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap
from lerobot_vtrefine.diagnose.pad.model import Composite, sensor_model
from lerobot_vtrefine.diagnose.pad.never_touched import with_all_dead
from lerobot_vtrefine.diagnose.pad.own_delay import timed
from lerobot_vtrefine.diagnose.pad.own_touch import with_own_touch
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.tactile.model import SensorModel

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

_SLIM_STEPS = 5
"""Steps of the refit that measures what held-out recordings lose without a cause."""
_KEPT = 4
"""Models whose predictions are kept."""


class Predictions:
    """Readings (T, n) [counts] that users' models predict for a set's scored taxels."""

    def __init__(self, presses: PressSet) -> None:
        self.presses = presses
        self._kept: list[tuple[SensorModel, list[np.ndarray]]] = []

    def of(self, model: SensorModel) -> list[np.ndarray]:
        """By the code that predicts for users; of the last few models they are kept."""
        for known, readings in self._kept:
            if known is model:
                return readings
        layout = self.presses.layout
        readings = [
            predict_trial(model, press.trial, layout)[:, press.taxels] for press in self.presses.presses
        ]
        self._kept = [*self._kept, (model, readings)][-_KEPT:]
        return readings

    def errors(self, model: SensorModel) -> np.ndarray:
        """Mean squared error of every recording (K, 1) [counts^2]."""
        pairs = zip(self.presses.presses, self.of(model), strict=True)
        return np.array([float(np.mean((measured(press) - said) ** 2)) for press, said in pairs])[:, None]


def measured(press: Press) -> np.ndarray:
    """Readings of the scored taxels, idle level included (T, n) [counts]."""
    return press.signal + press.idle


@dataclass(frozen=True)
class FinalFit:
    """What is handed out of a fit."""

    fit: Fit
    """Sizes and intervals are those of this fit."""
    problem: "PadProblem"
    """In which the fit stands."""
    model: Composite
    """What users get: the fit's, or another."""
    idle: IdleMap

    @cached_property
    def sensor(self) -> SensorModel:
        """What users load."""
        noise = self.problem.noise
        step_counts = self.problem.presses.step_counts
        return sensor_model(self.model, self.idle, step_counts, noise.floor if noise is not None else 0.0)

    @property
    def mse(self) -> np.ndarray:
        """(K, 1) of the search's fit."""
        return self.fit.mse

    @property
    def scores(self) -> np.ndarray:
        """(K, 1) of the search's fit."""
        return self.fit.scores

    def without(self, families: Sequence[str], problem: "PadProblem") -> "FinalFit":
        """Without some causes, the others fitted to plain readings."""
        model = self.fit.model
        for family in families:
            model = model.minus(family)
        slim = fit(model, problem.presses, problem.even.weights, _SLIM_STEPS)
        return replace(self, fit=slim, problem=problem, model=slim.model)


def handed_out(
    selection: Selection["PadProblem", Any, Any], seed: int, *, doubtful: bool
) -> Selection["PadProblem", Any, Any]:
    """The selection with models as users load them.

    Frames that were held count only if readings are predicted better when nobody says which ones were, as for
    new recordings.
    """
    problem, plain, fitted = selection.problem, selection.baseline, selection.fit
    around, model = problem, plain.model
    if fitted.model.families:
        around, fitted = with_own_touch(problem, fitted)
        model = trusted(problem.as_recorded, plain, fitted, seed, doubtful=doubtful)
    idle = settled_idle(model, problem.presses)
    before = FinalFit(plain, problem, plain.model, idle)
    after = FinalFit(fitted, around, model, idle)
    if "sample_and_hold" in fitted.model.families:
        errors = [problem.errors(item).mean() for item in (before, after)]
        after = after if errors[1] < errors[0] else problem.without_effect(after, before)
    return replace(selection, baseline=before, fit=after)


def completed(selection: Selection["PadProblem", Any, Any], whole: "PadProblem") -> tuple[FinalFit, FinalFit]:
    """Both models fitted anew to all recordings; causes, forms and kind of fit stay as they were decided."""
    after = selection.fit
    problem, _ = whole.weighed(None)
    plain = whole.refitted_baseline.plain
    fitted, model = plain, plain.model
    around = problem
    if after.fit.model.families:
        problem, fitted = whole.fitted_as(after.fit.model)
        if after.problem.presses.delays_s:
            problem, fitted = timed(problem, fitted)
        if fitted.model.dead:
            # Some may have been pressed in locked recordings only.
            fitted = problem.settled(with_all_dead(fitted, problem.presses).model)
        around, fitted = with_own_touch(problem, fitted)
        if after.model is after.fit.model:
            model = fitted.model
        elif after.model.families == after.fit.model.families:
            model = fit(fitted.model, whole.presses, whole.even.weights).model
        else:
            model = with_seen(problem.as_recorded, plain, fitted)
    idle = settled_idle(model, problem.presses)
    return FinalFit(plain, problem, plain.model, idle), FinalFit(fitted, around, model, idle)


def with_seen(problem: "PadProblem", plain: Fit, fitted: Fit) -> Composite:
    """The baseline with what a fit holds that was seen in the readings, not inferred: dead taxels."""
    if not fitted.model.dead:
        return plain.model
    model = replace(plain.model, dead=fitted.model.dead)
    return fit(model, problem.presses, problem.even.weights).model


def trusted(problem: "PadProblem", plain: Fit, fitted: Fit, seed: int, *, doubtful: bool) -> Composite:
    """What is handed out: never a model that predicts plain readings of recordings left out worse than the
    baseline does; then the baseline with what was seen.

    Named causes are taken as they were weighed, or refitted to plain readings where that predicts clearly
    better: where a form is not quite right, weights trust what it gets wrong.
    Beside an unknown cause (`doubtful`) that must be clearly better than the baseline in nearly all
    recordings: names are symptoms then, and what they stand in for may be otherwise next time.
    """
    even = problem.even
    before = out_of_fold(even, rest(plain.model, problem.presses, even.weights), problem.folds)
    # A map's shrinkage needs the noise, which plain weights do not know: it stays.
    refitted = fit(fitted.model, problem.presses, even.weights)
    model, held = fitted.model, out_of_fold(problem, fitted, problem.folds)
    other = out_of_fold(even, refitted, problem.folds)
    if other.gain_over(held) > LEAST_GAIN and agree((held.errors - other.errors).sum(1), seed, AGREEMENT_P):
        model, held = refitted.model, other
    needed = DOUBTFUL_GAIN if doubtful else 0.0
    lucky = doubtful and not agree((before.errors - held.errors).sum(1), seed, DOUBTFUL_P)
    return with_seen(problem, plain, fitted) if held.gain_over(before) <= needed or lucky else model
