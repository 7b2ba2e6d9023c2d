"""A face that lies deeper, or higher, by another amount at every taxel.

What a cover of uneven thickness does to the first touches of its taxels is a map, as their gains are: it is
shrunk by what taxels have in common, and recordings that are left out are predicted by the map of others.
Shapes: R x C taxels.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents
from lerobot_vtrefine.diagnose.pad.candidates.contact_offset import LARGEST_M, UNEVEN
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, predict
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import COMMON
from lerobot_vtrefine.diagnose.pad.taxel_maps import MapEvidence, map_evidence, solve_map
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

FACE_M = 1e-4
"""Unit of a face's unevenness: maps are shrunk within deviations of .001 to .8 of it [m]."""
PASSES = 3
"""Times that a face is told, each around the one before: what it lifts is touched earlier."""

Array = np.ndarray


def uneven(model: Composite) -> bool:
    """Whether the model's offset is another at every taxel."""
    return UNEVEN in model.forms


def in_common(model: Composite) -> bool:
    """Whether taxels have more of their offset in common than they differ by.

    Over a crumb a few taxels lie higher and most where they should: their mean is no offset of the pad.
    """
    offset_m = float(model.own(model.forms.index(UNEVEN))[0])
    return abs(offset_m) > COMMON * FACE_M * float(np.sqrt(sum(model.face_variances)))


def face_evidence(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> MapEvidence:
    """What recordings say of the face at every taxel [FACE_M], around the model's own."""
    model = fitted.model.before_leaks()
    slopes = offset_tangents(model, presses, predict(model, presses))
    assert slopes is not None
    return map_evidence(fitted, presses, weights, [slope * FACE_M for slope in slopes])


def with_face(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> Composite:
    """The model with the likeliest face; its mean where anything pressed is the offset's."""
    evidence = face_evidence(fitted, presses, weights)
    lower, variances = solve_map(evidence, range(len(weights)), _lower(fitted.model), ())
    pressed = evidence.information.sum(axis=0) > 0
    level = float(lower[pressed].mean()) if pressed.any() else 0.0
    place = fitted.model.place(fitted.model.forms.index(UNEVEN)).start
    values = fitted.model.values.copy()
    values[place] = np.clip(values[place] + FACE_M * level, -LARGEST_M, LARGEST_M)
    return replace(_on(fitted.model.at(values), lower - level), face_variances=variances)


def face_of(model: Composite, fitted: Fit, evidence: MapEvidence, keep: Sequence[int]) -> Composite:
    """The model with its face told by some recordings only."""
    lower, _ = solve_map(evidence, keep, _lower(fitted.model), fitted.model.face_variances)
    return _on(model, lower)


def on_told_face(even: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> Fit:
    """A fit whose offset is the same everywhere, with the likeliest face in its place."""
    shape = presses.layout.rows, presses.layout.cols
    start = _on(even.model, np.zeros(shape[0] * shape[1]), shape)
    start = start.plus(UNEVEN, even.model.own(even.model.families.index(UNEVEN.family))[:1])
    return settled_on_face(fit(start, presses, weights, 1), presses, weights)


def settled_on_face(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> Fit:
    """A fit's coordinates in turns with its face."""
    for _ in range(PASSES):
        fitted = fit(with_face(fitted, presses, weights), presses, weights, 4)
    return fitted


def _lower(model: Composite) -> Array:
    return np.asarray(model.setting.face_m).ravel() / FACE_M


def _on(model: Composite, lower: Array, shape: tuple[int, int] | None = None) -> Composite:
    shape = shape or np.shape(model.setting.face_m)
    rows = np.round(FACE_M * lower.reshape(shape), 9)
    return replace(model, setting=replace(model.setting, face_m=tuple(map(tuple, rows.tolist()))))
