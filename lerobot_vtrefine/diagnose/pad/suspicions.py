"""Whether structure is left that no named cause accounts for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.alarms import (
    Alarm,
    Correlations,
    cleaned,
    condition_alarm,
    left_over,
    level_alarm,
    line_alarm,
    only_misfit,
    pair_alarm,
    pairs_alarm,
    replicate_alarm,
)
from lerobot_vtrefine.diagnose.pad.baseline import weigh
from lerobot_vtrefine.diagnose.pad.descriptors import DESCRIPTORS, Descriptor
from lerobot_vtrefine.diagnose.pad.fitting import Fit, tangents
from lerobot_vtrefine.diagnose.pad.gain_drift import course_alarm
from lerobot_vtrefine.diagnose.pad.local_errors import beside_alarm, taxel_alarm
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.score_test import Probe, Scorer, screen
from lerobot_vtrefine.diagnose.pad.search import Search
from lerobot_vtrefine.diagnose.pad.sliding import sliding_alarm

DESCRIPTOR_P = 0.01
DESCRIPTOR_SHARE = 0.02
"""Part of the squared error that a descriptor must take away on recordings left out."""
OWNED_SHARE = 0.1
"""Part that no form of a family leaves to the descriptors of its own kind of effect."""
RIDGE = 1e-9
NO_MISFIT = ("spectrum", "level", "sliding", "gain course")
"""Alarms that the form of no named cause has raised: a line, errors far above noise, what only sliding does
and what changes through the session."""


@dataclass(frozen=True)
class Suspicion:
    """All alarms, whether any means an unknown cause, and the clue it gives."""

    alarms: tuple[Alarm, ...]
    alarm: bool
    clue: str | None


@dataclass(frozen=True)
class Found:
    """A descriptor that matters: adjusted p-value, part of the cross-validated squared error."""

    descriptor: Descriptor
    p_adjusted: float
    share: float


def look_for_unknowns(search: Search, fitted: Fit, baseline: Fit) -> Suspicion:
    """Run the alarms on the extended model's residuals; what names' forms leave of their own is none."""
    _, weights = weigh(fitted, search.presses)
    residuals = cleaned(fitted, search.presses, weights)
    generic = describe_residual(search, fitted)
    families = set(fitted.model.families)
    strangers = [
        item for item in generic if item.share > OWNED_SHARE or not families & set(item.descriptor.owners)
    ]
    alarms = [replicate_alarm(search.presses, residuals, search.seed), line_alarm(search.presses, residuals)]
    pairs = Correlations.of(search.presses, residuals)
    if pairs is not None:
        alarms.append(pair_alarm(search.presses, residuals, pairs))
        left = left_over(search.presses, baseline.residuals(search.presses), residuals) if families else None
        alarms.append(pairs_alarm(search.presses, residuals, pairs, left))
    alarms.append(level_alarm(residuals, fitted, weights))
    alarms.append(condition_alarm(search.presses, residuals, fitted, weights))
    alarms.append(sliding_alarm(search.presses, residuals, fitted, weights))
    alarms.append(beside_alarm(search.presses, residuals, fitted, weights))
    alarms.append(taxel_alarm(search.presses, residuals, weights))
    alarms.append(course_alarm(fitted, search.presses, weights))
    alarms.append(_descriptor_alarm(strangers, generic))
    known = tuple(alarm for alarm in alarms if alarm is not None)
    fired = [alarm for alarm in known if alarm.fired]
    before, after = (model.residuals(search.presses) for model in (baseline, fitted))
    if fired and families and only_misfit(search.presses, before, after):
        # Of what does not repeat, or changes through the session, repeatable errors say nothing.
        changing = any(item.descriptor.session for item in strangers)
        kept = (*NO_MISFIT, "descriptors") if changing else NO_MISFIT
        fired = [alarm for alarm in fired if alarm.name in kept]
        known = tuple(alarm if alarm in fired else replace(alarm, fired=False) for alarm in known)
    clues = [alarm.clue for alarm in reversed(fired)]
    if fired and generic and not strangers:
        clues.append(f"the residual correlates with {generic[0].descriptor.text}")
    return Suspicion(known, bool(fired), "; ".join(clues) or None)


def _descriptor_alarm(strangers: Sequence[Found], generic: Sequence[Found]) -> Alarm:
    if strangers:
        best = strangers[0]
        text = f"the residual correlates with {best.descriptor.text} ({100 * best.share:.0f} % of its power)"
        return Alarm("descriptors", True, best.share, best.p_adjusted, text)
    share, p_value = (generic[0].share, generic[0].p_adjusted) if generic else (0.0, None)
    return Alarm("descriptors", False, share, p_value, "no stranger to the named causes")


def describe_residual(search: Search, fitted: Fit) -> list[Found]:
    """Descriptors that matter beside the model, the one that takes away most first."""
    presses, weights = search.presses, search.weights
    _, columns = tangents(fitted.model, presses, fitted.model.free)
    scorer = Scorer(fitted, presses, weights, columns)
    probes, kept = [], []
    for descriptor in DESCRIPTORS:
        change = _directions(descriptor, presses, fitted)
        if change is None:
            continue
        scores, information = scorer.score(change)
        if information.sum() <= RIDGE * max(float((scores**2).sum()), 1.0):
            continue
        probes.append(Probe(descriptor.text, None, np.ones(1), scores, information, False))
        kept.append((descriptor, change))
    screened = screen(probes, len(weights), search.seed)
    found = []
    for descriptor, change in kept:
        p_adjusted = screened[descriptor.text].p_adjusted
        if p_adjusted is not None and p_adjusted <= DESCRIPTOR_P:
            share = left_out_share(fitted, presses, columns, change, search.folds)
            if share > DESCRIPTOR_SHARE:
                found.append(Found(descriptor, p_adjusted, share))
    return sorted(found, key=lambda item: -item.share)


def _directions(descriptor: Descriptor, presses: PressSet, fitted: Fit) -> list[np.ndarray] | None:
    """The descriptor's direction in every recording, of unit mean square; None where it says nothing."""
    pairs = zip(presses.presses, fitted.signals, strict=True)
    raw = [np.array(descriptor.direction(press, signal), dtype=float) for press, signal in pairs]
    power = float(np.mean([np.mean(image**2) for image in raw]))
    if not np.isfinite(power) or power <= 1e-30:
        return None
    return [image / np.sqrt(power) for image in raw]


def left_out_share(
    fitted: Fit,
    presses: PressSet,
    columns: Sequence[Sequence[np.ndarray]],
    change: Sequence[np.ndarray],
    folds: Sequence[Sequence[int]],
) -> float:
    """Part of the squared error of recordings left out that the change takes away, in plain counts.

    Coefficients of the change and of the model's own tangents come from the other recordings.
    """
    grams = []
    for k, (press, signal) in enumerate(zip(presses.presses, fitted.signals, strict=True)):
        vectors = [column[k].ravel() for column in columns]
        vectors += [change[k].ravel(), (press.signal - signal).ravel()]
        matrix = np.stack(vectors, axis=1) / np.sqrt(signal.size)
        grams.append(matrix.T @ matrix)
    every = np.array(grams)
    before, after = 0.0, 0.0
    for fold in folds:
        rest = every.sum(axis=0) - every[list(fold)].sum(axis=0)
        part = every[list(fold)].sum(axis=0)
        before += _error(part, _coefficients(rest, list(range(len(rest) - 2))))
        after += _error(part, _coefficients(rest, list(range(len(rest) - 1))))
    return 1.0 - after / before if before > 0 else 0.0


def _coefficients(gram: np.ndarray, use: list[int]) -> np.ndarray:
    result = np.zeros(len(gram) - 1)
    scale = np.sqrt(np.diag(gram)[use].clip(min=1e-30))
    block = gram[np.ix_(use, use)] / np.outer(scale, scale)
    result[use] = np.linalg.lstsq(block, gram[use, -1] / scale, rcond=1e-9)[0] / scale
    return result


def _error(gram: np.ndarray, coefficients: np.ndarray) -> float:
    return float(
        gram[-1, -1] - 2.0 * gram[:-1, -1] @ coefficients + coefficients @ gram[:-1, :-1] @ coefficients
    )
