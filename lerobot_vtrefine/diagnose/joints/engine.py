"""The diagnosis of a robot: its trials in, verdict, models and evidence out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.evidence import Evidence, ResidualView, Trace, TrialError
from lerobot_vtrefine.diagnose.locking import lock
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.joints import experiments, views
from lerobot_vtrefine.diagnose.joints.alarms import Alarm, not_repeating, raise_alarms
from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.candidates import DECOY, LATENCY
from lerobot_vtrefine.diagnose.joints.conversion import to_model
from lerobot_vtrefine.diagnose.joints.detectable import minimum_detectable
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, repeatability
from lerobot_vtrefine.diagnose.joints.fitting import INDEX, Point, Problem, fit
from lerobot_vtrefine.diagnose.joints.model import RobotModel
from lerobot_vtrefine.diagnose.joints.rivals import Rival, adopt, find_rivals, settle_by_load, without_cause
from lerobot_vtrefine.diagnose.joints.selection import Selection, Selector, Tried
from lerobot_vtrefine.diagnose.joints.timing import with_changing_delay
from lerobot_vtrefine.diagnose.verdict import (
    ROBOT_CAUSES,
    Cause,
    DataIssue,
    Heldout,
    Parameter,
    Role,
    Status,
    Unknown,
)

Array = np.ndarray
Progress = Callable[[str, float], None]

_DRAWS = 2000
_CLUES = 4
_SHARED = (
    "readings stand at no constant distance from where the servos should bring them; an offset that servo "
    "and reading share moves both alike, whatever its size: to see it, bring the hand to places that are "
    "known from outside (a gauge block, a calibrated camera) in eight postures"
)
_SETTLING = 5
"""Iterations of a refit that begins next to its end."""


@dataclass(frozen=True)
class RobotDiagnosis:
    """As `evidence.Diagnosis`; ``joint_gains`` holds the held-out gain of every joint besides."""

    status: Status
    causes: tuple[Cause, ...]
    ambiguous_with: tuple[tuple[str, ...], ...]
    unknown: Unknown
    heldout: Heldout | None
    minimum_detectable: Mapping[str, float]
    next_experiment: Mapping[str, Any] | None
    baseline_model: RobotModel
    extended_model: RobotModel
    baseline_params: Mapping[str, Parameter]
    evidence: tuple[Evidence, ...]
    traces: tuple[Trace, ...]
    residuals: tuple[ResidualView, ...]
    trial_errors: tuple[TrialError, ...]
    joint_gains: Mapping[str, float]
    alarms: tuple[Alarm, ...]
    issues: tuple[DataIssue, ...] = ()
    maps: Mapping[str, Array] = field(default_factory=dict)
    unit: str = "rad"


def diagnose_robot(
    recordings: RecordingSet, seed: int = 0, progress: Progress | None = None
) -> RobotDiagnosis:
    """Find what the servo model gets wrong about a robot, name it, and measure what naming it gains.

    Args:
        recordings: a set of kind "robot" after quality control, or episodes of a dataset.
        seed: of the locked trials, folds, sign flips and resampling.
        progress: told what is being done and the fraction done.

    Raises:
        ValueError: a trial with commands or times that are not finite.
    """
    whole = Problem.of(recordings.joints, make_batch(recordings.trials))
    return diagnose_problem(whole, seed, progress)


def diagnose_problem(whole: Problem, seed: int = 0, progress: Progress | None = None) -> RobotDiagnosis:
    """The same for a problem that is posed already."""
    tell = progress or (lambda text, done: None)
    count = len(whole.batch.conditions)
    locked = lock(whole.batch.conditions, seed)
    problem = whole.subset(np.array([index for index in range(count) if index not in set(locked)]))
    selection = Selector(problem, seed, _steps(tell)).run()
    whole = whole.bent(selection.fit.point)
    if not_repeating(selection):
        selection = with_changing_delay(selection, seed)
    tell("robot: looking for what is left", 0.6)
    alarms = raise_alarms(selection, seed)
    rivals: tuple[Rival, ...] = ()
    # Ties do not matter where something else is wrong, unless loads may settle them.
    if not alarms or problem.batch.load is not None:
        tell("robot: looking for other explanations", 0.7)
        selection, rivals = _settled(selection, seed)
        alarms = raise_alarms(selection, seed)
    tell("robot: settling the sizes", 0.8)
    selection, whole = _settled_finely(_named_only(selection), whole)
    tell("robot: intervals, and what could have been seen", 0.85)
    return _report(selection, rivals, alarms, whole, np.array(locked, dtype=int), seed)


def _settled_finely(selection: Selection, whole: Problem) -> tuple[Selection, Problem]:
    """What was chosen, refitted to better predictions where there are any; what was tried stays as it was."""
    problem, everything = selection.problem.finer(), whole.finer()
    if problem is None or everything is None:
        return selection, whole
    baseline, now = selection.baseline, selection.fit
    again = fit(problem, baseline.point, baseline.free, iterations=_SETTLING)
    fitted = fit(problem, now.point, now.free, now.tau_free, iterations=_SETTLING)
    return replace(selection, problem=problem, baseline=again, fit=fitted), everything


def _steps(tell: Progress) -> Callable[[str], None]:
    """The selection's rounds as fractions of the whole."""
    count = 0

    def step(text: str) -> None:
        nonlocal count
        tell(text, min(0.1 * count, 0.55))
        count += 1

    return step


def _settled(selection: Selection, seed: int) -> tuple[Selection, tuple[Rival, ...]]:
    """Ties, after loads have settled those that they can."""
    rivals = find_rivals(selection, seed)
    winners, left = settle_by_load(selection, rivals, seed)
    for winner in winners:
        selection = adopt(selection, winner)
        left = [item for item in left if item.cause != winner.cause or item.joints != winner.joints]
    return selection, tuple(left)


def _named_only(selection: Selection) -> Selection:
    """Without decoys: the model that is handed out holds only what it can name."""
    free, point, chosen = selection.fit.free.copy(), selection.fit.point, dict(selection.chosen)
    found = False
    for joint, candidates in selection.chosen.items():
        for candidate in candidates:
            if candidate.cause != DECOY:
                continue
            found = True
            for name in candidate.parameters:
                free[joint, INDEX[name]] = False
                point = point.with_values(name, 0.0, np.array([joint]))
            point = replace(point, forms=_with_form(point, joint))
        chosen[joint] = tuple(item for item in candidates if item.cause != DECOY)
    if not found:
        return selection
    fitted = fit(selection.problem, point, free, selection.delayed)
    return replace(selection, fit=fitted, chosen={j: c for j, c in chosen.items() if c})


def _with_form(point: Point, joint: int) -> tuple[str, ...]:
    """Forms with a joint's set to one that a model file can hold."""
    return tuple("mass" if index == joint else form for index, form in enumerate(point.forms))


def _report(
    selection: Selection,
    rivals: tuple[Rival, ...],
    alarms: tuple[Alarm, ...],
    whole: Problem,
    locked: Array,
    seed: int,
) -> RobotDiagnosis:
    names = selection.problem.names
    estimates = Estimates(selection, seed)
    baseline, extended = (to_model(names, item.point) for item in (selection.baseline, selection.fit))
    test = whole.subset(locked) if len(locked) else selection.problem
    simulated, predicted = test.predict(selection.baseline.point), test.predict(selection.fit.point)
    errors = [_mse(test, item) for item in (simulated, predicted)]
    role: Role = "symptom" if alarms else "cause"
    causes = tuple(
        Cause(
            name, role, estimates.of(name, joints), _p(selection, name), _gain(selection, test, name, joints)
        )
        for name, joints in selection.causes().items()
    )
    detectable = minimum_detectable(selection)
    ambiguous = () if alarms else _pairs(rivals)
    status = _status(causes, ambiguous, alarms)
    return RobotDiagnosis(
        status=status,
        causes=causes,
        ambiguous_with=ambiguous,
        unknown=_unknown(selection, alarms),
        heldout=_heldout(selection, test, errors, bool(len(locked)), seed),
        minimum_detectable=detectable,
        next_experiment=_next(selection, rivals, alarms, detectable),
        baseline_model=baseline,
        extended_model=extended,
        baseline_params=estimates.baseline(selection.baseline.point.theta),
        evidence=_evidence(selection, rivals, bool(alarms)),
        traces=views.traces(test.batch, names, simulated, predicted),
        residuals=views.residual_views(test.batch, simulated, predicted, seed),
        trial_errors=views.trial_errors(test.batch, errors[0].mean(1), errors[1].mean(1)),
        joint_gains=_joint_gains(names, *errors),
        alarms=alarms,
    )


def _pairs(rivals: tuple[Rival, ...]) -> tuple[tuple[str, ...], ...]:
    """Names that tie, every pair once."""
    pairs = {frozenset((item.cause, item.rival)): (item.cause, item.rival) for item in reversed(rivals)}
    return tuple(reversed(pairs.values()))


def _status(
    causes: tuple[Cause, ...], ambiguous: tuple[tuple[str, ...], ...], alarms: tuple[Alarm, ...]
) -> Status:
    if alarms:
        return "unexplained"
    if ambiguous:
        return "ambiguous"
    return "explained" if causes else "adequate"


def _mse(problem: Problem, prediction: Array) -> Array:
    """(T, J)"""
    left = problem.residual(prediction)
    return np.square(left).sum(0) / np.maximum(problem.batch.frames, 1)[:, None]


def _gain(selection: Selection, test: Problem, cause: str, joints: tuple[int, ...]) -> float:
    """What the cause's removal loses, everything else refitted."""
    bare = without_cause(selection, cause, np.array(joints))
    without, now = (_mse(test, test.predict(item.point)).mean() for item in (bare, selection.fit))
    return float(1 - now / max(without, 1e-300))


def _joint_gains(names: tuple[str, ...], before: Array, after: Array) -> dict[str, float]:
    gain = 1 - after.mean(0) / before.mean(0).clip(1e-300)
    return {name: float(value) for name, value in zip(names, gain, strict=True)}


def _p(selection: Selection, cause: str) -> float | None:
    found = [p for (name, _), p in selection.p_values.items() if name == cause]
    return min(found) if found else None


def _heldout(
    selection: Selection, test: Problem, errors: list[Array], locked: bool, seed: int
) -> Heldout | None:
    if not locked:
        return None
    before, after = (error.mean(1) for error in errors)
    draws = np.random.default_rng(seed).integers(0, len(before), (_DRAWS, len(before)))
    drawn = 1 - after[draws].sum(1) / before[draws].sum(1).clip(1e-300)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return Heldout(
        metric="rmse",
        baseline=float(np.sqrt(before.mean())),
        extended=float(np.sqrt(after.mean())),
        noise_floor=repeatability(selection.problem, selection.fit.residual),
        gain=float(1 - after.mean() / max(before.mean(), 1e-300)),
        gain_ci95=(float(low), float(high)),
        trials=test.batch.files,
    )


def _unknown(selection: Selection, alarms: tuple[Alarm, ...]) -> Unknown:
    if not alarms:
        return Unknown(alarm=False)
    told: dict[str, list[str]] = {}
    heard: set[int] = set()
    for alarm in alarms:
        if alarm.joint not in heard:
            told.setdefault(alarm.clue, []).append(selection.problem.names[alarm.joint])
        heard.add(alarm.joint)
    clues = [f"{', '.join(names)}: {clue}" for clue, names in told.items()]
    more = "" if len(clues) <= _CLUES else f"; and {len(clues) - _CLUES} more"
    return Unknown(True, "; ".join(clues[:_CLUES]) + more)


def _next(
    selection: Selection, rivals: tuple[Rival, ...], alarms: tuple[Alarm, ...], detectable: dict[str, float]
) -> dict[str, Any] | None:
    if alarms:
        return experiments.for_alarm(selection, alarms[0])
    if rivals:
        return experiments.for_rivals(selection, rivals)
    return None if selection.causes() else experiments.for_little_data(selection, detectable)


def _evidence(selection: Selection, rivals: tuple[Rival, ...], alarmed: bool) -> tuple[Evidence, ...]:
    """Every name of the catalogue, by its best form and joint."""
    accepted = selection.causes()
    ties = {item.rival: item for item in rivals}
    out = []
    for name in (*ROBOT_CAUSES, DECOY):
        tried = [item for item in selection.first_round if item.cause == name]
        label = name if name != DECOY else "(no name)"
        if not tried:
            out.append(Evidence(label, None, None, None, "not identifiable", _why_not(name)))
            continue
        p_value, adjusted, gain, where = _strongest(selection, tried)
        if name in accepted:
            decision = "symptom" if alarmed else "accepted"
            reason = f"on {_joined(selection, accepted[name])}{_caveat(selection, name, accepted[name])}"
        elif name in ties:
            decision = "tie"
            reason = f"explains {ties[name].cause} on {_joined(selection, ties[name].joints)} as well"
        elif name == "encoder_offset" and selection.problem.shared_encoders:
            decision, reason = "not identifiable", _SHARED
        else:
            decision, reason = (
                "rejected",
                f"strongest on {where}; in such trials chance gives as much, or it is under 1 % of error",
            )
            if adjusted < 0.02:
                reason = f"significant on {where} by itself, but another cause explains it better"
        out.append(Evidence(label, p_value, adjusted, gain, decision, reason))
    return tuple(out)


def _caveat(selection: Selection, name: str, joints: tuple[int, ...]) -> str:
    """What an accepted cause leaves open."""
    if name == LATENCY and selection.delay_spread_s:
        return f", which changes from command to command by about {1e3 * selection.delay_spread_s:.0f} ms"
    if name != "gripper_compliance" or selection.fit.free[list(joints), INDEX["bend"]].any():
        return ""
    return (
        ": it stops at one opening whatever is commanded; whether a part or the gripper's own end stops it, "
        "and how hard it presses, only the column load or pads can tell"
    )


def _strongest(selection: Selection, tried: list[Tried]) -> tuple[float, float, float, str]:
    item = max(tried, key=lambda one: float(one.gain.max()))
    joint = int(item.gain.argmax())
    assert item.p_alone is not None
    assert item.p_adjusted is not None
    where = "all joints" if item.candidate is None else selection.problem.names[joint]
    return float(item.p_alone[joint]), float(item.p_adjusted[joint]), float(item.gain[joint]), where


def _why_not(name: str) -> str:
    if name == "gripper_compliance":
        return "needs the column load on a gripper"
    if name == "gravity_sag":
        return "no joint here is loaded by gravity as far as its name tells"
    return "no joint shows enough for it to matter" if name == "joint_friction" else "no joint moves"


def _joined(selection: Selection, joints: tuple[int, ...]) -> str:
    if len(joints) == len(selection.problem.names):
        return "all joints"
    return ", ".join(selection.problem.names[joint] for joint in joints)
