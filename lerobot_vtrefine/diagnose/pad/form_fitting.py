"""Fits of a model with one more form of a cause, from where its scores suggest that descents start."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.score_test import Probe
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.face_map import settled_on_face, uneven
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, losses_of, predict, scouted
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.taxel_maps import with_map
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

_SCOUTING_STEPS = 2
_MAP_TOLERANCE = 1e-4
"""Relative decrease of the loss at which a map of gains needs no second turn."""
_STARTS = 2
"""Most promising probes of a form from which descents start."""

Weights = Sequence[TrialWeights]
Starts = tuple[np.ndarray, ...]


def settle(start: Composite, presses: PressSet, weights: Weights) -> Fit:
    """Fit a model's coordinates; if it holds a map of gains or of the face, in turns with the map."""
    fitted = fit(start, presses, weights)
    if uneven(fitted.model):
        fitted = settled_on_face(fitted, presses, weights)
    if fitted.model.gain_map is None:
        return fitted
    for _ in range(2):
        before = fitted.loss
        fitted = fit(with_map(fitted, presses, weights), presses, weights, 4)
        if before - fitted.loss < _MAP_TOLERANCE * before:
            break
    return fitted


def with_form(fitted: Fit, form: Form, starts: Starts, presses: PressSet, weights: Weights) -> Fit:
    """The best fit with a form added, over its starting points."""
    points = starts or _own_starts(fitted, form, presses, weights)
    return lowest([fitted.model.plus(form, values) for values in points], presses, weights)


def lowest(starts: Sequence[Composite], presses: PressSet, weights: Weights) -> Fit:
    """The fit from the start that leads furthest down, as a few steps tell."""
    if len(starts) == 1:
        return settle(starts[0], presses, weights)
    tried = [scouted(model, presses, weights, _SCOUTING_STEPS) for model in starts]
    return settle(min(tried, key=lambda found: found[1])[0], presses, weights)


def grown(plain: Fit, form: Form, presses: PressSet, weights: Weights) -> Fit:
    """The best fit with another form of a family, from where its plain form has come to rest."""
    assert form.grown is not None
    index = plain.model.families.index(form.family)
    points = np.atleast_2d(form.grown(plain.model.own(index), plain.model.setting))
    models = [plain.model.plus(form, np.clip(values, form.low, form.high)) for values in points]
    return lowest(models, presses, weights)


def starts_of(form: Form, probes: Sequence[Probe]) -> Starts:
    """A form's most promising probes, stretched to the size that the scores suggest."""
    own = sorted((p for p in probes if p.form is form), key=lambda p: -p.explained)[:_STARTS]
    points = []
    for probe in own if form.search is None else []:
        values = probe.values.copy()
        if form.amplitude is not None:
            values[form.amplitude] *= probe.size
        elif form.signed:
            values[form.moves] *= probe.size
        points.append(np.clip(values, form.low, form.high))
    return tuple(points)


def _own_starts(fitted: Fit, form: Form, presses: PressSet, weights: Weights) -> Starts:
    """Where descents start without scores: what the recordings themselves suggest, or the form's guesses."""
    setting = fitted.model.setting
    if form.search is None:
        guesses = form.probes(setting)
        return tuple(np.clip(np.asarray(guess, dtype=float), form.low, form.high) for guess in guesses)
    points = [np.asarray(point, dtype=float) for point in presses.searched(form.search, setting.frame_s)]
    losses = [_loss(fitted.model.plus(form, point), presses, weights) for point in points]
    return (points[int(np.argmin(losses))],)


def _loss(model: Composite, presses: PressSet, weights: Weights) -> float:
    return float(losses_of(predict(model, presses), presses, weights).sum())


def without(fitted: Fit, families: Sequence[str], presses: PressSet, weights: Weights) -> Fit:
    """The best fit without some of the model's causes."""
    model = fitted.model
    for family in families:
        model = model.minus(family)
    return settle(model, presses, weights)
