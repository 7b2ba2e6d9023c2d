"""How a pad's diagnosis is reported: sizes with intervals, power, models, drawings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.engine import Inference
from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.preference import clearly_better
from lerobot_vtrefine.diagnose.core.problem import OptionalRemarks
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.pad import views
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting
from lerobot_vtrefine.diagnose.pad.detectable import Power, power_of
from lerobot_vtrefine.diagnose.pad.experiments import next_experiment
from lerobot_vtrefine.diagnose.pad.final_model import FinalFit
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict
from lerobot_vtrefine.diagnose.pad.form_fitting import lowest
from lerobot_vtrefine.diagnose.pad.intervals import (
    LeftOut,
    baseline_parameters,
    form_parameters,
    leave_out,
    map_parameters,
)
from lerobot_vtrefine.diagnose.pad.own_delay import with_spread
from lerobot_vtrefine.diagnose.pad.problem import Candidate, PadProblem
from lerobot_vtrefine.diagnose.pad.rules import MORE_COORDINATES
from lerobot_vtrefine.diagnose.pad.screening import DEAD, GAIN_MAP, MAPS, forms_of
from lerobot_vtrefine.diagnose.pad.shown_dead import shown_elsewhere
from lerobot_vtrefine.diagnose.pad.views import Predicted
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.host import Latency
from lerobot_vtrefine.wording import plural


class PadAccount(OptionalRemarks):
    """See `core.problem.Account`.

    Args:
        whole: all recordings, locked ones too.
    """

    unit = "counts"
    metric = "rmse"

    def __init__(self, found: Inference[PadProblem, Any, Candidate], whole: PadProblem) -> None:
        self.found, self.whole = found, whole
        self.problem = found.selection.fit.problem
        self.fit: Fit = found.selection.fit.fit
        self.plain: Fit = found.selection.baseline.fit

    @cached_property
    def _left_out(self) -> LeftOut:
        return leave_out(self.fit, self.problem.presses)

    @cached_property
    def _power(self) -> Power:
        searched = self.found.selection.problem
        thin = searched.thinned()
        if thin is searched:
            return power_of(self.problem, self.fit)
        return power_of(*thin.fitted_as(self.fit.model))

    @cached_property
    def _predicted(self) -> list[Predicted]:
        selection, predictions = self.found.selection, self.found.test.predictions
        before, after = (predictions.of(item.sensor) for item in (selection.baseline, selection.fit))
        return views.predicted(self.found.test.presses, before, after)

    def parameters(self, cause: str, channels: tuple[int, ...]) -> Mapping[str, Parameter]:
        """With intervals by leaving out every motion."""
        presses, weights = self.problem.presses, self.problem.weights
        if cause == GAIN_MAP:
            return map_parameters(self.fit, presses, weights, self.found.seed)
        if cause == DEAD:
            dead = self.fit.model.dead
            return {
                "taxels": Parameter([list(taxel) for taxel in dead], None, "1"),
                "left": Parameter([round(part, 4) for part in dead.values()], None, "1"),
            }
        index = [form.family for form in self.fit.model.forms].index(cause)
        found = form_parameters(self.fit, index, self._left_out, presses, weights)
        found = with_form_spread(found, other_forms(self.problem, self.fit, index))
        return with_spread(found, presses.delays_s) if cause == Latency.name and presses.delays_s else found

    def baseline_parameters(self) -> Mapping[str, Parameter]:
        """k_n, k_d and gain."""
        return baseline_parameters(self.plain, self.problem.presses)

    def model(self, fit: FinalFit) -> SensorModel:
        """As users load it."""
        return fit.sensor

    def minimum_detectable(self) -> Mapping[str, float]:
        """By injecting effects."""
        return self._power.smallest

    def noise_floor(self) -> float | None:
        """What repeating a recording would leave."""
        test, noise = self.found.test, self.problem.noise
        if noise is None:
            return None
        return views.noise_floor(
            self.whole.presses, test.presses, noise, predict(self.fit.model, test.presses)
        )

    def causes(self) -> Sequence[str]:
        """The catalogue, the most promising first."""
        examined = self.found.selection.examined
        names = [*dict.fromkeys(form.family for form in CATALOGUE), *MAPS]

        def promise(name: str) -> tuple[float, float]:
            seen = examined.get(name)
            gain = seen.gain if seen is not None and seen.gain is not None else -1.0
            p_adjusted = seen.p_adjusted if seen is not None and seen.p_adjusted is not None else 1.0
            return -gain, p_adjusted

        return sorted(names, key=promise)

    def not_identifiable(self, cause: str) -> str:
        """What to record to see it."""
        return self._power.not_tested.get(cause, "")

    def caveat(self, cause: str, channels: tuple[int, ...]) -> str:
        """What an accepted cause leaves open."""
        if cause == DEAD and (elsewhere := shown_elsewhere(self.fit, self.problem.presses)):
            return f"; only locked recordings press {plural(len(elsewhere), 'taxel')}, and tell each other"
        if cause != Latency.name or not self.problem.presses.delays_s:
            return ""
        spread_ms = 1e3 * float(np.std(self.problem.presses.delays_s, ddof=1))
        return f", which changes from recording to recording by about {spread_ms:.0f} ms"

    def next_experiment(
        self, rivals: Sequence[Rival[Fit, Candidate]], alarms: Sequence[Any]
    ) -> Mapping[str, Any] | None:
        """The protocol on which the first rivals differ most."""
        if not rivals or alarms or self.problem.noise is None:
            return None
        rival = rivals[0]
        names = (rival.cause, rival.name)
        models = (self.fit.model, rival.fit.model)
        recorded = self.found.selection.problem.presses
        return next_experiment(*models, recorded, self.problem.noise, names)

    def drawings(self, test: PadProblem, seed: int) -> tuple[tuple[Trace, ...], tuple[ResidualView, ...]]:
        """Held-out recordings at the taxels that answer most, and what residuals may follow."""
        return views.traces(self._predicted), views.residual_views(self._predicted, seed)

    def maps(self) -> dict[str, np.ndarray]:
        """Title -> (R, C)."""
        return views.residual_maps(self._predicted, self.whole.presses)


def other_forms(problem: PadProblem, fitted: Fit, index: int) -> list[dict[str, tuple[float, str]]]:
    """Parameters in other forms of a cause that predict about as well as form number `index`.

    Recordings that cannot distinguish two laws do not determine what only one of them says.
    """
    form, setting = fitted.model.forms[index], fitted.model.setting
    if form.range is not None:
        return []
    others = [
        other
        for other in forms_of(form.family, fitted)
        if other is not form and 0 < len(other.values) <= len(form.values) + MORE_COORDINATES
    ]
    full = out_of_fold(problem, fitted, problem.folds)
    reports = []
    for other in others:
        starts = _starts(other, form, fitted.model.own(index), setting)
        models = [fitted.model.plus(other, start) for start in starts]
        found = lowest(models, problem.presses, problem.weights)
        if not clearly_better(full, out_of_fold(problem, found, problem.folds), problem.seed):
            place = found.model.forms.index(other)
            reports.append(other.report(found.model.own(place), setting))
    return reports


def _starts(other: Form, form: Form, values: np.ndarray, setting: Setting) -> np.ndarray:
    """Where descents of another form start (s, p): at the same values, where it has the same coordinates."""
    if other.values == form.values:
        return values[None]
    if other.grown is not None and len(values) < len(other.values):
        starts = other.grown(values, setting)
    else:
        starts = other.probes(setting)[0]
    return np.clip(np.atleast_2d(starts), other.low, other.high)


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
