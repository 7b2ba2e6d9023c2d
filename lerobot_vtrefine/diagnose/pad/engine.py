"""From recordings of a pad to a verdict: refit, screen, rank, question, and say how sure.

`diagnose_pad` is the whole procedure; everything it calls works on arrays and is tested on its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.evidence import Evidence, ResidualView, Trace, TrialError
from lerobot_vtrefine.diagnose.pad.account import evidence_table, named_causes
from lerobot_vtrefine.diagnose.pad.baseline import Baseline, fit_baseline, plain_weights
from lerobot_vtrefine.diagnose.pad.cause_pairs import reconsider
from lerobot_vtrefine.diagnose.pad.crossvalidation import agree, cross_validate
from lerobot_vtrefine.diagnose.pad.detectable import power_of
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict, rest
from lerobot_vtrefine.diagnose.pad.idle_level import settled_idle
from lerobot_vtrefine.diagnose.pad.intervals import baseline_parameters, leave_out
from lerobot_vtrefine.diagnose.pad.model import Composite, sensor_model
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare, usable
from lerobot_vtrefine.diagnose.pad.rivals import find_ambiguities
from lerobot_vtrefine.diagnose.pad.search import Search, start_search
from lerobot_vtrefine.diagnose.pad.selection import (
    forward,
    polish,
    scored,
    settle,
)
from lerobot_vtrefine.diagnose.pad.suspicions import Suspicion, look_for_unknowns
from lerobot_vtrefine.diagnose.pad.views import (
    Foretold,
    foretell,
    heldout,
    noise_floor,
    residual_maps,
    residual_views,
    traces,
    trial_errors,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.diagnose.verdict import Cause, DataIssue, Heldout, Parameter, Unknown
from lerobot_vtrefine.tactile.model import SensorModel

MIN_RECORDINGS = 2
FEW_RECORDINGS = 8
WORSE = "locked recordings are predicted worse with what was found than without it"
DOUBTFUL_GAIN, DOUBTFUL_P = 0.03, 0.01
"""What symptoms must take away of the cross-validated squared error to be handed out as a model."""
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class PadDiagnosis:
    """What was found on a pad: fields of the verdict (docs/verdict.md), both models, what the report draws.

    Attributes:
        status, causes, ambiguous_with, unknown, heldout, minimum_detectable, next_experiment: as
            in `Verdict`.
        issues: what the engine itself had to say about the recordings.
        baseline_model, extended_model: None only if the status is `invalid_data`.
        baseline_params: k_n, k_d and gain as refitted.
        evidence: one row per candidate examined.
        traces, residuals, trial_errors, maps: on held-out recordings; arrays in `unit`.
        alarms: name of every alarm for unknown causes -> (whether it fired, share, p-value, clue); there is
            no p-value where a size is compared with a threshold and nothing is tested.
    """

    status: str
    causes: tuple[Cause, ...] = ()
    ambiguous_with: tuple[tuple[str, ...], ...] = ()
    unknown: Unknown = field(default_factory=lambda: Unknown(alarm=False))
    heldout: Heldout | None = None
    minimum_detectable: dict[str, float] = field(default_factory=dict)
    next_experiment: dict[str, Any] | None = None
    issues: tuple[DataIssue, ...] = ()
    baseline_model: SensorModel | None = None
    extended_model: SensorModel | None = None
    baseline_params: dict[str, Parameter] = field(default_factory=dict)
    evidence: tuple[Evidence, ...] = ()
    traces: tuple[Trace, ...] = ()
    residuals: tuple[ResidualView, ...] = ()
    trial_errors: tuple[TrialError, ...] = ()
    maps: dict[str, np.ndarray] = field(default_factory=dict)
    alarms: dict[str, tuple[bool, float, float | None, str]] = field(default_factory=dict)
    unit: str = "counts"


def diagnose_pad(recordings: RecordingSet, seed: int = 0, progress: Tell | None = None) -> PadDiagnosis:
    """Find what the paper's model gets wrong about these recordings, name it, extend the model, measure it.

    Args:
        seed: decides which recordings are locked, and every resampling.
        progress: called with a few words and the fraction done.

    Raises ValueError when an indenter's mesh cannot be used.
    """
    tell: Tell = progress or (lambda text, share: None)
    trials, issues = _usable_trials(recordings)
    if len(trials) < MIN_RECORDINGS:
        issues.append(DataIssue(None, f"{len(trials)} usable recordings", "nothing was fitted"))
        return PadDiagnosis("invalid_data", issues=tuple(issues))
    locked = lock([trial.condition for trial in trials], seed)
    learn = [index for index in range(len(trials)) if index not in set(locked)]
    tell("heights of the indenter", 0.02)
    everyone = prepare(recordings, trials, learn)
    if not any((press.drive > 0).any() for press in everyone.subset(learn).presses):
        issues.append(DataIssue(None, "the indenter never touches the pad", "nothing was fitted"))
        return PadDiagnosis("invalid_data", issues=tuple(issues))
    if len(trials) < FEW_RECORDINGS:
        text = (
            f"only {len(trials)} recordings: most effects cannot reach significance, see minimum_detectable"
        )
        issues.append(DataIssue(None, text, "kept"))
    if not locked:
        # A number must be given; it is then not a held-out one, and the data issue says so.
        issues.append(DataIssue(None, "too few recordings to lock any", "errors are those of the fit"))
    return _diagnose(everyone, learn, locked or learn, seed, tell, issues)


def _usable_trials(recordings: RecordingSet) -> tuple[list[Trial], list[DataIssue]]:
    trials, issues = [], []
    for trial in recordings.trials:
        clean = usable(trial)
        if clean is None:
            issues.append(DataIssue(trial.file, "too few frames hold numbers", "set aside"))
        else:
            trials.append(clean)
    if any(trial.depth_m is None for trial in trials) and any(trial.depth_m is not None for trial in trials):
        kept = [trial for trial in trials if trial.depth_m is not None]
        for trial in trials:
            if trial.depth_m is None:
                issues.append(DataIssue(trial.file, "driven by load, while others give depth", "set aside"))
        trials = kept
    return trials, issues


def _diagnose(
    everyone: PressSet, learn: list[int], locked: list[int], seed: int, tell: Tell, issues: list[DataIssue]
) -> PadDiagnosis:
    discovery = everyone.subset(learn)
    tell("refitting stiffness, damping and gain", 0.05)
    baseline = fit_baseline(discovery)
    search = start_search(baseline, discovery, seed)
    fitted = forward(search, baseline.fitted, lambda text, share: tell(text, 0.1 + 0.5 * share))
    fitted = polish(search, reconsider(search, fitted))
    tell("rival explanations", 0.62)
    rivals = find_ambiguities(search, fitted, baseline.noise)
    tell("structure that no cause explains", 0.75)
    suspicion = look_for_unknowns(search, fitted, baseline.plain)
    tell("held-out recordings", 0.85)
    return _conclude(everyone, locked, baseline, search, fitted, rivals, suspicion, seed, issues)


def _conclude(
    everyone: PressSet,
    locked: list[int],
    baseline: Baseline,
    search: Search,
    fitted: Fit,
    rivals: Any,
    suspicion: Suspicion,
    seed: int,
    issues: list[DataIssue],
) -> PadDiagnosis:
    names = fitted.model.families
    status = _status(names, rivals.groups, suspicion)
    best = _trusted(search, baseline, fitted, status == "unexplained") if names else baseline.plain.model
    idle = settled_idle(best, search.presses)
    plain, extended = (
        sensor_model(model, idle, everyone.step_counts, baseline.noise.floor)
        for model in (baseline.plain.model, best)
    )
    if "sample_and_hold" in names and not _blindly_better(search, plain, extended):
        extended = plain
    held_set = everyone.subset(locked)
    floor = noise_floor(everyone, locked, baseline.noise, predict(fitted.model, held_set))
    extended, foretold, held, surely_worse = not_worse(held_set, plain, extended, floor, seed)
    if surely_worse:
        suspicion = replace(suspicion, alarm=True, clue=suspicion.clue or WORSE)
        status = "unexplained"
    role = "symptom" if status == "unexplained" else "cause"
    power = power_of(search, fitted)
    return PadDiagnosis(
        status=status,
        causes=named_causes(search, fitted, leave_out(fitted, search.presses), role, held_set, seed),
        ambiguous_with=rivals.groups if status == "ambiguous" else (),
        unknown=Unknown(suspicion.alarm, suspicion.clue),
        heldout=held,
        minimum_detectable=power.smallest,
        next_experiment=rivals.experiment if status == "ambiguous" else None,
        issues=tuple(issues),
        baseline_model=plain,
        extended_model=extended,
        baseline_params=baseline_parameters(baseline.plain, search.presses),
        evidence=evidence_table(search, fitted, role, rivals.groups, power.not_tested),
        traces=traces(foretold),
        residuals=residual_views(foretold, seed),
        trial_errors=trial_errors(foretold),
        maps=residual_maps(foretold, everyone),
        alarms={a.name: (a.fired, a.share, a.p_value, a.clue) for a in suspicion.alarms},
    )


def not_worse(
    locked: PressSet, plain: SensorModel, extended: SensorModel, floor: float | None, seed: int
) -> tuple[SensorModel, list[Foretold], Heldout, bool]:
    """The extended model, or the plain one where it predicts locked recordings worse, whatever chose it.

    Returns the model with its predictions and errors, and whether the extension was surely worse (95 %).
    """
    foretold = foretell(locked, plain, extended)
    held = heldout(foretold, floor, seed)
    if held.gain >= 0.0:
        return extended, foretold, held, False
    surely = held.gain_ci95 is not None and held.gain_ci95[1] < 0.0
    foretold = foretell(locked, plain, plain)
    return plain, foretold, heldout(foretold, floor, seed), surely


def _status(names: tuple[str, ...], groups: tuple[tuple[str, ...], ...], suspicion: Suspicion) -> str:
    if suspicion.alarm:
        return "unexplained"
    if groups:
        return "ambiguous"
    return "explained" if names else "adequate"


def _trusted(search: Search, baseline: Baseline, fitted: Fit, doubtful: bool) -> Composite:
    """What is handed out: never a model that foretells plain readings of recordings left out worse than the
    baseline does.

    Named causes are taken as they were weighed, or as plain errors have them where those are worse. Beside an
    unknown cause (`doubtful`) the better one of both must do clearly better in nearly all recordings: names
    are symptoms then, and what they stand in for may be otherwise next time.
    """
    weights = plain_weights(search.presses)
    plain = rest(baseline.plain.model, search.presses, weights)
    before = cross_validate(plain, search.presses, weights, search.folds)
    found = [(fitted.model, scored(search, fitted))]
    if doubtful or found[0][1].gain_over(before) <= 0.0:
        even = settle(search, fitted.model, weights)
        found.append((even.model, cross_validate(even, search.presses, weights, search.folds)))
    model, score = max(found, key=lambda item: item[1].gain_over(before))
    needed = DOUBTFUL_GAIN if doubtful else 0.0
    lucky = doubtful and not agree(before.squares - score.squares, search.seed, DOUBTFUL_P)
    return plain.model if score.gain_over(before) <= needed or lucky else model


def _blindly_better(search: Search, plain: SensorModel, extended: SensorModel) -> bool:
    """Whether readings are foretold better when nobody says which frames were held, as for new recordings."""
    foretold = foretell(search.presses, plain, extended)
    before, after = (
        sum(float(np.mean((f.measured - values(f)) ** 2)) for f in foretold)
        for values in (lambda f: f.simulated, lambda f: f.extended)
    )
    return after < before
