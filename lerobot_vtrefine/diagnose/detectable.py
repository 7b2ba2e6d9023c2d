"""The smallest effect that these recordings would have shown, for every cause that was not found."""

import numpy as np

from lerobot_vtrefine.diagnose.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.candidates.base import Form
from lerobot_vtrefine.diagnose.parallel import on_all_cores
from lerobot_vtrefine.diagnose.screening import Scorer

MARGIN = 3.2 + 0.85
"""Standard errors that an effect must stand out by to pass the screening in four cases of five."""
CORRECTIONS = 2
MAIN = {
    "viscoelastic_relaxation": "fraction",
    "hysteresis": "fraction",
}
"""Parameter in which the smallest effect is given, where it is not the first that a form reports."""
NULL = {"nonlinear_stiffness": 1.0}
"""Value that means no effect, where it is not 0; an exponent's excess is given."""


def minimum_detectable(scorer: Scorer) -> dict[str, float]:
    """Size of each cause's main parameter from which on it would be seen; causes never seen are left out."""
    setting = scorer.fitted.model.setting
    held = set(scorer.fitted.model.families)
    plain = {form.family: form for form in reversed(CATALOGUE)}
    forms = [form for form in plain.values() if form.screened and form.family not in held]
    forms = [form for form in forms if form.possible(setting)]
    sizes = on_all_cores(lambda form: _of_cause(form, scorer), forms)
    return {form.family: size for form, size in zip(forms, sizes, strict=True) if size is not None}


def _of_cause(form: Form, scorer: Scorer) -> float | None:
    """The smallest visible size over a form's probes, None if none can be seen."""
    better = max if form.family == "saturation" else min
    guesses = [np.asarray(guess, dtype=float) for guess in form.probes(scorer.fitted.model.setting)]
    sizes = [_smallest(form, guess, scorer) for guess in guesses]
    return better((_public(form, size, scorer) for size in sizes if size is not None), default=None)


def _public(form: Form, values: np.ndarray, scorer: Scorer) -> float:
    report = form.report(values, scorer.fitted.model.setting)
    name = MAIN.get(form.family, next(iter(report)))
    value = report[name][0]
    if value == 0.0 and form.family in ("crosstalk", "pad_tilt"):
        value = max((abs(item[0]) for item in report.values()), default=0.0)
    return float(abs(value - NULL.get(form.family, 0.0)))


def _smallest(form: Form, guess: np.ndarray, scorer: Scorer) -> np.ndarray | None:
    """Injected sizes, corrected in proportion, until one just stands out; None if none can."""
    grow = _growing(form)
    values, best = guess.copy(), None
    for _ in range(CORRECTIONS):
        strength = _strength(form, values, scorer)
        if strength >= MARGIN:
            best = values
        if 1.0 <= strength / MARGIN <= 1.25:
            break
        factor = float(np.clip(MARGIN * 1.1 / max(strength, 1e-6), 0.02, 50.0))
        values = values.copy()
        values[grow] *= factor
        if (values > form.high).any() or (values < form.low).any():
            values = np.clip(values, form.low, form.high)
            return values if _strength(form, values, scorer) >= MARGIN else best
    return best


def _growing(form: Form) -> np.ndarray:
    """Coordinates that make the effect larger."""
    return np.array([form.amplitude]) if form.amplitude is not None else np.arange(len(form.values))


def _strength(form: Form, values: np.ndarray, scorer: Scorer) -> float:
    """Injected effect's score over the scatter of the recordings' scores."""
    scores, information = scorer.score(scorer.change(form, values))
    scatter = float(np.sqrt(np.sum((scores - scores.mean()) ** 2)))
    return float(information.sum()) / max(scatter, 1e-12)
