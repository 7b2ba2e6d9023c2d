"""A face that is not even: what a crumb, or a cover that varies, does to the first touches of taxels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents
from lerobot_vtrefine.diagnose.pad.face_map import FACE_M, PASSES
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict, refit_weighted
from lerobot_vtrefine.diagnose.pad.form_fitting import settle
from lerobot_vtrefine.diagnose.pad.taxel_maps import MapEvidence, map_evidence, solve_map

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem


@dataclass(frozen=True)
class UnevenFace:
    """The likeliest face, and the model's fit to presses on it.

    Attributes:
        problem: on the even face.
        lower: (R*C,) how much lower the face is at every taxel [FACE_M].
        variances: of the face's parts (see `map_prior`).
    """

    problem: "PadProblem"
    lower: np.ndarray
    variances: tuple[float, ...]
    now: Fit

    @classmethod
    def told(cls, problem: "PadProblem", even: Fit) -> "UnevenFace":
        """From the best fit on an even face."""
        face = cls(problem, np.zeros(problem.presses.layout.num_taxels), (), even)
        for _ in range(PASSES):
            face = face._better()
        return face

    def scores(self) -> np.ndarray:
        """Log score (K,) of every recording on the face that the other folds tell, under their fit."""
        folds, evidence, found = self.problem.folds, self._evidence(), np.empty(len(self.problem.folds))
        again = self.problem.reweighted(self.now)
        for fold in np.unique(folds):
            held = np.flatnonzero(folds == fold)
            others = np.flatnonzero(folds != fold)
            lower, _ = solve_map(evidence, others.tolist(), self.lower, self.variances)
            part = self._on(lower).presses.subset(held.tolist())
            counts = (folds != fold).astype(float)
            found[held] = again.log_scores_of(refit_weighted(self.now, counts), part, counts, held)[:, 0]
        return found

    def _better(self) -> "UnevenFace":
        everyone: Sequence[int] = range(len(self.problem.weights))
        lower, variances = solve_map(self._evidence(), everyone, self.lower, ())
        there = self._on(lower)
        now = settle(self.now.model, there.presses, there.weights)
        return replace(self, lower=lower, variances=variances, now=now)

    def _on(self, lower: np.ndarray) -> "PadProblem":
        layout = self.problem.presses.layout
        face_m = FACE_M * lower.reshape(layout.rows, layout.cols)
        return replace(self.problem, presses=self.problem.presses.uneven(face_m))

    def _evidence(self) -> MapEvidence:
        presses, model = self._on(self.lower).presses, self.now.model.before_leaks()
        slopes = offset_tangents(model, presses, predict(model, presses))
        assert slopes is not None
        tangents = [slope * FACE_M for slope in slopes]
        return map_evidence(self.now, presses, self.problem.weights, tangents)
