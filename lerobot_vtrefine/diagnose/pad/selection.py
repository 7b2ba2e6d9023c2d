"""From survivors of the screening to a model: refit, rank on recordings left out, add, swap, take away."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lerobot_vtrefine.diagnose.pad.alarms import LEVEL, slow_errors
from lerobot_vtrefine.diagnose.pad.baseline import plain_weights, weigh
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.baseline_drift import CURVE
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import held
from lerobot_vtrefine.diagnose.pad.crossvalidation import Score, agree, cross_validate
from lerobot_vtrefine.diagnose.pad.damping_profile import walk
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, movable, predict, squared_errors, tangents
from lerobot_vtrefine.diagnose.pad.idle_drift import wander_probe
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.parallel import on_all_cores
from lerobot_vtrefine.diagnose.pad.score_test import Probe, Scorer, Screened, probe_form, screen
from lerobot_vtrefine.diagnose.pad.search import (
    SEEN,
    Search,
    all_probes,
    forms_of,
    hold_probe,
    map_probes,
)
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead, with_map
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

MAX_CAUSES = 4
MIN_GAIN = 0.01
"""Part of the mean squared error on recordings left out that a cause must take away."""
AGREEMENT_P = 0.05
"""Chance that recordings left out are foretold better as often, if there were nothing (sign flips)."""
EXTRA_GAIN = 0.025
"""The same for causes beside the first: a little is also gained by patching up the first one's form."""
FORGIVEN = 1.5
"""Factor by which weights may raise the plain squared error of a model."""
SCOUTING_STEPS = 2
MAP_TOLERANCE = 1e-4
"""Relative decrease of the loss at which a map of gains needs no second turn."""
PROMISING = 0.4
"""Part of the best candidate's gain that a plain form must reach for its family's other forms to be tried."""
RICH = 2
"""Coordinates of a form from which on it imitates other causes."""
REFITTED = 6
"""Survivors that are refitted in a round."""
MAPS = ("taxel_gain_spread", "dead_taxels")
TIMING = ("latency", "scan_skew")
"""Causes that are imitated by what a motion did between two frames, which nobody saw."""


@dataclass(frozen=True)
class Step:
    """One candidate's fit beside (or in place of) what the model already holds."""

    name: str
    fitted: Fit
    score: Score
    gain: float
    """Part of the previous model's squared error that is gone, on recordings left out."""
    logs: np.ndarray
    """Gain in log score of every recording (K,)."""


def refit(search: Search, fitted: Fit, form: Form, probes: Sequence[Probe]) -> Fit:
    """Best fit of the model with a form added, over its starting points."""
    points = starting_points(search, fitted, form, probes)
    models = [fitted.model.plus(form, values) for values in points]
    if len(models) > 1:
        # A few steps tell which start leads further down.
        tried = [fit(model, search.presses, search.weights, SCOUTING_STEPS) for model in models]
        models = [min(tried, key=lambda found: found.loss).model]
    return settle(search, models[0])


def starting_points(search: Search, fitted: Fit, form: Form, probes: Sequence[Probe]) -> list[np.ndarray]:
    """Where descents start: the two most promising probes, stretched to the size that the scores suggest."""
    setting = fitted.model.setting
    if form.search is not None:
        points = form.search(search.presses, setting.frame_s)
        losses = [_loss(search, fitted.model.plus(form, np.asarray(point, dtype=float))) for point in points]
        return [np.asarray(points[int(np.argmin(losses))], dtype=float)]
    own = sorted((p for p in probes if p.form is form), key=lambda p: -p.explained)[:2]
    if not own:
        return [
            np.clip(np.asarray(guess, dtype=float), form.low, form.high) for guess in form.probes(setting)
        ]
    points = []
    for probe in own:
        values = probe.values.copy()
        if form.amplitude is not None:
            values[form.amplitude] *= probe.size
        elif form.signed:
            values = values * probe.size
        points.append(np.clip(values, form.low, form.high))
    return points


def _loss(search: Search, model: Composite) -> float:
    from lerobot_vtrefine.diagnose.pad.fitting import losses_of

    return float(losses_of(predict(model, search.presses), search.presses, search.weights).sum())


def settle(search: Search, model: Composite, weights: Sequence[TrialWeights] | None = None) -> Fit:
    """Fit a model's coordinates; if it holds a map of gains, in turns with the map."""
    weights = search.weights if weights is None else weights
    fitted = fit(model, search.presses, weights)
    if model.gain_map is None:
        return fitted
    for _ in range(2):
        before = fitted.loss
        fitted = fit(with_map(fitted, search.presses, weights), search.presses, weights, 4)
        if before - fitted.loss < MAP_TOLERANCE * before:
            break
    return fitted


def add(search: Search, fitted: Fit, name: str, probes: Sequence[Probe]) -> tuple[Fit, Score]:
    """The best fit with a cause added in its plain form, and its errors on recordings left out."""
    if name == "taxel_gain_spread":
        found = settle(search, with_map(fitted, search.presses, search.weights))
    elif name == "dead_taxels":
        found = settle(search, replace(fitted.model, dead=find_dead(fitted, search.presses)))
    else:
        found = refit(search, fitted, forms_of(name, fitted)[0], probes)
    return found, scored(search, found)


def elaborate(
    search: Search,
    fitted: Fit,
    name: str,
    probes: Sequence[Probe],
    plain: tuple[Fit, Score],
    richest: float = np.inf,
) -> tuple[Fit, Score]:
    """The same with another form of the cause (of at most so many coordinates), where one foretells clearly
    better."""
    best = plain
    forms = forms_of(name, fitted)[1:] if name not in MAPS else []
    for form in (form for form in forms if len(form.values) <= richest):
        found = refit(search, fitted, form, probes) if form.grown is None else grow(search, plain[0], form)
        score = scored(search, found)
        if preferable(form, score, best[1], search.seed):
            best = found, score
    return best


def grow(search: Search, plain: Fit, form: Form) -> Fit:
    """The best fit with another form of a family, from where its plain form has come to rest."""
    assert form.grown is not None
    index = plain.model.families.index(form.family)
    values = np.asarray(form.grown(plain.model.own(index), plain.model.setting), dtype=float)
    return settle(search, plain.model.plus(form, np.clip(values, form.low, form.high)))


def preferable(form: Form, score: Score, than: Score, seed: int) -> bool:
    """Whether a form is to stand in for a plainer one."""
    if form.peer:
        return score.gain_over(than) > 0 and float(score.better_by(than).sum()) > 0
    return clearly_better(score, than, seed)


def clearly_better(score: Score, than: Score, seed: int, needed: float = MIN_GAIN) -> bool:
    """Whether a richer model pays: a percent (or what is needed) less error, in most recordings."""
    return score.gain_over(than) > needed and agree(score.better_by(than), seed, AGREEMENT_P)


def scored(search: Search, fitted: Fit) -> Score:
    """Errors on recordings left out."""
    return cross_validate(fitted, search.presses, search.weights, search.folds)


def take_away(search: Search, fitted: Fit, name: str) -> Fit:
    """The best fit without one of the model's causes."""
    return settle(search, fitted.model.minus(name))


def reweigh(search: Search, fitted: Fit) -> Fit:
    """Noise and weights anew around a better model, and the model's fit with them.

    Weights forgive recordings their own gain and touch; a model that is far off may use that to fit next to
    nothing. Then all readings count alike until a better one is found.
    """
    _, weights = weigh(fitted, search.presses)
    search.weights = tuple(weights)
    found = settle(search, fitted.model)
    before, after = (squared_errors(fit.signals, search.presses).sum() for fit in (fitted, found))
    if after <= FORGIVEN * before:
        return found
    search.weights = tuple(plain_weights(search.presses))
    return settle(search, fitted.model)


def survivors(found: dict[str, Screened]) -> list[Screened]:
    """Candidates that pass the screening, the most promising first."""
    return sorted((item for item in found.values() if item.passed), key=lambda item: -item.probe.explained)


def forward(search: Search, fitted: Fit, tell: Callable[[str, float], None]) -> Fit:
    """Add causes one by one while one takes away at least MIN_GAIN on recordings left out."""
    for number in range(MAX_CAUSES):
        found, steps = look_round(search, fitted)
        if not number:
            search.screened = found
        # What passes the screening and yet foretells nothing may be a cause that weights forgive in part.
        if not steps and (survivors(found) or far_off(search, fitted)):
            found, steps = without_weights(search, fitted)
        tell(f"step {number + 1}: {len(steps)} candidates refitted", (number + 1) / (MAX_CAUSES + 1))
        if not steps:
            break
        best = steps[0]
        search.rivals[best.name] = {item.probe.name for item in survivors(found)} - {best.name}
        search.p_adjusted[best.name] = found[best.name].p_adjusted
        fitted = reweigh(search, best.fitted)
        fitted = backward(search, fitted)
    return fitted


def look_round(search: Search, fitted: Fit) -> tuple[dict[str, Screened], list[Step]]:
    """How candidates beside the present model are screened, and those that foretell better, best first."""
    probes = [*all_probes(search, fitted), *map_probes(search, fitted)]
    hold = hold_probe(search, fitted)
    if hold is not None:
        probes = [*(probe for probe in probes if probe.name != hold.name), hold]
    if CURVE.possible(fitted.model.setting) and "baseline_drift" not in fitted.model.families:
        wander = wander_probe(fitted, search.presses, CURVE, search.seed)
        probes += [wander] if wander is not None else []
    found = screen(probes, len(search.weights), search.seed)
    return found, rank(search, fitted, survivors(found)[:REFITTED], probes)


def far_off(search: Search, fitted: Fit) -> bool:
    """Whether slow errors are far above noise: what weights forgive a recording then hides what is wrong."""
    each, readings = slow_errors(fitted, fitted.residuals(search.presses), search.weights)
    return float(each @ readings) > LEVEL * max(float(readings.sum()), 1.0)


def without_weights(search: Search, fitted: Fit) -> tuple[dict[str, Screened], list[Step]]:
    """A round in which all readings count alike."""
    weights = search.weights
    search.weights = tuple(plain_weights(search.presses))
    found, steps = look_round(search, settle(search, fitted.model))
    search.weights = weights
    return found, steps


def polish(search: Search, fitted: Fit) -> Fit:
    """The same causes in forms as plain as they may be, at their best parameters under settled weights."""
    return reweigh(search, untwine(search, reweigh(search, simplify(search, fitted))))


def untwine(search: Search, fitted: Fit) -> Fit:
    """The best fit along the trade-off of a delay against the damping, which descents cut short."""
    for index, form in enumerate(fitted.model.forms):
        if form.twin is not None and not fitted.model.setting.loaded:
            coordinate = fitted.model.place(index).start + form.twin
            best = walk(fitted, search.presses, search.weights, coordinate).best
            found = settle(search, best.model)
            fitted = found if found.loss < fitted.loss else fitted
    return fitted


def simplify(search: Search, fitted: Fit) -> Fit:
    """Plain forms again where they do: a rich form may have stood in for a cause that was found after it."""
    for form in fitted.model.forms:
        plain = forms_of(form.family, fitted)[0]
        if form is plain:
            continue
        slim = take_away(search, fitted, form.family)
        _, columns = tangents(slim.model, search.presses, movable(slim))
        probes = probe_form(plain, Scorer(slim, search.presses, search.weights, columns))
        found = refit(search, slim, plain, probes)
        if not preferable(form, scored(search, fitted), scored(search, found), search.seed):
            fitted = reweigh(search, found)
    return fitted


def rank(search: Search, fitted: Fit, candidates: Sequence[Screened], probes: Sequence[Probe]) -> list[Step]:
    """Refits of the candidates that foretell recordings left out better than the model does, best first.

    Every candidate is refitted in its plain form; other forms are tried of those that come near the best.
    """
    base = scored(search, fitted)
    needed = EXTRA_GAIN if fitted.model.families else MIN_GAIN
    names = [item.probe.name for item in candidates]
    plain = {}
    if "dead_taxels" in names:
        plain = {"dead_taxels": add(search, fitted, "dead_taxels", probes)}
        score = plain["dead_taxels"][1]
        if score.gain_over(base) > needed and score.better_by(base).sum() > 0:
            # Taxels without an answer disturb whatever else is fitted.
            names = []
    others = [name for name in names if name not in plain]
    plain |= dict(
        zip(others, on_all_cores(lambda name: add(search, fitted, name, probes), others), strict=True)
    )
    gains = {name: score.gain_over(base) for name, (_, score) in plain.items()}
    worth = PROMISING * max([0.0, *gains.values()])

    def further(item: Screened) -> tuple[Fit, Score]:
        name = item.probe.name
        other = item.probe.form not in (None, *forms_of(name, fitted)[:1])
        if gains[name] >= worth or other or item.probe.explained >= SEEN:
            return elaborate(search, fitted, name, probes, plain[name])
        return plain[name]

    tried = [item for item in candidates if item.probe.name in plain]
    grown = dict(zip([item.probe.name for item in tried], on_all_cores(further, tried), strict=True))
    richest = max((coordinates_of(found, name) for name, (found, _) in grown.items()), default=0)
    # What a rich form does, another cause may do with fewer coordinates.
    slighted = [name for name in grown if grown[name] is plain[name] and gains[name] > needed]
    for name in slighted if richest > RICH else []:
        grown[name] = elaborate(search, fitted, name, probes, plain[name], richest - 1)
    # Frames that repeat bit for bit are there, however little is foretold by it.
    seen = {item.probe.name for item in tried if item.probe.explained >= SEEN} - set(MAPS)
    steps = []
    for name, (found, score) in grown.items():
        gain, logs = score.gain_over(base), score.better_by(base)
        search.cv_gains[name] = max(gain, search.cv_gains.get(name, -np.inf))
        sure = name == "dead_taxels" or name in seen
        agreed = sure or agree(logs, search.seed, AGREEMENT_P)
        if not (gain > (0.0 if name in seen else needed) and logs.sum() > 0 and agreed):
            continue
        if name not in TIMING or plainly_better(search, fitted, found):
            steps.append(Step(name, found, score, gain, logs))
    return frugal(search, sorted(steps, key=lambda step: -float(step.logs.sum())))


def plainly_better(search: Search, fitted: Fit, found: Fit) -> bool:
    """Whether the richer model foretells better also where all readings count alike, both fitted so.

    Weights trust fast changes most, and it is there that a course drawn between two frames is wrong.
    """
    weights = plain_weights(search.presses)
    before, after = (
        cross_validate(settle(search, fit.model, weights), search.presses, weights, search.folds)
        for fit in (fitted, found)
    )
    return after.gain_over(before) > MIN_GAIN


def coordinates_of(fitted: Fit, name: str) -> int:
    """Number of coordinates of the form in which a model holds a cause; 0 for maps, which are shrunk."""
    return sum(len(form.values) for form in fitted.model.forms if form.family == name)


def frugal(search: Search, steps: list[Step]) -> list[Step]:
    """The first step last where its form is rich and others with fewer coordinates foretell as well."""
    if not steps or coordinates_of(steps[0].fitted, steps[0].name) <= RICH:
        return steps
    best, others = steps[0], steps[1:]
    count = coordinates_of(best.fitted, best.name)
    for step in others:
        fewer = 0 < coordinates_of(step.fitted, step.name) < count
        if fewer and not clearly_better(best.score, step.score, search.seed):
            return [step, *(other for other in others if other is not step), best]
    return steps


def backward(search: Search, fitted: Fit) -> Fit:
    """Drop causes whose removal costs less than EXTRA_GAIN; held frames, which are seen, if it costs none."""
    while len(fitted.model.families) > 1:
        full = scored(search, fitted)
        slims = on_all_cores(partial(take_away, search, fitted), fitted.model.families)
        costs = [full.gain_over(scored(search, slim)) for slim in slims]
        if held(search.presses):
            shown = [name == "sample_and_hold" for name in fitted.model.families]
            costs = [np.inf if sure and cost > 0 else cost for sure, cost in zip(shown, costs, strict=True)]
        if min(costs) >= EXTRA_GAIN:
            break
        fitted = slims[int(np.argmin(costs))]
    return fitted
