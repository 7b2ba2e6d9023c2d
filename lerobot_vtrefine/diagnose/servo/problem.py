"""A servo's trials as the core's problem: one channel, the position of the shaft."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from lerobot_vtrefine.diagnose.core.problem import OptionalSteps
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.rules import RESOLVED
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate
from lerobot_vtrefine.diagnose.servo.fitting import Fit, Fitter, Refits
from lerobot_vtrefine.diagnose.servo.parameters import INDEX
from lerobot_vtrefine.diagnose.servo.rules import MIN_SETTINGS
from lerobot_vtrefine.diagnose.servo.suspicions import repeated, repeating

Array = np.ndarray

COARSE_STEP_S = 0.01
"""Between the frames that a search needs."""


class ServoProblem(OptionalSteps):
    """See `core.problem.Problem`."""

    subject = "servo"
    channels = ("position",)

    def __init__(self, bench: Bench, fine: Bench | None = None) -> None:
        self.bench, self.fine = bench, fine
        self.fitter = Fitter(bench)
        self.conditions = bench.settings if len(set(bench.settings)) >= MIN_SETTINGS else bench.recorded
        self.files = bench.files

    @classmethod
    def of(cls, bench: Bench) -> Self:
        """With fewer frames for the search where there are many."""
        coarse = bench.thinned(COARSE_STEP_S)
        return cls(coarse, bench) if len(coarse.time_s) < len(bench.time_s) else cls(bench)

    def finer(self) -> Self | None:
        """The same with all frames."""
        return None if self.fine is None else type(self)(self.fine)

    def subset(self, trials: Array) -> Self:
        """The problem of these trials alone."""
        fine = None if self.fine is None else self.fine.subset(trials)
        return type(self)(self.bench.subset(trials), fine)

    def baseline(self) -> Fit:
        """Motor, Coulomb and viscous friction."""
        return self.fitter.baseline()

    def candidates(self) -> Sequence[Candidate]:
        """The catalogue."""
        return CATALOGUE

    def applicable(self, candidate: Candidate, now: Fit) -> Array:
        """(1,) whether these trials could show it, and it is not free yet."""
        return np.array([candidate.possible(self.bench) and not now.free[_places(candidate)].any()])

    def extended(self, now: Fit, candidate: Candidate, channels: Array, plainer: Fit | None = None) -> Fit:
        """With the candidate's parameters, too, from the best of its starts."""
        places, free = _places(candidate), now.free.copy()
        free[places] = True
        own = [[item.get(name, 1.0) for name in candidate.parameters] for item in candidate.starts]
        theta = np.repeat(now.theta[None], len(own), 0)
        theta[:, places] = self.fitter.start[places] * np.array(own)
        return self.fitter.fit(theta, free)

    def reduced(self, now: Fit, candidates: Sequence[Candidate], channels: Array) -> Fit:
        """Without the candidates' parameters."""
        free = now.free.copy()
        for candidate in candidates:
            free[_places(candidate)] = False
        return self.fitter.fit(now.theta[None], free)

    def refitted(self, now: Fit) -> Fit:
        """Everything that is free, fitted anew."""
        return self.fitter.fit(now.theta[None], now.free)

    def merged(self, one: Fit, other: Fit, take_other: Array) -> Fit:
        """One of the fits as a whole, for there is one channel."""
        return other if take_other[0] else one

    def errors(self, fit: Fit) -> Array:
        """(T, 1)"""
        return self.fitter.evaluate(fit.theta, fit.free).mse

    def reweighted(self, fit: Fit, channels: Array | None = None) -> Refits:
        """Fits under other weights of the trials, by one Newton step."""
        return Refits(self.bench, fit)

    def suspicions(self, selection: Selection[Any, Fit, Candidate], seed: int) -> list[Suspicion]:
        """See `servo.suspicions`; with all frames, for between fewer the simulation's steps leave as much."""
        if not repeated(self.bench):
            return []
        fine = self.finer() or self
        left = fine.refitted(selection.fit).residual
        return repeating(fine.bench, left, float(selection.baseline.mse.mean()), encoder_step(fine.bench))

    def completed(self, selection: Selection[Any, Fit, Candidate]) -> tuple[Fit, Fit]:
        """Both fitted once more, to all trials: of few settings, one that is locked is missed."""
        return self.refitted(selection.baseline), self.refitted(selection.fit)

    can_settle = True

    def settles(
        self, rival: Rival[Fit, Candidate], selection: Selection[Any, Fit, Candidate], seed: int
    ) -> int:
        """A law that contains another is not its rival, unless it predicts better by its handicap."""
        better = rival.errors.mean() < (1 - rival.candidate.handicap) * selection.errors.mean()
        return -1 if rival.cause in rival.candidate.contains and not better else 0

    def credible(self, baseline: Fit, now: Fit, best: Fit, candidate: Candidate) -> Array:
        """(1,) whether what it does is large enough for the encoder to see."""
        effect = np.sqrt(np.square(best.residual - now.residual).sum() / self.bench.valid.sum())
        return np.array([effect > RESOLVED * encoder_step(self.bench)])


def encoder_step(bench: Bench) -> float:
    """Smallest step between readings [rad]."""
    moved = np.abs(np.diff(bench.position, axis=0))[bench.valid[1:]]
    moved = moved[moved > 1e-9]
    return float(np.quantile(moved, 0.01)) if len(moved) else 0.0


def _places(candidate: Candidate) -> list[int]:
    return [INDEX[name] for name in candidate.parameters]
