"""Which causes act on which joints: forward by held-out evidence, then backward."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_vtrefine.diagnose.joints import flips
from lerobot_vtrefine.diagnose.joints.candidates import (
    DECOY,
    FRICTION,
    LATENCY,
    Candidate,
    candidates_for,
    delay_starts,
    resolution,
)
from lerobot_vtrefine.diagnose.joints.fitting import (
    INDEX,
    SAG,
    Fit,
    Problem,
    fit,
    refit,
    servo_only,
)
from lerobot_vtrefine.diagnose.joints.gravity import full_reach, is_sliding
from lerobot_vtrefine.diagnose.joints.newton import cross_validated, folds_of
from lerobot_vtrefine.diagnose.joints.tried import Tried, best_per_joint

Array = np.ndarray

LEAST_GAIN = 0.01
"""Smallest part of a joint's squared error that is worth a name."""
LEAST_EFFECT_RAD, LEAST_EFFECT_M = 1e-4, 1e-5
"""Smallest change of the prediction (root mean square) that is worth a name."""
LEAST_UNKNOWN = 0.02
"""Smallest part of the baseline's squared error for which something without a name is worth an alarm."""
MAX_ROUNDS = 4
_EXTRAPOLATION = (4.0, 8.0)
"""Largest size of a cause over the largest error seen: of several that may cancel, and of one alone."""


@dataclass(frozen=True)
class Selection:
    """What was accepted, and all that was tried."""

    problem: Problem
    baseline: Fit
    baseline_held_out: Array
    fit: Fit
    held_out: Array
    chosen: dict[int, tuple[Candidate, ...]]
    """Joint -> candidates accepted there."""
    delayed: bool
    p_values: dict[tuple[str, int], float]
    """(cause, joint) -> adjusted p when it was accepted; joint -1: the delay."""
    first_round: tuple[Tried, ...] = field(repr=False)
    """Every candidate alone on the baseline."""
    delay_spread_s: float = 0.0
    """By how much the delay changes from command to command."""

    def causes(self) -> dict[str, tuple[int, ...]]:
        """Named cause -> joints that it acts on."""
        out: dict[str, list[int]] = {}
        for joint, candidates in self.chosen.items():
            for candidate in candidates:
                out.setdefault(candidate.cause, []).append(joint)
        if self.delayed:
            out[LATENCY] = list(range(self.problem.batch.joints))
        return {name: tuple(sorted(joints)) for name, joints in out.items()}


class Selector:
    """State of one selection."""

    def __init__(self, problem: Problem, seed: int, progress: Callable[[str], None]) -> None:
        self.problem, self.seed, self.progress = problem, seed, progress
        self.folds = folds_of(problem.batch.conditions, seed)
        progress("robot: fitting every joint's servo")
        free = servo_only(problem)
        self.baseline = fit(problem, problem.start(), free)
        self.now = self.baseline
        self.held_out = cross_validated(problem, self.now, self.folds)
        self.baseline_held_out = self.held_out
        self.chosen: dict[int, tuple[Candidate, ...]] = {}
        self.delayed = False
        self.changed = np.ones(problem.batch.joints, dtype=bool)
        """Joints on which the last round accepted something: only there can the next one find more."""
        self.p_values: dict[tuple[str, int], float] = {}
        sliding = np.array([is_sliding(name) for name in problem.names])
        self.least_effect = np.maximum(
            np.where(sliding, LEAST_EFFECT_M, LEAST_EFFECT_RAD), 0.25 * resolution(problem)
        )
        own = np.maximum(
            problem.misfit * np.sqrt(self.baseline.total), np.where(sliding, 0.1, 1) * problem.floor
        )
        self.least_effect = np.maximum(self.least_effect, own)

    def run(self) -> Selection:
        """Forward rounds, then backward."""
        first: tuple[Tried, ...] = ()
        for number in range(MAX_ROUNDS):
            self.progress(f"robot: trying causes, round {number + 1}")
            tried = self.try_all(self.changed)
            first = first or tried
            if not self._accept(tried):
                break
        self.progress("robot: dropping what is not needed")
        self._prefer_single(first)
        self._drop_needless()
        return Selection(
            self.problem,
            self.baseline,
            self.baseline_held_out,
            self.now,
            self.held_out,
            self.chosen,
            self.delayed,
            self.p_values,
            first,
        )

    def try_all(self, joints: Array) -> tuple[Tried, ...]:
        """Every candidate on top of what is accepted, on some joints, with family-wise p."""
        tried: list[Tried] = []
        for candidate in candidates_for(self.problem):
            allowed = joints
            if candidate.cause == FRICTION:
                # Slow to simulate, and to first order the same as play: only where play helps at all.
                helped = [item.gain > LEAST_GAIN / 2 for item in tried if item.cause == "backlash"]
                allowed = np.any([np.zeros(self.problem.batch.joints), *helped], axis=0)
                allowed = allowed & joints
            known = next((one.fit for one in tried if _refines(candidate, one)), None)
            item = self.attempt(candidate, allowed, known)
            tried += [] if item is None else [item]
        if not self.delayed:
            tried.append(self._attempt_delay())
        return self._with_p(tried)

    def attempt(self, candidate: Candidate, joints: Array, plain: Fit | None = None) -> Tried | None:
        """Fit one candidate on those of the joints that allow it; None where none does.

        A form that refines another starts from that one's fit.
        """
        allowed = joints & candidate.applicable(self.problem) & ~candidate.clashes(self.now.free)
        index = np.flatnonzero(allowed)
        if not len(index):
            return None
        # Joints that it is not tried on rest, and so does the delay for now.
        free = candidate.freed(self.now.free, index) & allowed[:, None]
        begin = self.now if plain is None else merged(self.now, plain, allowed)
        starts = [candidate.starting(self.problem, begin.point, index, m) for m in candidate.starts]
        fits = [fit(self.problem, start, free, iterations=12, known=self.now) for start in starts]
        best = fits[0]
        for other in fits[1:]:
            better = other.total < best.total
            best = merged(best, other, better)
        # Joints that it is not tried on keep what they have.
        held_out = cross_validated(self.problem, best, self.folds, self.held_out)
        best = merged(self.now, best, allowed, free=np.where(allowed[:, None], free, self.now.free))
        return self._judged(candidate, best, allowed, held_out)

    def _attempt_delay(self) -> Tried:
        fits = []
        for start in delay_starts(self.problem)[: None if self.changed.all() else 1]:
            point = replace(self.now.point, tau_s=start)
            fits.append(fit(self.problem, point, self.now.free, tau_free=True, iterations=12))
        best = min(fits, key=lambda item: float((item.total / self.baseline.total.clip(1e-300)).sum()))
        held_out = cross_validated(self.problem, best, self.folds)
        return self._judged(None, best, np.ones(self.problem.batch.joints, dtype=bool), held_out)

    def _judged(self, candidate: Candidate | None, best: Fit, allowed: Array, held_out: Array) -> Tried:
        change = np.where(allowed, self.held_out - held_out, 0.0)
        improvement = change / np.maximum(self.held_out + held_out, 1e-300)
        before = self.held_out.mean(0)
        gain = change.mean(0) / np.maximum(before, 1e-300)
        valid = self.problem.batch.valid.sum()
        effect = np.sqrt(np.square(best.residual - self.now.residual).sum((0, 1)) / valid)
        eligible = allowed & (gain > LEAST_GAIN) & (effect > self.least_effect)
        # What a jaw does where it stops no form follows exactly: another cause there must explain more.
        stopped = self.now.free[:, INDEX["stop"]]
        eligible &= ~stopped | (change.mean(0) > LEAST_GAIN * self.baseline_held_out.mean(0))
        if candidate is not None:
            eligible &= self._plausible(best, candidate)
        if candidate is not None and candidate.cause == DECOY:
            eligible &= effect**2 > LEAST_UNKNOWN * self.baseline.total
        return Tried(candidate, best, held_out, improvement, gain, eligible)

    def _plausible(self, best: Fit, candidate: Candidate) -> Array:
        """(J,) whether no cause is credited with many times the error that it is to explain.

        An offset and a sag, or a sag's own terms, may nearly cancel in the postures seen; their sizes then
        tell nothing.
        """
        left = np.abs(self.baseline.residual)[self.problem.batch.valid]
        largest = np.quantile(left, 0.995, axis=0)
        sag = best.point.theta[:, [INDEX[name] for name in SAG]]
        several = np.count_nonzero(sag, axis=1) + (best.point.value("offset") != 0) > 1
        limit = np.where(several, *_EXTRAPOLATION) * largest
        reach = [abs(full_reach(form, row)) for form, row in zip(best.point.forms, sag, strict=True)]
        if candidate.cause == DECOY:
            return np.ones(len(limit), dtype=bool)
        return (np.array(reach) <= limit) & (np.abs(best.point.value("offset")) <= limit)

    def _with_p(self, tried: list[Tried]) -> tuple[Tried, ...]:
        """Adjusted over all candidates and joints; the delay is one hypothesis about all joints together."""
        columns = [
            item.improvement if item.candidate else item.improvement.mean(1, keepdims=True) for item in tried
        ]
        alone, adjusted = flips.one_sided(np.concatenate(columns, 1), self.seed)
        out, place = [], 0
        for item, column in zip(tried, columns, strict=True):
            part = slice(place, place + column.shape[1])
            place = part.stop
            out.append(
                replace(
                    item,
                    p_alone=np.broadcast_to(alone[part], item.gain.shape),
                    p_adjusted=np.broadcast_to(adjusted[part], item.gain.shape),
                )
            )
        return tuple(out)

    def _accept(self, tried: tuple[Tried, ...]) -> bool:
        """Accept the delay if it explains more than the joints' own causes, else those; False if nothing."""
        best = best_per_joint(tried, self.held_out, self.seed)
        delay = next((item for item in tried if item.candidate is None), None)
        before = np.log(self.held_out.mean(0).clip(1e-300))
        if delay is not None and delay.accepted.any():
            by_delay = (before - np.log(delay.held_out.mean(0).clip(1e-300))).sum()
            own = sum(
                before[joint] - np.log(item.held_out.mean(0)[joint].clip(1e-300))
                for joint, item in best.items()
            )
            if by_delay > own:
                self._take(delay, np.arange(self.problem.batch.joints))
                self.changed = np.ones_like(self.changed)
                return True
        self.changed = np.isin(np.arange(len(self.changed)), list(best))
        for joint, item in best.items():
            self._take(item, np.array([joint]))
        if any(item.cause == "gravity_sag" for item in best.values()):
            self.problem = self.problem.bent(self.now.point)
        if best:
            self._refit()
        return bool(best)

    def _take(self, item: Tried, joints: Array) -> None:
        mask = np.zeros(self.problem.batch.joints, dtype=bool)
        mask[joints] = True
        assert item.p_adjusted is not None
        if item.candidate is None:
            self.now, self.held_out, self.delayed = item.fit, item.held_out, True
            self.p_values[LATENCY, -1] = float(item.p_adjusted.min())
            return
        self.now = merged(
            self.now, item.fit, mask, free=np.where(mask[:, None], item.fit.free, self.now.free)
        )
        self.held_out = np.where(mask, item.held_out, self.held_out)
        for joint in joints:
            self.chosen[int(joint)] = (*self.chosen.get(int(joint), ()), item.candidate)
            self.p_values[item.cause, int(joint)] = float(item.p_adjusted[joint])

    def _refit(self) -> None:
        self.now = fit(self.problem, self.now.point, self.now.free, self.delayed)
        self.held_out = cross_validated(self.problem, self.now, self.folds)

    def _prefer_single(self, first: tuple[Tried, ...]) -> None:
        """Where one cause alone does as well as several, it is the one."""
        changed = False
        for joint, several in list(self.chosen.items()):
            if len(several) < 2 or self.delayed:
                continue
            singles = [item for item in first if item.candidate and item.accepted[joint]]
            singles = [item for item in singles if item.cause != DECOY]
            if not singles:
                continue
            one = min(singles, key=lambda item: item.held_out.mean(0)[joint])
            if one.held_out.mean(0)[joint] <= 1.02 * self.held_out.mean(0)[joint]:
                self._replace(joint, one)
                changed = True
        if changed:
            self._refit()

    def _replace(self, joint: int, item: Tried) -> None:
        for candidate in self.chosen[joint]:
            self.p_values.pop((candidate.cause, joint), None)
        mask = np.zeros(self.problem.batch.joints, dtype=bool)
        mask[joint] = True
        self.chosen[joint] = ()
        self._take(item, np.array([joint]))

    def _drop_needless(self) -> None:
        """Take away what costs less than `LEAST_GAIN` of a joint's held-out error, one at a time."""
        for joint in list(self.chosen):
            for candidate in list(self.chosen[joint]):
                if self.loss_without(candidate, joint) < LEAST_GAIN:
                    self._remove(candidate, joint)
        if self.delayed and self.loss_without_delay() < LEAST_GAIN:
            self._remove_delay()
        elif self.delayed:
            self._refit()

    def without(self, candidate: Candidate, joint: int) -> tuple[Fit, Array]:
        """Refit and held-out error with one candidate taken from one joint."""
        free = self.now.free.copy()
        point = self.now.point
        for name in candidate.parameters:
            free[joint, INDEX[name]] = False
            point = point.with_values(name, 0.0, np.array([joint]))
        joints = np.array([joint])
        fitted = refit(self.problem, self.now, point, free, joints, iterations=8)
        return fitted, cross_validated(self.problem, fitted, self.folds, self.held_out, joints)

    def loss_without(self, candidate: Candidate, joint: int) -> float:
        """Part of the joint's held-out error that comes back."""
        _, held_out = self.without(candidate, joint)
        return float(1 - self.held_out.mean(0)[joint] / max(held_out.mean(0)[joint], 1e-300))

    def loss_without_delay(self) -> float:
        """The same for the delay, averaged over joints."""
        _, held_out = self._without_delay()
        # Ratios are averaged as logarithms: one joint whose cross-validation runs away decides nothing.
        now, then = (np.log(errors.mean(0).clip(1e-300)) for errors in (self.held_out, held_out))
        return float(1 - np.exp((now - then).mean()))

    def _without_delay(self) -> tuple[Fit, Array]:
        fitted = fit(self.problem, replace(self.now.point, tau_s=0.0), self.now.free, iterations=8)
        return fitted, cross_validated(self.problem, fitted, self.folds)

    def _remove(self, candidate: Candidate, joint: int) -> None:
        self.now, self.held_out = self.without(candidate, joint)
        self.chosen[joint] = tuple(item for item in self.chosen[joint] if item != candidate)
        self.p_values.pop((candidate.cause, joint), None)
        if not self.chosen[joint]:
            del self.chosen[joint]

    def _remove_delay(self) -> None:
        self.now, self.held_out = self._without_delay()
        self.delayed = False
        self.p_values.pop((LATENCY, -1), None)


def _refines(candidate: Candidate, item: Tried) -> bool:
    """Whether a candidate refines the form that was tried."""
    if candidate.plain is None or item.candidate is None:
        return False
    return item.cause == candidate.cause and item.candidate.parameters == candidate.plain


def merged(one: Fit, other: Fit, take_other: Array, free: Array | None = None) -> Fit:
    """Joints of the one fit, except where those of the other are taken."""
    theta = np.where(take_other[:, None], other.point.theta, one.point.theta)
    forms = tuple(
        b if take else a for a, b, take in zip(one.point.forms, other.point.forms, take_other, strict=True)
    )
    return Fit(
        point=replace(one.point, theta=theta, forms=forms),
        free=other.free if free is None else free,
        tau_free=one.tau_free,
        mse=np.where(take_other, other.mse, one.mse),
        residual=np.where(take_other, other.residual, one.residual),
    )
