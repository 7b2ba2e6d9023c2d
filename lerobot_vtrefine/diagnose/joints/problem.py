"""The joints' trials as the core's problem: every joint is a channel, and the commands' delay is shared."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from lerobot_vtrefine.diagnose.core.problem import OptionalSteps
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN, RESOLVED
from lerobot_vtrefine.diagnose.core.search import ALL, Selection
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion, confirmed
from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.candidates import CATALOGUE, PLAIN, told_by_load
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate
from lerobot_vtrefine.diagnose.joints.fitting import Fit, evaluate, fit, refit, servo_only
from lerobot_vtrefine.diagnose.joints.lags import in_place_of_delay, lags
from lerobot_vtrefine.diagnose.joints.newton import Refits, refits
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, SAG
from lerobot_vtrefine.diagnose.joints.rules import EXTRAPOLATION, LEAST_EFFECT_M, LEAST_EFFECT_RAD
from lerobot_vtrefine.diagnose.joints.servo_load import load_prefers
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.joints.suspicions import (
    not_repeating,
    suspicions,
)
from lerobot_vtrefine.diagnose.joints.timing import delay_starts, with_changing_delay

Array = np.ndarray
type Selected = Selection["JointProblem", Fit, Candidate]

_ITERATIONS = 12
"""Of the fit of a candidate, which starts from the fit without it."""


@dataclass(frozen=True)
class JointProblem(ServoTrials, OptionalSteps):
    """See `core.problem.Problem`."""

    delay_spread_s: float = 0.0
    """By how much the delay changes from command to command."""
    asks_lags: bool = True
    """Whether low-passes, and delays of single joints, are asked about."""

    @property
    def subject(self) -> str:
        """What is judged."""
        return "robot"

    @property
    def channels(self) -> tuple[str, ...]:
        """Joints' names."""
        return self.names

    @property
    def conditions(self) -> tuple[str, ...]:
        """(T,)"""
        return self.batch.conditions

    @property
    def files(self) -> tuple[str, ...]:
        """(T,)"""
        return self.batch.files

    def baseline(self) -> Fit:
        """Every joint's servo."""
        return fit(self, self.start(), servo_only(self))

    def candidates(self) -> tuple[Candidate, ...]:
        """The catalogue."""
        return CATALOGUE

    def applicable(self, candidate: Candidate, now: Fit) -> Array:
        """(J,) bool: joints on which these trials could show it, and which do not have it yet."""
        return candidate.possible(self) & ~candidate.clashes(now.free)

    def extended(self, now: Fit, candidate: Candidate, channels: Array, plainer: Fit | None = None) -> Fit:
        """A form that refines another starts from that one's fit."""
        if candidate.shared:
            return self._delayed(now, thorough=bool(channels.all()))
        index = np.flatnonzero(channels)
        if candidate.plain is not None and plainer is None:
            plainer = self.extended(now, replace(candidate, parameters=candidate.plain), channels)
        # Joints that it is not tried on rest, and so does the delay for now.
        free = candidate.freed(now.free, index) & channels[:, None]
        begin = now if plainer is None else self.merged(now, plainer, channels)
        starts = [candidate.starting(self, begin.point, index, multiple) for multiple in candidate.starts]
        best, *others = (fit(self, start, free, iterations=_ITERATIONS, known=now) for start in starts)
        for other in others:
            best = self.merged(best, other, other.total < best.total)
        best = self.merged(now, best, channels)
        if not now.tau_free or 2 * np.count_nonzero(channels) <= len(channels):
            return best
        # What most joints lack the delay may have made up for: they must be able to move it together.
        return fit(self, best.point, best.free, tau_free=True, iterations=_ITERATIONS)

    def _delayed(self, now: Fit, *, thorough: bool) -> Fit:
        starts = delay_starts(self)[: None if thorough else 1]
        points = [replace(now.point, tau_s=start) for start in starts]
        fits = [fit(self, point, now.free, tau_free=True, iterations=_ITERATIONS) for point in points]
        return min(fits, key=lambda item: float((item.total / now.total.clip(1e-300)).sum()))

    def reduced(self, now: Fit, candidates: Sequence[Candidate], channels: Array) -> Fit:
        """Without candidates on some joints, or without the delay."""
        if any(item.shared for item in candidates):
            return fit(self, replace(now.point, tau_s=0.0), now.free, iterations=_ITERATIONS)
        joints, point, free = np.flatnonzero(channels), now.point, now.free
        for candidate in candidates:
            point, free = candidate.removed(point, free, joints)
        return refit(self, now, point, free, joints, _ITERATIONS)

    def refitted(self, now: Fit) -> Fit:
        """Everything that is free, fitted anew."""
        return fit(self, now.point, now.free, now.tau_free, self.iterations)

    def merged(self, one: Fit, other: Fit, take_other: Array) -> Fit:
        """Joints of the one fit, those of the other where it says so; the delay is the one's."""
        theta = np.where(take_other[:, None], other.point.theta, one.point.theta)
        pairs = zip(one.point.forms, other.point.forms, take_other, strict=True)
        return Fit(
            point=replace(one.point, theta=theta, forms=tuple(b if take else a for a, b, take in pairs)),
            free=np.where(take_other[:, None], other.free, one.free),
            tau_free=one.tau_free,
            mse=np.where(take_other, other.mse, one.mse),
            residual=np.where(take_other, other.residual, one.residual),
        )

    def errors(self, fit: Fit) -> Array:
        """(T, J)"""
        return evaluate(self, fit.point, fit.free).mse

    def reweighted(self, fit: Fit, channels: Array | None = None) -> Refits:
        """By one Newton step."""
        return refits(self, fit, channels)

    def credible(self, baseline: Fit, now: Fit, best: Fit, candidate: Candidate) -> Array:
        """(J,) bool."""
        sliding = np.array([gravity.is_sliding(name) for name in self.names])
        least = np.maximum(
            np.where(sliding, LEAST_EFFECT_M, LEAST_EFFECT_RAD), RESOLVED * self.batch.resolution
        )
        own = np.maximum(self.misfit * np.sqrt(baseline.total), np.where(sliding, 0.1, 1) * self.floor)
        effect = np.sqrt(np.square(best.residual - now.residual).sum((0, 1)) / self.batch.valid.sum())
        # What a jaw does where it stops no form follows exactly: another cause there must explain more.
        stopped = now.free[:, INDEX["stop"]]
        explained = (now.mse - best.mse).mean(0) > LEAST_GAIN * baseline.total
        usual = (effect > np.maximum(least, own)) & (~stopped | explained)
        return usual if candidate.shared or candidate.clue else usual & self._plausible(baseline, best.point)

    def _plausible(self, baseline: Fit, point: Point) -> Array:
        """(J,) whether no cause is credited with many times the error that it is to explain.

        An offset and a sag, or a sag's own terms, may nearly cancel in the postures seen; their sizes then
        tell nothing.
        """
        left = np.abs(baseline.residual)[self.batch.valid]
        largest = np.quantile(left, 0.995, axis=0)
        sag = point.theta[:, [INDEX[name] for name in SAG]]
        several = np.count_nonzero(sag, axis=1) + (point.value("offset") != 0) > 1
        limit = np.where(several, *EXTRAPOLATION) * largest
        reach = [abs(gravity.full_reach(form, row)) for form, row in zip(point.forms, sag, strict=True)]
        return (np.array(reach) <= limit) & (np.abs(point.value("offset")) <= limit)

    def revised(self, now: Fit, accepted: Sequence[Candidate]) -> Self:
        """With gravity's shapes where the arm stands once it has sagged."""
        return self.bent(now.point) if any(item.form for item in accepted) else self

    def reviewed(
        self, selection: Selection[Any, Fit, Candidate], seed: int
    ) -> Selection[Any, Fit, Candidate]:
        """With a delay that changes from command to command, where there is a delay, or trials of one command
        differ so."""
        asked = ALL in selection.chosen or not_repeating(selection)
        return with_changing_delay(selection, seed) if asked else selection

    @property
    def can_settle(self) -> bool:
        """By measured loads."""
        return self.batch.load is not None

    def settles(
        self, rival: Rival[Fit, Candidate], selection: Selection[Any, Fit, Candidate], seed: int
    ) -> int:
        """Between what the servo pulls against, such as friction, and what takes no force, such as play."""
        if self.batch.load is None or not told_by_load(PLAIN[rival.cause], PLAIN[rival.name]):
            return 0
        return load_prefers(self, rival.fit, selection.fit, rival.channels[0], seed)

    def suspicions(self, selection: Selection[Any, Fit, Candidate], seed: int) -> list[Suspicion]:
        """See `joints.suspicions`; and `joints.lags` where a delay has a name, or anything is left."""
        found = suspicions(selection)
        asked = self.asks_lags and (ALL in selection.chosen or confirmed(found, seed))
        return [*found, *(lags(selection, seed) if asked else ())]

    def nameless_rivals(
        self, selection: Selection[Any, Fit, Candidate], seed: int
    ) -> list[Rival[Fit, Candidate]]:
        """A low-pass in the place of a delay; of one that changes from command to command it has nothing."""
        asked = self.asks_lags and ALL in selection.chosen and not self.delay_spread_s
        return in_place_of_delay(selection, seed) if asked else []
